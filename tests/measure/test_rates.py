"""Every function of `measure` that returns a rate or a period, of motions whose rates are known exactly.

Orbits are an ellipse at rest and one that precesses: Newton's theorem of revolving orbits (Principia I, 44). Under
an additional force h/r³ the distance is that of Kepler's motion with k times the angular momentum, k² = 1 + h/L², and
the angle is the true anomaly over k, so the line of apsides precesses at n(1/k − 1). Their states are closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import lieint_jax as li
from lieint_jax import measure

ECCENTRICITIES, K = (0.2, 0.5, 0.8), (1.0, 1.02)
MASSES = jnp.array([0.75, 0.25])
PER_REVOLUTION, REVOLUTIONS = 59.7, 40.37  # so that saves are at other places in each revolution
TOLERANCE = 1e-8


def distance_and_angle(t, e, k):
    """r and θ of a revolving orbit with μ = a = 1."""
    x, y = li.orbits.kepler(1.0, 1.0, e)(t)[0][:2]
    anomaly = jnp.arctan2(y, x)
    return jnp.hypot(x, y), (anomaly + 2 * jnp.pi * jnp.round((t - anomaly) / (2 * jnp.pi))) / k


def positions(t, e, k):
    """Of both bodies, in a plane that is inclined by 0.3."""
    r, angle = distance_and_angle(t, e, k)
    d = r * jnp.stack([jnp.cos(angle), jnp.sin(angle) * jnp.cos(0.3), jnp.sin(angle) * jnp.sin(0.3)])
    return jnp.array([-0.25, 0.75])[:, None] * d


def outward(h, x, R):
    """The potential of the additional force, of two bodies of the reduced mass 3/16."""
    return 3 / 16 * h / (2 * jnp.sum((x[1] - x[0]) ** 2))


@li.pytree
class Revolving(li.core.Step):
    """Two spheres on a revolving orbit in closed form."""

    system: li.core.System
    e: jax.Array
    k: jax.Array

    def advance(self, state, dt):
        return self.at(state.t + dt, state), li.core.StepInfo.empty(state.q)

    def at(self, t, state):
        x, v = jax.jvp(lambda t: positions(t, self.e, self.k), (t,), (jnp.ones_like(t),))
        q, p = (
            jnp.concatenate([now, old[:, 3:]], axis=1) for now, old in ((x, state.q), (MASSES[:, None] * v, state.p))
        )
        return state._replace(q=q, p=p)


@pytest.fixture(scope="module")
def orbits():
    """All eccentricities at rest, then all precessing."""
    gravity, sphere = li.potentials.point_masses(1.0, MASSES), jnp.full((2, 3), 1e-6)

    def revolving(e, k):
        h = (1 - e**2) * (1 - 1 / k**2)
        bodies = li.systems.rigid_bodies(MASSES, sphere, gravity + jax.tree_util.Partial(outward, h))
        return Revolving(bodies, e, k)

    bodies = li.systems.rigid_bodies(MASSES, sphere, gravity)
    rest = bodies.state(jnp.eye(2, 3), velocities=jnp.zeros((2, 3)), angular_velocities=jnp.zeros((2, 3)))
    e, k = (jnp.asarray(x.ravel()) for x in np.meshgrid(ECCENTRICITIES, K))
    step = jax.vmap(revolving)(e, k)
    start = jax.vmap(lambda step: step.at(jnp.zeros(()), rest._replace(t=jnp.zeros(()))))(step)
    count = round(PER_REVOLUTION * REVOLUTIONS)
    return li.run(step, start, 2 * np.pi / PER_REVOLUTION, count, own_step=True, progress=False)


def test_the_closed_form_of_a_revolving_orbit_is_that_of_its_equations():
    k = K[1]
    for e in ECCENTRICITIES:
        speed, h = np.sqrt((1 + e) / (1 - e)) / k, (1 - e**2) * (1 - 1 / k**2)

        def rates(_, y, h=h):
            r = np.hypot(*y[:2])
            return [*y[2:], *(h / r - 1) * y[:2] / r**3]

        t = np.linspace(0, 20, 9)
        x = solve_ivp(rates, (0, 20), [1 - e, 0, 0, speed], "DOP853", t, rtol=1e-12, atol=1e-13).y[:2]
        r, angle = jax.vmap(lambda t, e=e: distance_and_angle(t, e, k))(jnp.asarray(t))
        np.testing.assert_allclose(x, [r * np.cos(angle), r * np.sin(angle)], rtol=0, atol=1e-8)


def test_rates_of_orbits_that_rest_and_precess(orbits):
    """The two frequencies of a series are those of the anomaly, n, and of the longitude, n/k."""
    motion, n = measure.relative_motion(orbits), 1.0
    sidereal, found, t = n / np.repeat(K, 3), measure.apsides(motion), motion.t
    frequencies = np.arange(0.1, 0.3, 2e-4)
    power = measure.periodogram(t, motion.distance, frequencies=frequencies).power
    amplitude = measure.spectrum(t, motion.distance).amplitude
    first = [measure.sines(t, x, frequencies, 1)[0].frequency for x in motion.distance.T]
    turning = [measure.complex_rates(t, np.exp(1j * x), 1)[0].real for x in motion.mean_longitude[:, :3].T]
    for name, rate, tolerance in (
        ("apsides.period", 2 * np.pi / found.period - sidereal, TOLERANCE),
        ("apsides.anomalistic_period", 2 * np.pi / found.anomalistic_period - n, TOLERANCE),
        ("apsides.precession_rate", found.precession_rate - (sidereal - n), TOLERANCE),
        ("mean_rate of the longitude", measure.mean_rate(t, motion.longitude) - sidereal, 2e-7),
        ("mean_rate of the mean longitude", measure.mean_rate(t, motion.mean_longitude) - sidereal, 1e-8),
        ("line", 2 * np.pi * measure.line(t, motion.distance, 0.1, 0.2).frequency - n, 5e-8),
        ("periodogram", 2 * np.pi * (frequencies[power.argmax(axis=0)] - 1 / (2 * np.pi)), 2e-3),
        ("sines", 2 * np.pi * np.array(first) - n, 2e-3),
        (
            "spectrum",
            2 * np.pi * measure.spectrum(t, motion.distance).frequency[amplitude.argmax(axis=0)] - n,
            0.6 / 40,
        ),
        ("complex_rates", np.array(turning) - n, 1e-12),
    ):
        np.testing.assert_allclose(rate, 0, rtol=0, atol=tolerance, err_msg=name)
    error = abs(found.precession_rate - (sidereal - n))
    assert (error < 3 * found.precession_error).all()
    np.testing.assert_allclose(found.eccentricity[:3], ECCENTRICITIES, rtol=0, atol=1e-14)
    assert (error[:3] < 1e-15).all()
    assert (found.precession_error[:3] < 1e-15).all()


def motion_of(t, longitude, vector):
    """A relative motion with this Laplace's vector e exp(iϖ)."""
    nothing = np.zeros_like(vector.real)
    return measure.RelativeMotion(t, *[nothing] * 9, abs(vector), np.angle(vector), longitude)


def test_the_error_of_the_precession_is_that_of_noise():
    """Of 200 orbits with white noise in the vector, and with noise that is correlated over two revolutions: about 68 %
    of the rates are within their errors. Of the latter fewer, as the errors know correlations over 10 revolutions."""
    random, t, rate = np.random.default_rng(3), np.arange(0, 100 * 2 * np.pi, 2 * np.pi / 16), 0.003
    noise = random.normal(size=(2, len(t), 200))
    slow = noise.copy()
    for k in range(1, len(t)):
        slow[:, k] = 0.97 * slow[:, k - 1] + np.sqrt(1 - 0.97**2) * noise[:, k]
    longitude = np.broadcast_to(t[:, None] + 0.3, noise.shape[1:])
    for (x, y), least in ((noise, 0.6), (slow, 0.5)):
        vector = 0.1 * np.exp(1j * (0.5 + rate * t))[:, None] + 0.01 * (x + 1j * y)
        found = measure.apsides(motion_of(t, longitude, vector))
        for error, standard in (
            (found.precession_rate - rate, found.precession_error),
            (found.eccentricity - 0.1, found.eccentricity_error),
        ):
            assert least < np.mean(abs(error) < standard) < 0.76


def test_a_circle_and_an_orbit_of_noise_have_no_apsides():
    random, t = np.random.default_rng(4), np.arange(0, 50 * 2 * np.pi, 2 * np.pi / 16)
    longitude = np.broadcast_to(t[:, None], (len(t), 3))
    forced = 0.01 * np.exp(1j * t)  # as of an oblate body: it rotates with the orbit
    noise = 1e-3 * (random.normal(size=len(t)) + 1j * random.normal(size=len(t)))
    found = measure.apsides(motion_of(t, longitude, np.stack([0 * forced, forced, noise], axis=1)))
    np.testing.assert_allclose(found.period, 2 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(found.eccentricity, 0, rtol=0, atol=2e-4)
    assert np.isnan([found.precession_rate, found.precession_error, found.anomalistic_period]).all()
    few = measure.apsides(motion_of(t[:40], longitude[:40], np.full((40, 3), 0.1 + 0j)))  # 2.4 revolutions
    np.testing.assert_allclose(few.period, 2 * np.pi, rtol=1e-14)
    assert np.isnan([few.precession_rate, few.eccentricity]).all()


def test_a_pendulum_has_its_rates_in_a_plane_on_a_cone_and_between():
    """In a plane the inclination has half the period 4K(sin²½θ)/ω of the swing, and the azimuth no rate. Nearly in a
    plane it advances by half a revolution in each such period. On a cone it rotates at √(g/l cos θ)."""
    bob, angle = li.systems.pendulum(1.0, 2.0, [0.0, 0.0, -1.0]), 1.1
    start, cone = [np.sin(angle), 0, -np.cos(angle)], np.sqrt(2.0 / np.cos(angle))
    speeds = jnp.array([0.0, 1e-6, -1e-6, cone * np.sin(angle)])
    states = jax.vmap(lambda v: bob.state(start, velocity=jnp.stack([0 * v, v, 0 * v])))(speeds)
    step = li.schemes.compose(li.schemes.sphere_midpoint(bob), 6)
    found = measure.nutation(li.run(step, states, 0.02, 2000, progress=False))
    half = 2 * ellipk(np.sin(angle / 2) ** 2) / np.sqrt(2.0)
    np.testing.assert_allclose(found.period[:3], half, rtol=1e-9)
    assert np.isnan(found.precession_rate[0])
    down = -np.pi / half  # γ points down
    np.testing.assert_allclose(found.precession_rate[1:3], [down, -down], rtol=1e-6)
    np.testing.assert_allclose(found.precession_rate[3], -cone, rtol=1e-9)
    np.testing.assert_allclose(found.least[[0, 3]], [0, angle], rtol=0, atol=1e-9)


def test_a_heavy_top_has_its_two_rates_of_steady_precession():
    """J₁ cos θ Ω² − J₃ω₃ Ω + W = 0 at the inclination θ."""
    theta, spin, J1, J3, weight = 0.8, 6.0, 1.0, 0.5, 1.0
    top = li.systems.heavy_top([J1, J1, J3], [0.0, 0.0, weight], [0.0, 0.0, 1.0])
    exact = jnp.asarray(np.roots([J1 * np.cos(theta), -J3 * spin, weight]))
    tilted = li.groups.so3.exp(jnp.array([theta, 0.0, 0.0]))
    rates = lambda Omega: Omega * jnp.array([0, np.sin(theta), np.cos(theta)])  # noqa: E731
    states = jax.vmap(lambda x: top.state(tilted, angular_velocity=rates(x).at[2].set(spin)))(exact)
    found = measure.nutation(li.run(li.schemes.nystrom(top, 6), states, 0.02, 1000, progress=False))
    np.testing.assert_allclose(found.precession_rate, exact, rtol=1e-11)
    assert np.isnan(found.period).all()
    np.testing.assert_allclose([found.least, found.greatest], theta, rtol=1e-9)


def test_a_symmetric_body_has_its_rates_of_precession_and_rotation():
    """Its axis precesses at |Π|/J₁ about Π, and Π rotates at (J₃ − J₁)/J₁ Ω₃ about the axis; both constant in time."""
    for J3 in (0.4, 1.7):
        body = li.systems.rigid_body([1.0, 1.0, J3])
        run = li.run(
            li.schemes.exact(body),
            body.state(angular_velocity=[0.3, 0.0, 1.1]),
            0.11,
            900,
            save_every=3,
            progress=False,
        )
        found, size = measure.tumbling_periods(run), np.hypot(0.3, J3 * 1.1)
        np.testing.assert_allclose(2 * np.pi / found.precession, size, rtol=1e-12)
        np.testing.assert_allclose(2 * np.pi / found.rotation, abs(J3 - 1) * 1.1, rtol=1e-12)
        np.testing.assert_allclose(measure.rotation_rates(run), np.hypot(0.3, 1.1), rtol=1e-13)
        np.testing.assert_allclose(2 * np.pi / run.periods().rotation, abs(J3 - 1) * 1.1, rtol=1e-12)
