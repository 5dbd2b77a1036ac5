"""The α-family (2.17) in L(3): momentum and energy for every α, SO(3) and order 2 for α = ½ alone (Section 2.2)."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest
from paper import ONE, hat
from repeated import once

import lieint_jax as li
from lieint_jax.diagnostics import symplectic_defect
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

KAPPAS = [kappa_cayley, kappa_exponential, kappa_symplectic]
BODY = li.systems.embedded_body([1.0, 2.0, 3.0])
STATE = BODY.state([0.8, 0.6, 0, 0], angular_velocity=[0.2, 0.3, 1.0])
number = st.floats(-1, 1, width=64)
vectors = st.tuples(number, number, number).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


@jax.jit
def _steps(J, alpha, q, Omega, dt):
    """Twenty steps with κ = 1: the run, energies relative to theirs, and ΛΠ less π over |π|."""
    body = li.systems.EmbeddedBody(J)
    state = body.state(q, angular_velocity=Omega)
    step = li.schemes.so3_alpha(body, alpha)
    run = li.Run.of(step, li.integrate(step, state, dt, 20))
    return run.trajectory, run.energy_error() / body.energy(state), run.momentum_error()


@pytest.mark.long
@pytest.mark.paper("2.2: (2.14)–(2.18), Result 1", "the α-family in L(3): momentum", "schemes/_so3_alpha.py")
@hypothesis.given(st.floats(0, 1), vectors, vectors, st.sampled_from([-0.3, 0.3]))
def test_result_01_and_2_27_momentum_and_energy_for_every_alpha(alpha, axis, Omega, dt):
    q = np.array([1.0, *axis]) / np.linalg.norm([1.0, *axis])
    run, energy, momentum = _steps(np.array([1.0, 1.7, 2.3]), alpha, q, Omega / np.linalg.norm(Omega), dt)
    assert np.asarray(run.info.converged).all()
    assert np.abs(momentum).max() == 0
    assert np.abs(energy).max() < 2e-14  # floor 5e-15: Λ is worn by its stretch


@pytest.mark.paper("2.2: (2.19)–(2.22)", "T_α and ν", "schemes/_so3_alpha.py")
@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_the_equations_2_17_hold_as_they_stand(alpha, kappa):
    """Both lines, with Θ from (2.28), at round-off; and Λ_{n+1} by (2.20), not by the printed (2.21)."""
    dt, J = 0.4, np.diag([1.0, 2.0, 3.0])
    after, info = once(li.schemes.so3_alpha(BODY, alpha, kappa), STATE, dt)
    assert info.converged
    Q0, Q1 = np.asarray(STATE.q), np.asarray(after.q)
    Pi0, Pi1 = (np.asarray(BODY.body_momentum(z)) for z in (STATE, after))
    bar = dt * np.linalg.solve(J, (Pi0 + Pi1) / 2)
    Theta = paper.KAPPAS[kappa.name][0](bar @ bar) * bar
    mean = lambda a, b, weight: weight * b + (1 - weight) * a  # noqa: E731
    assert np.abs(Q1 - Q0 - mean(Q0, Q1, alpha) @ hat(Theta)).max() < 4e-15  # floor 6e-16
    assert np.abs(Pi1 - Pi0 - np.cross(mean(Pi0, Pi1, 1 - alpha), Theta)).max() < 8e-15  # floor 2e-15
    T, X = Q0.T @ Q1, hat(Theta)
    np.testing.assert_allclose(T, paper.T(alpha, Theta), rtol=0, atol=4e-15)
    printed = ONE + (X + (1 - alpha) * X @ X) / (1 + alpha**2 * Theta @ Theta)
    assert alpha == 0.5 or np.abs(T - printed).max() > 1e-2
    nu = (2 * alpha - 1) / (1 + alpha**2 * Theta @ Theta)  # (2.22) corrected
    np.testing.assert_allclose(T @ T.T, ONE + nu * X @ X, rtol=0, atol=4e-15)


@pytest.mark.long
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_alpha_one_half_is_so3_midpoint(kappa):
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state([0.8, 0.6, 0, 0], angular_velocity=[0.2, 0.3, 1.0])
    here, there = STATE, state
    step, midpoint = li.schemes.so3_alpha(BODY, 0.5, kappa), li.schemes.so3_midpoint(body, kappa)
    for _ in range(20):
        here, there = once(step, here, 0.3)[0], once(midpoint, there, 0.3)[0]
    np.testing.assert_allclose(here.q, so3.to_matrix(there.q), rtol=0, atol=8e-15)  # floor 2e-15


@pytest.mark.paper("2.2: (2.23), (2.24), Result 2", "α = ½ alone stays on SO(3)", "schemes/_so3_alpha.py")
@pytest.mark.long
@pytest.mark.parametrize("alpha", [0.3, 0.5, 0.0, 0.9])
def test_the_alpha_family_conserves_energy_but_leaves_the_group(alpha):
    """Order, the group and the length of Π tell α = ½ from the others; energy and momentum do not."""
    step = li.schemes.so3_alpha(BODY, alpha)
    found = li.diagnostics.certify(step, STATE, 0.05, 40)
    assert found.energy < 8e-15  # floor 2e-15
    assert found.momentum == 0
    assert found.order == pytest.approx(step.order, abs=0.06)
    length = [float(jnp.linalg.norm(BODY.body_momentum(z))) for z in (STATE, once(step, STATE, 0.05)[0])]
    if alpha == 0.5:
        assert max(found.constraint, found.reversibility, abs(length[1] - length[0])) < 8e-15
    else:
        assert found.constraint > 0.02
        assert found.reversibility > 1e-3
        assert abs(length[1] - length[0]) > 3e-5


def test_alpha_is_undone_by_one_less_alpha():
    """Interchanging n and n + 1 in (2.17) and the sign of Δt gives the member 1 − α."""
    forth, back = (li.schemes.so3_alpha(BODY, alpha, kappa_exponential) for alpha in (0.2, 0.8))
    z = once(back, once(forth, STATE, 0.3)[0], -0.3)[0]
    np.testing.assert_allclose(z.q, STATE.q, rtol=0, atol=4e-15)  # floor 5e-16
    assert np.abs(once(forth, once(forth, STATE, 0.3)[0], -0.3)[0].q - STATE.q).max() > 1e-2


@pytest.mark.long
def test_alpha_one_half_is_symplectic_with_the_symplectic_kappa_only():
    defect = [jax.jit(symplectic_defect)(li.schemes.so3_alpha(BODY, 0.5, k), STATE, 0.3) for k in KAPPAS]
    assert defect[2] < 4e-15  # floor 9e-16
    assert min(defect[:2]) > 1e-4


@pytest.mark.long
@pytest.mark.parametrize(("alpha", "axis"), [(0.1, 0), (0.9, 2)])
def test_other_alphas_end_in_a_spin_about_an_axis(alpha, axis):
    """|Π| falls or grows monotonically, at constant energy, to its least or greatest value √(2HJ)."""
    run = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))(
        li.schemes.so3_alpha(BODY, alpha), STATE, 0.1, 1200, save_every=100
    )
    lengths = np.linalg.norm(jax.vmap(BODY.body_momentum)(run.state), axis=1)
    change = np.diff(lengths)[run.info.converged[1:]]
    assert (change < 1e-9).all() if alpha < 0.5 else (change > -1e-9).all()
    assert lengths[-1] == pytest.approx(np.sqrt(2 * BODY.energy(STATE) * BODY.inertia[axis]), rel=2e-3)


def test_a_stretched_attitude_is_flagged():
    """Once Λ has stretched by 1e10 or so, Π = Λ⁻¹π has no digits left that could be relied on."""
    step = li.schemes.so3_alpha(BODY, 0.0)
    stretched = li.State(STATE.q * jnp.array([1.0, 1e5, 1e5]), STATE.p)
    assert once(step, stretched, 1e-3)[1].converged
    worn = li.State(STATE.q * jnp.array([1.0, 1e11, 1e11]), STATE.p)
    assert not once(step, worn, 1e-3)[1].converged
