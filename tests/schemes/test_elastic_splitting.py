"""Störmer–Verlet for pseudo-rigid bodies: the central difference method, its invariants, and its largest step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics, schemes, systems

LAM, MU = 2000.0, 6.0
BALL = systems.pseudo_rigid_body(np.full(3, 2.0), systems.mooney_rivlin(LAM, MU))
E = np.array([[1.0, 0.1, 0], [0.1, 1.5, -0.2], [0, -0.2, 2.5]])
SOFT = systems.pseudo_rigid_body(E, systems.mooney_rivlin(40.0, MU))
F0 = np.array([[1.1, 0.02, 0.0], [0.0, 0.95, 0.05], [-0.03, 0.0, 1.0]])
P0 = np.array([[0.3, -1.0, 0.2], [0.8, 0.1, 0.5], [-0.4, 0.6, -0.2]])
LINEAR_LIMIT = 2 / np.sqrt((6 * LAM + 2 * MU) / 2)  # of the ball at F = 1


def force(F, lam=40.0, mu=MU):
    """−2F∇W(FᵀF) of the paper's material, in its letters (6.3)."""
    C = F.T @ F
    return -F @ ((lam - (lam + mu) / np.linalg.det(C)) * np.linalg.det(C) * np.linalg.inv(C) + mu * np.eye(3))


@pytest.mark.paper("1.2, 6", "the central difference method: symplectic, and exact momentum", "schemes/_splitting.py")
def test_it_is_the_central_difference_method_and_conserves_form_and_momentum():
    """(F₂ − 2F₁ + F₀)E = Δt² times the force at F₁. Floors: this and the momentum 3e-15, the form 2e-15."""
    step, state = schemes.splitting(SOFT), SOFT.state(F0, momentum=P0)
    run = li.integrate(step, state, 0.05, 1000)
    assert run.info.converged.all()
    F = np.asarray(run.state.q)
    for n in (1, 500):
        second = (F[n + 1] - 2 * F[n] + F[n - 1]) @ E
        np.testing.assert_allclose(second, 0.05**2 * force(F[n]), rtol=0, atol=1e-14)
    assert np.abs(li.Run.of(step, run).momentum_error()).max() < 1e-14
    assert jax.jit(diagnostics.symplectic_defect)(step, state, 0.05) < 1e-14
    ends = jax.tree.map(lambda x: x[-1], run.state)
    back = li.integrate(step, ends, -0.05, 1000).state
    np.testing.assert_allclose(back.q[-1], F0, rtol=0, atol=1e-12)


@pytest.mark.long
def test_its_energy_error_is_bounded_and_of_second_order():
    """3e-2 of the energy, and a quarter of that at half the step."""
    step, state = schemes.splitting(SOFT), SOFT.state(F0, momentum=P0)
    run, fine = (li.integrate(step, state, dt, round(50 / dt)) for dt in (0.05, 0.025))
    errors = [float(np.abs(li.Run.of(step, r).energy_error()).max() / SOFT.energy(state)) for r in (run, fine)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert 1e-3 < errors[0] < 1e-1


@jax.jit
def growth(start, dts):
    """The largest energy in 2000 steps of the ball over the first, and whether every step converged; by step size."""

    def ratio(dt):
        run = li.integrate(schemes.splitting(BALL), start, dt, 2000)
        H = jax.vmap(BALL.energy)(run.state)
        return jnp.nanmax(H) / H[0], run.info.converged.all()

    return jax.vmap(ratio)(dts)


def test_near_the_undeformed_shape_the_limit_is_that_of_the_fastest_linear_vibration():
    """2/ω with ω² = (6λ + 2μ)/E. At 0.1 % beyond, a dilation by 1e-3 gains energy; `diagnostics.normal_modes` has ω."""
    start = BALL.state(1.001 * np.eye(3), momentum=np.zeros((3, 3)))
    ratio, converged = growth(start, LINEAR_LIMIT * np.array([0.5, 0.999, 1.001]))
    assert converged.all()
    assert max(ratio[:2]) < 1.01  # observed 1.000 and 1.004
    assert ratio[2] > 100  # observed 2e3


@pytest.mark.parametrize(("momentum", "share"), [(2.0, 0.976), (6.0, 0.467), (10.0, 0.196)])
def test_the_spinning_ball_of_figure_3_needs_the_step_of_its_most_deformed_shape(momentum, share):
    """2/ω with ω² ≈ 2λ|cof F|²/E at the largest |cof F|; `share` is this limit over that at F = 1.

    Measured: largest stable steps of 0.95, 0.45 and 0.15 of the linear limit; 0.98, 0.5 and 0.2 fail within 10⁴ steps.
    """
    start = BALL.state(angular_velocity=[0.0, 0.0, momentum / 2])
    run = li.integrate(schemes.splitting(BALL), start, 0.05 * LINEAR_LIMIT, 4000)
    F = np.asarray(run.state.q)
    cofactor = np.linalg.norm(np.linalg.det(F)[:, None, None] * np.linalg.inv(F), axis=(1, 2)).max()
    limit = 2 / np.sqrt(LAM * cofactor**2)
    assert limit / LINEAR_LIMIT == pytest.approx(share, rel=0.02)
    ratio, converged = growth(start, limit * np.array([0.7, 1.3]))
    assert converged.tolist() == [True, False]
    assert ratio[0] < 1.05
    assert not ratio[1] < 100


@pytest.mark.long
def test_a_step_that_inverts_the_body_is_flagged():
    start = BALL.state(momentum=np.diag([-10.0, 0.0, 0.0]))
    assert not jax.jit(schemes.splitting(BALL))(start, 0.5)[1].converged
    with pytest.raises(ValueError, match="splitting inverts the body"):
        li.run(schemes.splitting(BALL), start, dt=0.5, num_steps=2)
