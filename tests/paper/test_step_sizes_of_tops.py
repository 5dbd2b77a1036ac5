"""Sections 1.2 and 4: the energy–momentum scheme of tops is "unconditionally stable", if its equation is solved.

Random heavy tops of mean moment 1 with |Ω| = 1, so that Δt is |ΔtΩ|, and with |E| = 0.1 or 1, in units of J|Ω|².
"""

import functools

import jax
import numpy as np
import pytest
from paper import ONE, cay
from scipy.optimize import root

import lieint_jax as li
from lieint_jax.groups import so3

COUNT, GAMMA = 300, np.array([0.0, 0.0, 1.0])


def random_tops():
    """Moments, attitudes, Ω and the direction of E, seed 0."""
    rng = np.random.default_rng(0)
    J = rng.uniform(0.2, 1, (COUNT, 3)) @ (1 - ONE)
    q, Omega, E = (rng.normal(size=(COUNT, n)) for n in (4, 3, 3))
    q, Omega, E = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (q, Omega, E))
    return 3 * J / J.sum(axis=1, keepdims=True), q, Omega, E


@functools.partial(jax.jit, static_argnums=0)
def _converged(iterations, tops, size, dt):
    def one(J, q, Omega, E):
        top = li.systems.heavy_top(J, size * E, GAMMA)
        step = li.schemes.top_energy_momentum(top, iterations=iterations)
        return step(top.state(q, angular_velocity=Omega), dt)[1].converged

    return jax.vmap(one)(*tops)


@pytest.mark.paper("1.2", 'for tops "unconditionally stable": up to which step', "schemes/_top_energy_momentum.py")
@pytest.mark.parametrize(
    ("iterations", "limits"), [(None, (0.30, 0.15)), pytest.param(50, (2.25, 1.05), marks=pytest.mark.long)]
)
def test_1_2_steps_of_tops_converge_up_to_a_step_size(iterations, limits):
    """The greatest |ΔtΩ| up to which every top's step converges, with κ = 1 and 3 iterations, the default, or 50."""
    for size, limit in zip((0.1, 1.0), limits, strict=True):
        steps = np.arange(1, 20 * limit + 3) / 20
        all_converge = [bool(_converged(iterations, random_tops(), size, dt).all()) for dt in steps]
        assert steps[all_converge.index(False) - 1] == pytest.approx(limit, abs=0.051)  # by one of these steps


def test_1_2_with_kappa_1_the_equation_has_a_solution_at_a_large_step_too():
    """By Brouwer: Θ̄ = ½Δt J⁻¹(Π_n + Π_{n+1}), whose right side is bounded. scipy finds one at |ΔtΩ| = 10.

    It conserves energy. The step does not converge, and reports this.
    """
    dt, tops = 10.0, random_tops()
    assert not _converged(None, tops, 1.0, dt)[:5].any()
    starts = np.random.default_rng(1).normal(size=(50, 3)) * 3
    attitudes = jax.device_get(jax.jit(jax.vmap(so3.to_matrix))(tops[1]))
    for J, Q, Omega, E in [(tops[0][k], attitudes[k], tops[2][k], tops[3][k]) for k in range(5)]:
        Pi = J * Omega

        def after(bar, Q=Q, Pi=Pi, E=E):
            """(4.3), (4.4) and (4.6): Λ_{n+1} and Π_{n+1}."""
            T = cay(bar)
            return Q @ T, T.T @ (Pi + dt * Q.T @ np.cross(GAMMA, Q @ (ONE + T) @ E / 2))

        def missed(bar, J=J, Pi=Pi, after=after):
            return bar - dt / 2 * (Pi + after(bar)[1]) / J

        solutions = (root(missed, start, tol=1e-13) for start in starts)
        bar = next(found.x for found in solutions if np.abs(found.fun).max() < 1e-10)
        before, end = (P @ (P / J) / 2 + GAMMA @ R @ E for R, P in ((Q, Pi), after(bar)))
        assert end == pytest.approx(before, abs=2e-14)  # floor 2e-15
