"""Controlled satellites against scipy: magnetic detumbling, and a slew whose control is held between samples."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import euler, in_body
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import orbits, torques
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import torqued_body

J = np.array([0.0419, 0.0419, 0.0067])  # kg m², a CubeSat of three units


def attitude_error(q, other):
    """The angle between two attitudes, rad."""
    a, b = (Rotation.from_quat(np.asarray(x), scalar_first=True) for x in (q, other))
    return (a.inv() * b).magnitude()


def dipole_field(date_angle, G, radius, mu, size, inclination):
    """b along a circular orbit by the textbook formula, in numpy: (R/r)³ (3(G·r̂)r̂ − G), G rotating with the Earth."""
    n, tilt = np.sqrt(mu / size**3), np.array([np.cos(inclination), np.sin(inclination)])

    def field(t):
        r = np.array([np.cos(n * t), tilt[0] * np.sin(n * t), tilt[1] * np.sin(n * t)])
        c, s = np.cos(date_angle + orbits.EARTH_RATE * t), np.sin(date_angle + orbits.EARTH_RATE * t)
        m = np.array([c * G[0] - s * G[1], s * G[0] + c * G[1], G[2]])
        return (radius / size) ** 3 * (3 * (m @ r) * r - m)

    return field


@pytest.mark.long
def test_magnetic_detumbling_is_that_of_scipy():
    """From 6 °/s for a quarter of an orbit: both orders of the attitude, and the same loss of energy.

    Source: the law of Stickler & Alfriend 1976; the motion by DOP853 with equations and a field in numpy.
    """
    mu, size, inclination = orbits.EARTH_GM * 1e9, 6878e3, np.deg2rad(97.4)
    date, gain, T = orbits.julian_date(2026, 3, 1), 4e4, 1400.0
    G = 1e-9 * np.array([-1400.0, 4520.0, -29335.0])
    law = torques.bdot(gain, orbits.earth_field(orbits.kepler(mu, size, 0.0, inclination), date, G, 6371.2e3))
    body = torqued_body(J, law)
    Omega = np.deg2rad([4.0, -3.0, 3.0])
    state = body.state(angular_velocity=Omega, work=0.0)
    field = dipole_field(float(orbits.earth_rotation_angle(date)), G, 6371.2e3, mu, size, inclination)

    def torque(t, q, Omega):
        B = in_body(q, field(t))
        return np.cross(gain * np.cross(Omega, B), B)

    y = np.concatenate([state.q, Omega])
    exact = solve_ivp(euler(J, torque), (0, T), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    lost = 0.5 * (J @ exact[4:] ** 2 - J @ Omega**2)
    assert lost < -0.25 * J @ Omega**2  # half of it
    errors = {}
    final = jax.jit(lambda step, dt, n: li.integrate(step, state, dt, n, save_every=n).state, static_argnums=2)
    for order, n in ((2, 1400), (2, 2800), (4, 1400), (4, 2800)):
        step = torqued_midpoint(body) if order == 2 else li.schemes.compose(torqued_midpoint(body), order)
        end = jax.tree.map(lambda x: x[-1], final(step, T / n, n))
        errors[order, n] = attitude_error(end.q, exact[:4])
        assert float(end.work) == pytest.approx(lost, rel=1e-3 if order == 2 else 1e-6)
        assert float(body.energy(end) - end.work) == pytest.approx(float(body.energy(state)), rel=1e-13, abs=1e-12)
    for order in (2, 4):
        assert np.log2(errors[order, 1400] / errors[order, 2800]) == pytest.approx(order, abs=0.1)
    assert errors[4, 2800] < 1e-6  # observed: 2.3e-7


@functools.partial(jax.jit, static_argnums=(3, 4))
def held_for(torque, state, period, substeps, order):
    """The state and the angular velocity after a period in which a torque in the body is held."""
    law = li.core.as_law(jax.tree_util.Partial(lambda torque, t, q, Omega: torque, torque))
    body = li.systems.TorquedBody(jnp.asarray(J), law)
    step = torqued_midpoint(body) if order == 2 else li.schemes.compose(torqued_midpoint(body), order)
    end = li.integrate(step, state, period / substeps, substeps, save_every=substeps).state
    end = jax.tree.map(lambda x: x[-1], end)
    return end, body.angular_velocity(end)


@pytest.mark.long
def test_a_slew_in_a_sampled_loop_is_that_of_scipy():
    """A controller that measures every 2 s and holds its torque in between, over a slew of 120°: order 2, then 4.

    Each program closes the loop with its own states.
    """
    k, c, period, samples = 2 * J * 0.03**2, 2 * J * 0.03, 2.0, 150
    first = Rotation.from_rotvec(np.deg2rad(120) * np.array([0.6, 0.0, 0.8])).as_quat(scalar_first=True)

    def control(q, Omega):
        e = np.asarray(q) * (1 if q[0] >= 0 else -1)
        return -k * e[1:] - c * np.asarray(Omega)

    y = np.concatenate([first, np.zeros(3)])
    for _ in range(samples):
        held = control(y[:4], y[4:])
        rate = euler(J, lambda t, q, Omega, held=held: held)
        y = solve_ivp(rate, (0, period), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    assert attitude_error(y[:4], [1.0, 0, 0, 0]) < np.deg2rad(0.5)

    errors = []
    for order, substeps in ((2, 2), (2, 4), (4, 2)):
        state, Omega = torqued_body(J, torques.viscous(0.0)).state(first, angular_velocity=jnp.zeros(3)), np.zeros(3)
        for _ in range(samples):
            state, Omega = held_for(jnp.asarray(control(state.q, Omega)), state, period, substeps, order)
        errors.append(attitude_error(state.q, y[:4]))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    assert errors[2] < 1e-4 * errors[0]  # observed: 6e-12 and 3e-7
