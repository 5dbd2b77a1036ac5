"""Section 1.2, its remark on Moser & Veselov 1991: their algorithm on SO(n) conserves the spatial momentum.

X_{k+1} = X_k R_k, where R_k is the rotation near 1 with R_k J − J R_kᵀ = M_k, and M_{k+1} = R_kᵀ M_k R_k.
"""

import jax
import numpy as np
import pytest
from paper import hat
from scipy.optimize import root

import lieint_jax as li
from lieint_jax.groups import so3

STEPS = 20


def skew_matrix(x, n):
    """The skew matrix whose entries above the diagonal are x."""
    A = np.zeros((n, n))
    A[np.triu_indices(n, 1)] = x
    return A - A.T


def moser_veselov(J, X, M):
    """X_k and M_k, k = 0 to STEPS."""
    n = len(J)
    above = np.triu_indices(n, 1)

    def rotation(x):
        A = skew_matrix(x, n)
        return np.linalg.solve(np.eye(n) - A, np.eye(n) + A)

    trajectory = [(X, M)]
    for _ in range(STEPS):
        found = root(lambda x, M: (rotation(x) @ J - J @ rotation(x).T - M)[above], 0 * M[above], M, tol=1e-13)
        R = rotation(found.x)
        assert np.abs(R @ J - J @ R.T - M).max() < 5e-15  # floor 1e-15
        X, M = X @ R, R.T @ M @ R
        trajectory.append((X, M))
    return map(np.array, zip(*trajectory, strict=True))


def spread(momenta):
    return np.abs(momenta - momenta[0]).max() / np.abs(momenta[0]).max()


@pytest.mark.paper("1.2", "Moser and Veselov's algorithm: the momentum that it conserves", "schemes/_so3_midpoint.py")
@pytest.mark.parametrize("n", [3, 4, 5])
def test_1_2_moser_veselov_conserves_the_momentum_of_the_attitude_before_the_step(n):
    """X_k M_k X_kᵀ is constant. X_{k+1} M_k X_{k+1}ᵀ, the other attitude of the same step, is not."""
    rng = np.random.default_rng(n)
    M = skew_matrix(rng.normal(size=n * (n - 1) // 2) * 0.6, n)
    X, M = moser_veselov(np.diag(np.arange(1.0, n + 1)), np.eye(n), M)
    assert spread(X @ M @ np.swapaxes(X, 1, 2)) < 1e-14  # floor 2e-15
    assert spread(X[1:] @ M[:-1] @ np.swapaxes(X[1:], 1, 2)) > 0.1  # 0.28, 0.15 and 0.12


def test_1_2_moser_veselov_on_so_3_is_the_symplectic_step():
    """With J of the algorithm = ½ tr(J)1 − J and M_0 = ΔtΠ̂_0: the same attitudes, and X_k M_k X_kᵀ = Δtπ̂."""
    moments, dt = np.array([1.0, 2.0, 3.0]), 0.3
    body = li.systems.rigid_body(moments)
    state = body.state(angular_velocity=[0.3, -0.5, 1.0])
    run = jax.jit(li.integrate, static_argnums=3)(li.schemes.so3_midpoint(body), state, dt, STEPS)
    X, M = moser_veselov(np.diag(moments.sum() / 2 - moments), np.eye(3), dt * hat(state.p))
    assert run.info.converged.all()
    np.testing.assert_allclose(X, jax.vmap(so3.to_matrix)(run.state.q), rtol=0, atol=1e-14)  # floor 3e-15
    np.testing.assert_allclose(X @ M @ np.swapaxes(X, 1, 2) - dt * hat(state.p), 0, rtol=0, atol=5e-15)  # floor 1e-15
