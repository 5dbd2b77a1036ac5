"""Kepler's orbits against mpmath, in 40 digits: positions, velocities, and derivatives in every element."""

import dataclasses

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mp

from lieint_jax import orbits

ELEMENTS = ("mu", "semi_major_axis", "eccentricity", "inclination", "node", "periapsis", "periapsis_time")


def exact(mu, a, e, inclination, node, periapsis, time, t):
    """Position and velocity, (6,), by bracketing the anomaly."""
    size = abs(a)
    M = mpmath.sqrt(mu / size**3) * (t - time)
    if e < 1:
        M -= 2 * mp.pi * mpmath.nint(M / (2 * mp.pi))
        E = mpmath.findroot(lambda E: E - e * mpmath.sin(E) - M, (M - e, M + e), solver="anderson", tol=1e-60)
        x, y, r = mpmath.cos(E) - e, mpmath.sqrt(1 - e * e) * mpmath.sin(E), 1 - e * mpmath.cos(E)
        vx, vy = -mpmath.sin(E) / r, mpmath.sqrt(1 - e * e) * mpmath.cos(E) / r
    else:
        bound = mpmath.asinh(abs(M) / (e - 1)) + 1
        f = lambda E: e * mpmath.sinh(E) - E - M  # noqa: E731
        E = mpmath.findroot(f, (-bound, bound), solver="anderson", tol=1e-50, maxsteps=400)
        x, y, r = e - mpmath.cosh(E), mpmath.sqrt(e * e - 1) * mpmath.sinh(E), e * mpmath.cosh(E) - 1
        vx, vy = -mpmath.sinh(E) / r, mpmath.sqrt(e * e - 1) * mpmath.cosh(E) / r
    speed = mpmath.sqrt(mu / size)

    def turned(x, y):
        v = [x, y, mp.mpf(0)]
        for angle, i, j in ((periapsis, 0, 1), (inclination, 1, 2), (node, 0, 1)):
            c, s = mpmath.cos(angle), mpmath.sin(angle)
            v[i], v[j] = c * v[i] - s * v[j], s * v[i] + c * v[j]
        return v

    return [size * k for k in turned(x, y)] + [speed * k for k in turned(vx, vy)]


@jax.jit
def position_and_velocity(elements, t):
    return jnp.concatenate(orbits.Kepler(*elements)(t))


CASES = [(e, 1.3 if e < 1 else -1.3) for e in (0.0, 0.1, 0.5, 0.9, 0.99, 1.01, 1.5, 4.2)]
ANGLES = (0.3, 2.0, -1.1)


@pytest.mark.parametrize(("e", "a"), CASES)
def test_positions_and_velocities_agree_with_40_digits(e, a):
    """To 1e-13 of r and of v (seen: 2e-15), at times of both signs, over many sizes."""
    times = np.concatenate([[0.0], np.geomspace(1e-9, 30, 12), -np.geomspace(1e-6, 20, 8)])
    for t in times + 0.25:
        elements = (1.7, a, e, *ANGLES, 0.25)
        with mp.workdps(40):
            wanted = exact(*map(mp.mpf, map(float, elements)), mp.mpf(float(t)))
            ours = np.asarray(position_and_velocity(tuple(map(jnp.asarray, elements)), t))
            error = [float(x - mp.mpf(float(y))) for x, y in zip(wanted, ours, strict=True)]
        for part in (slice(3), slice(3, 6)):
            assert np.linalg.norm(error[part]) < 1e-13 * np.linalg.norm(ours[part])


@pytest.mark.slow
@pytest.mark.parametrize(("e", "a"), [(0.5, 1.3), (0.99, 1.3), (1.01, -1.3), (4.2, -1.3)])
def test_derivatives_by_every_element_and_time_agree_with_differences(e, a):
    """Forward and reverse, against differences in 60 digits; two times, near periapsis and far from it."""
    elements = (1.7, a, e, *ANGLES, 0.25)
    forward, reverse = (
        jax.jit(d(lambda x: position_and_velocity(tuple(x[:7]), x[7]))) for d in (jax.jacfwd, jax.jacrev)
    )
    for t in (0.3, -6.0):
        x = np.array([*elements, t])
        J = np.asarray(forward(x))
        np.testing.assert_allclose(J, reverse(x), rtol=1e-12, atol=1e-12 * np.abs(J).max())
        with mp.workdps(60):
            at, h = [mp.mpf(float(v)) for v in x], mp.mpf(10) ** -20
            for k in range(8):
                ahead, behind = (exact(*(v + s * h * (j == k) for j, v in enumerate(at))) for s in (1, -1))
                slope = np.array([float((p - m) / (2 * h)) for p, m in zip(ahead, behind, strict=True)])
                assert np.abs(J[:, k] - slope).max() < 1e-11 * np.abs(slope).max(), ELEMENTS[k : k + 1]


@pytest.mark.long
@pytest.mark.parametrize(("e", "a"), [(0.3, 2.0), (1.4, -2.0)])
def test_the_acceleration_of_an_orbit_is_that_of_gravity(e, a):
    """By autodiff: the velocity is ẋ, and ẍ = −μx/r³."""
    orbit = orbits.kepler(3.0, a, e, 0.4, node=1.0, periapsis=2.0, periapsis_time=0.5)
    (x, v), (x_dot, v_dot) = jax.jit(lambda t: jax.jvp(orbit, (t,), (1.0,)))(1.7)
    np.testing.assert_allclose(x_dot, v, rtol=1e-14)
    np.testing.assert_allclose(v_dot, -3.0 * x / np.linalg.norm(x) ** 3, rtol=1e-13, atol=2e-15)
    np.testing.assert_allclose(v @ v / 2 - 3.0 / np.linalg.norm(x), -3.0 / (2 * a), rtol=1e-14)  # vis viva


@pytest.mark.long
def test_an_orbit_repeats_after_a_period_and_ellipses_and_hyperbolas_batch_together():
    orbit = orbits.kepler(1.0, 2.0, 0.6)
    period = 2 * np.pi / float(orbit.mean_motion)
    np.testing.assert_allclose(orbit(0.4 + 100 * period)[0], orbit(0.4)[0], rtol=0, atol=1e-12)
    a, e = jnp.array([1.0, -1.0, 3.0]), jnp.array([0.2, 1.7, 0.9])
    many = jax.jit(jax.vmap(lambda a, e: orbits.kepler(1.0, a, e)(2.0)[0]))(a, e)
    alone = [orbits.kepler(1.0, *x)(2.0)[0] for x in zip(a.tolist(), e.tolist(), strict=True)]
    np.testing.assert_allclose(many, alone, rtol=1e-14)
    slopes = jax.jit(jax.vmap(jax.grad(lambda a, e: orbits.kepler(1.0, a, e)(2.0)[0][0], argnums=(0, 1))))(a, e)
    assert np.isfinite(slopes).all()


@pytest.mark.long
def test_an_orbit_of_a_known_kind_compiles_the_equation_of_that_kind_only():
    """As an argument of a jitted function too. Elements of the other kind that are put into it there give NaN."""
    at = jax.jit(lambda orbit: jnp.concatenate(orbit(0.7)))
    ellipse, hyperbola = (orbits.kepler(1.7, a, e, 0.3, node=2.0, periapsis=-1.1) for a, e in ((1.3, 0.5), (-1.3, 1.5)))
    for orbit, other in ((ellipse, hyperbola), (hyperbola, ellipse)):
        either = dataclasses.replace(orbit, closed=None)
        branches = [str(jax.make_jaxpr(at)(x)).count(" cond[") for x in (orbit, either)]
        assert branches == [0, 1]
        np.testing.assert_allclose(at(orbit), at(either), rtol=2e-15)
        wrong = dataclasses.replace(other, closed=orbit.closed)
        assert np.isnan(at(wrong)).all()
        np.testing.assert_array_equal(jnp.concatenate(wrong(0.7)), jnp.concatenate(other(0.7)))  # known outside of jit


def test_orbits_in_float32_have_its_accuracy():
    orbit = orbits.kepler(*(jnp.float32(x) for x in (1.7, 1.3, 0.9)))
    position, velocity = orbit(jnp.float32(0.7))
    assert position.dtype == velocity.dtype == jnp.float32
    np.testing.assert_allclose(position, orbits.kepler(1.7, 1.3, 0.9)(0.7)[0], rtol=0, atol=3e-6)


NO_ORBITS = [
    (1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -0.1), (1.0, -1.0, -1.5), (1.0, -1.0, 0.5), (1.0, 1.0, 2.0),
    (1.0, 0.0, 0.5), (1.0, 0.0, 2.0), (0.0, 1.0, 0.5), (-1.0, 1.0, 0.5), (-1.0, -1.0, 2.0), (1.0, 1.0, np.nan),
]  # fmt: skip


@pytest.mark.long
def test_traced_elements_of_no_orbit_give_nan_and_do_not_touch_their_neighbors():
    """Positions, velocities and their derivatives; those of two orbits in the same batch are finite."""

    @jax.jit
    @jax.vmap
    def motion(x):
        def orbit(x):
            return jnp.concatenate(orbits.kepler(*x[:3])(x[3]))

        return orbit(x), jax.jacfwd(orbit)(x), jax.jacrev(orbit)(x), orbits.kepler(*x[:3]).mean_motion

    x = np.array([*NO_ORBITS, (1.0, 1.0, 0.5), (1.0, -1.0, 2.0)])
    for t in (0.0, 0.7):
        values, forward, reverse, mean_motion = motion(np.insert(x, 3, t, axis=1))
        assert np.isnan(values[:-2, :2]).all()
        assert np.isnan(mean_motion[:-2]).all()
        for slopes in (forward, reverse):
            assert np.isnan(slopes[:-2, :2, 3]).all()
        for good in (values, forward, reverse, mean_motion):
            assert np.isfinite(good[-2:]).all()


@pytest.mark.long
def test_the_anomaly_of_any_hyperbola_is_right_to_round_off():
    """e − 1 from 1e-12 to 1e15 and M from 1e-12 to 1e12, against Newton's method in 50 digits; seen: 3.5e-16."""
    rng = np.random.default_rng(1)
    e, M = 1 + 10 ** rng.uniform(-12, 15, 200), 10 ** rng.uniform(-12, 12, 200)
    ours = jax.jit(jax.vmap(orbits._anomaly.hyperbolic_anomaly))(M, e, e - 1)
    with mp.workdps(50):
        for m, x, found in zip(*(map(mp.mpf, map(float, v)) for v in (M, e, ours)), strict=True):
            E = found
            for _ in range(4):
                E -= (x * mpmath.sinh(E) - E - m) / (x * mpmath.cosh(E) - 1)
            assert abs(found - E) < 6e-16 * E


def test_a_slow_flyby_is_right_to_round_off():
    """e − 1 = 1e-2 to 1e-10, of which e has 14 to 6 digits; observed: 8e-16 of the radius and of the speed."""
    move = jax.jit(lambda v, t: orbits.hyperbola(1.5, 0.75, v)(t))
    for speed, t in ((0.1, 3.0), (0.001, -1.0), (1e-5, 20.0)):
        with mp.workdps(40):
            square = mp.mpf(speed) ** 2
            wanted = exact(mp.mpf(1.5), -1.5 / square, 1 + square / 2, 0, 0, 0, 0, mp.mpf(t))
        found = move(speed, t)
        for x, y in zip(found, (wanted[:3], wanted[3:]), strict=True):
            size = float(mpmath.norm(y))
            assert max(abs(float(mp.mpf(float(a)) - b)) for a, b in zip(x, y, strict=True)) < 4e-15 * size


def test_elements_of_a_state_near_a_parabola_have_the_digits_that_e_lacks():
    """|1 − e| = 7e-9 of a state at the periapsis 0.7, which e has to 8 digits; observed: 2e-16."""
    position, velocity = np.array([0.0, 0.7, 0.0]), np.array([-1.0, 0.0, 0.0])
    move = jax.jit(lambda v, t: orbits.from_state(1.0, position, v, 0.25).elements(t)[0])
    for alpha in (1e-8, -1e-8):
        v = np.sqrt(2 / 0.7 - alpha) * velocity
        with mp.workdps(40):
            r = mp.mpf(float(position[1]))
            alpha = 2 / r - mp.mpf(float(v[0])) ** 2
            x, y = exact(mp.mpf(1), 1 / alpha, 1 - alpha * r, 0, 0, 0, 0, mp.mpf(2))[:2]
        np.testing.assert_allclose(move(v, 2.25), [float(-y), float(x), 0.0], rtol=0, atol=2e-15)
    near = orbits.from_state(1.0, position, v).elements
    other = dataclasses.replace(near, eccentricity=jnp.array(1.5))  # whose digits are not those of the other e
    np.testing.assert_array_equal(other(0.7)[0], dataclasses.replace(other, rest=None)(0.7)[0])


FLYBY = orbits.kepler(398600.4418, -28400.0, 2.35)


@pytest.mark.slow
@pytest.mark.parametrize(("t0", "t1"), [(-345600.0, 345600.0), (50000.0, -345600.0)])
def test_graded_times_are_shorter_near_the_center(t0, t1):
    """Each step times r₀/r + c is the same: to 0.07 % with 128 steps, by the middle of each step."""
    times = orbits.graded_times(FLYBY, t0, t1, 128)
    assert times.shape == (129,)
    assert (times[0], times[-1]) == (t0, t1)
    sizes, middle = np.diff(times), (times[1:] + times[:-1]) / 2
    assert (np.sign(sizes) == np.sign(t1 - t0)).all()
    r = np.array([np.linalg.norm(FLYBY(t)[0]) for t in middle])
    s = sizes * (38340.0 / r + 0.15)
    assert s.std() / abs(s.mean()) < 2e-3
    assert abs(sizes).max() / abs(sizes).min() > 5
