"""Laws that switch, against DOP853 in numpy: the orders of steps across switches, which are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import euler, in_body
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import torques
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import torqued_body

J = np.array([1.3, 1.7, 2.2])
Q = np.array([0.8, -0.3, 0.4, 0.2]) / np.linalg.norm([0.8, -0.3, 0.4, 0.2])
OMEGA = np.array([0.5, -0.3, 0.6])
FIELD = np.array([1.0, 0.5, -0.3])
E, SATURATION, SLOPE, COERCIVITY = np.array([0.6, 0.8, 0.0]), 0.1, 0.4, 0.2
T = 10.0


def errors(law, exact, order, steps):
    """The errors of attitude and angular velocity at T, for several numbers of steps."""
    body = torqued_body(J, law)
    step = torqued_midpoint(body) if order == 2 else li.schemes.compose(torqued_midpoint(body), order)
    state = body.state(Q, angular_velocity=OMEGA)

    @jax.jit
    def final(dt, n):
        end = jax.lax.fori_loop(0, n, lambda _, z: step(z, dt)[0], state)
        return end.q, body.angular_velocity(end)

    ends = [np.concatenate(final(T / n, n)) for n in steps]
    return np.array([np.abs(end - exact).max() for end in ends])


def slope(steps, found):
    """The order by least squares: single switches lie anywhere in a step, so the errors scatter."""
    return -np.polyfit(np.log(steps), np.log(found), 1)[0]


@pytest.mark.long
def test_a_limit_that_comes_and_goes_leaves_order_two():
    """Of limited torquers, with the switches of their components counted: order 2, whatever the composition.

    Without a limit the composition has order 4, so that the switches cost it two orders.
    """
    gain, limit = 0.3, 0.05

    def asked(q, Omega):
        return gain * np.cross(Omega, in_body(q, FIELD))

    def reference(limit):
        def torque(t, q, Omega):
            return np.cross(np.clip(asked(q, Omega), -limit, limit), in_body(q, FIELD))

        y = np.concatenate([Q, OMEGA])
        return solve_ivp(euler(J, torque), (0, T), y, "DOP853", rtol=1e-12, atol=1e-14, max_step=0.02)

    path = reference(limit)
    beyond = np.array([np.abs(asked(y[:4], y[4:])) > limit for y in path.y.T])
    assert np.abs(np.diff(beyond.astype(int), axis=0)).sum() >= 6
    law = torques.bdot(gain, jnp.asarray(FIELD), max_dipole=limit)
    steps = np.array([40, 57, 80, 113, 160, 226, 320])
    for order in (2, 4):
        assert slope(steps, errors(law, path.y[:, -1], order, steps)) == pytest.approx(2, abs=0.4)
    smooth = torques.bdot(gain, jnp.asarray(FIELD))
    found = errors(smooth, reference(np.inf).y[:, -1], 4, steps[::3])
    assert slope(steps[::3], found) == pytest.approx(4, abs=0.2)


def rod_reference():
    """The motion with a hysteresis rod, from switch to switch by events, and the number of switches."""
    sign, w = 0.0, float(np.clip(0.0, E @ in_body(Q, FIELD) - COERCIVITY, E @ in_body(Q, FIELD) + COERCIVITY))
    y, t, switches = np.concatenate([Q, OMEGA]), 0.0, 0

    def x(y):
        return E @ in_body(y[:4], FIELD)

    def speed(y):
        return E @ np.cross(in_body(y[:4], FIELD), y[4:])

    while t < T:
        dragged = sign != 0

        def internal(q, dragged=dragged, sign=sign, w=w):
            return E @ in_body(q, FIELD) - sign * COERCIVITY if dragged else w

        def torque(t, q, Omega, internal=internal):
            return SATURATION * np.tanh(internal(q) / SLOPE) * np.cross(E, in_body(q, FIELD))

        def rises(t, y, w=w):
            return x(y) - w - COERCIVITY

        def falls(t, y, w=w):
            return x(y) - w + COERCIVITY

        def turns(t, y, sign=sign):
            return sign * speed(y)

        events = [turns] if dragged else [rises, falls]
        rises.direction, falls.direction, turns.direction = 1, -1, -1
        for event in events:
            event.terminal = True
        part = solve_ivp(euler(J, torque), (t, T), y, "DOP853", rtol=1e-12, atol=1e-14, events=events, max_step=0.1)
        t, y = part.t[-1], part.y[:, -1]
        if part.status == 1:
            switches += 1
            w = internal(y[:4])
            sign = 0.0 if dragged else (1.0 if len(part.t_events[0]) else -1.0)
    return y, switches


@pytest.mark.long
def test_a_rod_has_order_two_across_its_switches():
    """Against DOP853 from switch to switch; the straight line of the field in a step makes this so."""
    exact, switches = rod_reference()
    assert switches >= 3
    law = torques.hysteresis(E, SATURATION, SLOPE, COERCIVITY, field=FIELD)
    steps = np.array([50, 100, 200, 400, 800])
    found = errors(law, exact, 2, steps)
    assert slope(steps, found) == pytest.approx(2, abs=0.15)
    assert found[-1] < 1e-4
