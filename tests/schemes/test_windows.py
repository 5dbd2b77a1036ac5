"""Laws that act in a window of time: impulses and derivatives by the ends of the window, its order, NaN times."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import euler, in_body
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import schemes, systems, torques

DT, T = 0.05, 0.4
J, DAMPING, OMEGA = np.array([1.3, 1.7, 2.2]), np.array([0.3, 0.5, 0.2]), np.array([0.5, -0.3, 0.6])


def constant(t, q, omega):
    return jnp.array([0.0, 0.0, T])


def motors(start, stop):
    motor = torques.wheel_motor(jnp.eye(3), constant, window=(start, stop))
    return torques.wheels(jnp.eye(3), 0.05, motor, max_torque=2 * T)


LAWS = {
    "windowed": lambda *window: torques.windowed(constant, *window),
    "thruster": lambda *window: torques.thruster([0.0, 0.0, T], *window),
    "wheel_motor": motors,
}


def momentum(law, num_steps=60):
    """The momentum of a body about its axis after 60 steps, and the flags of these."""
    body = systems.torqued_body(J, law)
    run = li.integrate(
        schemes.torqued_midpoint(body), body.state(angular_velocity=[0, 0, 0.5]), DT, num_steps, save_every=num_steps
    )
    return run.state.p[-1, 2], run.info.converged.all()


@pytest.mark.parametrize("law", [pytest.param(x, marks=[pytest.mark.long] * (x == "wheel_motor")) for x in LAWS])
def test_an_impulse_and_its_derivatives_by_the_ends_of_a_window_are_exact(law):
    """T(stop − start), −T and T: for ends within steps, at their boundaries, and both in one step; NaN for NaN."""

    def gained(window):
        found, converged = momentum(LAWS[law](*window))
        return found - 0.5 * J[2], (found - 0.5 * J[2], converged)

    nan = jnp.nan
    windows = jnp.array([[1.01, 2.03], [1, 2], [1, 1], [1.02, 1.04], [1.03, 1.03], [-1, 9], [nan, 2], [1, nan]])
    slopes, (impulse, converged) = jax.jit(jax.vmap(jax.jacfwd(gained, has_aux=True)))(windows)
    seconds = np.clip(windows[:6, 1], 0, 3) - np.clip(windows[:6, 0], 0, 3)
    np.testing.assert_allclose(impulse[:6], T * seconds, rtol=0, atol=4e-14)
    expected = T * np.array([[-1.0, 1.0]] * 5 + [[0.0, 0.0]])
    np.testing.assert_allclose(slopes[:6], expected, rtol=0, atol=1e-12)
    assert np.isnan(impulse[6:]).all()
    assert converged.tolist() == [True] * 6 + [False] * 2


def test_the_period_of_a_controller_that_is_not_a_number_is_seen():
    periods = jnp.array([0.1, jnp.nan])
    law = lambda period: torques.sampled(torques.viscous(0.2), period)  # noqa: E731
    found, converged = jax.jit(jax.vmap(lambda period: momentum(law(period))))(periods)
    assert np.isfinite(found).tolist() == converged.tolist() == [True, False]


def damped_between(start, stop, end):
    """The attitude and angular velocity at `end` of a body with friction from start to stop, by DOP853."""
    y = np.array([1.0, 0, 0, 0, *OMEGA])
    for first, last, damping in ((0.0, start, 0.0), (start, stop, DAMPING), (stop, end, 0.0)):
        rate = euler(J, lambda t, q, Omega, damping=damping: -damping * Omega)
        y = solve_ivp(rate, (first, last), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return y


def test_a_window_that_ends_within_steps_leaves_order_two():
    """Against DOP853 from end to end of the window. Observed: 1.07 to 1.14 Δt²/16, as where steps end there."""
    window, end = (1.013, 2.739), 4.0
    body = systems.torqued_body(J, torques.windowed(torques.viscous(DAMPING), *window))
    step, exact = schemes.torqued_midpoint(body), damped_between(*window, end)
    for num_steps in (40, 57, 113):
        run = li.run(step, body.state(angular_velocity=OMEGA), end / num_steps, num_steps, save_every=num_steps)
        last = jax.tree.map(lambda x: x[-1], run.state)
        found = np.concatenate([last.q, body.angular_velocity(last)])
        assert np.abs(found - exact).max() * num_steps**2 < 1.3
    turned = in_body(exact[:4], np.eye(3)[0])
    assert np.linalg.norm(turned - [1, 0, 0]) > 0.5  # the body has rotated far
