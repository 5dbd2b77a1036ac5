"""Orbits from states and tables, secular rates, frames, the Earth's field, air and shadow, against other sources."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import orbits
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

ORBIT = orbits.kepler(1.3, 1.1, 0.1, 0.7, node=0.4, periapsis=0.2, periapsis_time=0.1)
LOW = orbits.kepler(orbits.EARTH_GM, 6878.137, 0.001, 0.9)


@pytest.mark.parametrize(("a", "e"), [(1.1, 0.6), (-1.1, 1.4), (2.0, 1e-3)])
def test_a_state_gives_the_orbit_that_its_elements_give(a, e):
    """Observed: 2e-15 over a revolution. The elements come back too."""
    orbit = orbits.kepler(1.3, a, e, 0.7, node=0.4, periapsis=0.2, periapsis_time=0.1)
    found = orbits.from_state(1.3, *orbit(0.5), t=0.5)
    times = jnp.array([-3.0, 0.0, 0.49, 0.5, 0.51, 2.0, 7.0])
    for x, y in zip(jax.vmap(orbit)(times), jax.vmap(found)(times), strict=True):
        np.testing.assert_allclose(y, x, rtol=0, atol=4e-14)
    for x, y in zip(jax.tree.leaves(orbit), jax.tree.leaves(found.elements), strict=True):
        assert float(y) == pytest.approx(float(x), abs=1e-13 / e)
    assert float(found.eccentricity) == pytest.approx(e, abs=1e-13)
    traced = jax.jit(lambda r, v: orbits.from_state(1.3, r, v, 0.5)(2.0)[0])(*orbit(0.5))
    np.testing.assert_allclose(traced, orbit(2.0)[0], rtol=0, atol=1e-14)


def test_a_circle_is_no_special_case_of_a_state():
    """Derivatives by the state at a circle in the xy-plane are those of Clohessy and Wiltshire."""
    r, v, t = jnp.array([1.0, 0, 0]), jnp.array([0, 1.0, 0]), 2.0
    orbit = orbits.from_state(1.0, r, v)
    np.testing.assert_allclose(orbit(t)[0], [np.cos(t), np.sin(t), 0], rtol=0, atol=1e-15)
    assert [float(x) for x in jax.tree.leaves(orbit.elements)] == pytest.approx([1, 1, 0, 0, 0, 0, 0], abs=1e-15)
    by_r, by_v = jax.jit(jax.jacobian(lambda r, v: orbits.from_state(1.0, r, v)(t)[0], (0, 1)))(r, v)
    c, s = np.cos(t), np.sin(t)
    hill = np.array([[4 - 3 * c, 0, 0], [6 * (s - t), 1, 0], [0, 0, c]])  # in axes that rotate with the orbit
    by_rate = np.array([[s, 2 * (1 - c), 0], [2 * (c - 1), 4 * s - 3 * t, 0], [0, 0, s]])
    rotated = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    spin = np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 0, 0]])  # v = ṙ + ω × r
    np.testing.assert_allclose(by_v, rotated @ by_rate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_r, rotated @ (hill - by_rate @ spin), rtol=0, atol=1e-14)


def hyperbola_in_many_digits(r, v, t):
    """The position for μ = 1, to 40 digits: x by bisection."""
    with mpmath.workdps(50):
        r, v = ([mpmath.mpf(float(x)) for x in y] for y in (r, v))
        size = mpmath.sqrt(mpmath.fdot(r, r))
        a, t = 1 / (mpmath.fdot(v, v) - 2 / size), mpmath.mpf(float(t))
        c, s = 1 + size / a, mpmath.fdot(r, v) / mpmath.sqrt(a)
        low, high = mpmath.mpf(-60), mpmath.mpf(60)
        for _ in range(180):
            x = (low + high) / 2
            early = c * mpmath.sinh(x) + s * (mpmath.cosh(x) - 1) - x < t / mpmath.sqrt(a**3)
            low, high = (x, high) if early else (low, x)
        rest = mpmath.cosh(x) - 1
        f, g = 1 - a / size * rest, mpmath.sqrt(a**3) * ((c - 1) * mpmath.sinh(x) + s * rest)
        return np.array([float(f * p + g * q) for p, q in zip(r, v, strict=True)])


@pytest.mark.parametrize("e", [1.3, 3.0])
def test_a_hyperbola_from_far_to_far(e):
    """From 4500 a on one side to the other, to the center, and back; observed: 9 ulp of a(1 + r₀r/a²)."""
    orbit = orbits.kepler(1.0, -1.0, e, 0.3, node=0.4, periapsis=0.2)
    times = np.array([-4456.0, -600.0, -10.0, 0.0, 10.0, 4456.0])
    starts = jax.jit(jax.vmap(orbit))(times)
    found = jax.jit(jax.vmap(lambda r, v, t0: jax.vmap(orbits.from_state(1.0, r, v, t0))(times)[0]))(*starts, times)
    for r, v, t0, row in zip(*starts, times, found, strict=True):
        for t, x in zip(times, row, strict=True):
            exact = hyperbola_in_many_digits(r, v, t - t0)
            allowed = 20 * np.finfo(float).eps * (1 + np.linalg.norm(r) * np.linalg.norm(exact))
            assert np.abs(x - exact).max() <= allowed


def universal_in_many_digits(r, v, t):
    """The position for μ = 1 on any orbit, to 40 digits, by Stumpff's functions of z = χ²/a and bisection."""
    with mpmath.workdps(50):
        r, v = ([mpmath.mpf(float(x)) for x in y] for y in (r, v))
        size, t = mpmath.sqrt(mpmath.fdot(r, r)), mpmath.mpf(float(t))
        alpha, along = 2 / size - mpmath.fdot(v, v), mpmath.fdot(r, v)

        def stumpff(z, k):
            return mpmath.nsum(lambda n: (-z) ** int(n) / mpmath.factorial(2 * int(n) + k), [0, 40], method="d")

        low, high = mpmath.mpf(-8), mpmath.mpf(8)
        for _ in range(160):
            x = (low + high) / 2
            square, z = x * x, alpha * x * x
            passed = along * square * stumpff(z, 2) + (1 - alpha * size) * x**3 * stumpff(z, 3) + size * x
            low, high = (x, high) if passed < t else (low, x)
        f, g = 1 - square / size * stumpff(z, 2), t - x**3 * stumpff(z, 3)
        return np.array([float(f * p + g * q) for p, q in zip(r, v, strict=True)])


@pytest.mark.parametrize("excess", [-1e-4, -1e-9, 1e-4, 1e-9])
def test_a_state_near_a_parabola(excess):
    """From before to after the periapsis, to 20 ulp of the position; observed: 11."""
    move = jax.jit(lambda mu, r, v, t: orbits.from_state(mu, r, v)(t)[0])
    for angle, t in ((-1.6, 3.0), (-0.3, 9.0), (0.0, -0.1), (0.2, 0.5), (1.4, -2.0)):
        e, c, s = 1 + excess, np.cos(angle), np.sin(angle)
        r, v = (1 + e) / (1 + e * c) * np.array([c, s, 0]), np.array([-s, e + c, 0]) / np.sqrt(1 + e)
        exact = universal_in_many_digits(r, v, t)
        np.testing.assert_allclose(move(1.0, r, v, t), exact, rtol=0, atol=20 * np.spacing(np.linalg.norm(exact)))


def test_a_table_is_a_smooth_orbit_of_order_four():
    errors = []
    for n in (100, 200):
        times = np.linspace(0.0, 6.0, n + 1)
        entries = jax.jit(jax.vmap(ORBIT))(times)
        table = orbits.table(times, *entries)
        t = np.linspace(0.0, 6.0, 1111)
        r, v = jax.jit(jax.vmap(table))(t)
        rate = jax.jit(jax.vmap(lambda t, table=table: jax.jvp(lambda t: table(t)[0], (t,), (1.0,))[1]))(t)
        np.testing.assert_allclose(rate, v, rtol=0, atol=1e-12)
        errors.append(np.abs(r - jax.vmap(ORBIT)(t)[0]).max())
        np.testing.assert_allclose(jax.vmap(table)(times)[1], entries[1], rtol=0, atol=1e-12)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.1)


def test_a_long_table_is_read_by_machine_code():
    times = np.linspace(0.0, 6.0, 1000)
    table = orbits.table(times, *jax.jit(jax.vmap(ORBIT))(times))
    body = li.systems.gravity_gradient([1.0, 2.0, 2.5], table, mu=1.3)
    step, state = li.schemes.splitting(body), body.state(angular_velocity=[0.1, 0.2, 1.0])
    assert li.explain(lambda z: li.integrate(step, z, 0.05, 100), state).engines == {"native"}


def test_a_time_outside_of_a_table_is_an_error_or_a_failed_step():
    times = np.linspace(0.0, 1.0, 11)
    table = orbits.table(times, *jax.vmap(ORBIT)(times))
    with pytest.raises(ValueError, match=r"the table has times from 0 to 1, got t = 1\.5"):
        table(1.5)
    assert np.isnan(jax.jit(table)(1.5)[0]).all()
    body = li.systems.torqued_body([1.0, 2.0, 2.5], li.torques.gravity_gradient(table, [1.0, 2.0, 2.5], mu=1.3))
    path = li.integrate(li.schemes.torqued_midpoint(body), body.state(angular_velocity=[0.1, 0.2, 0.3]), 0.3, 5)
    assert path.info.converged.tolist() == [True, True, True, True, False, False]


def test_secular_rates_are_the_drift_of_an_integrated_orbit():
    """Of the node over 15 revolutions, by DOP853 with J₂ alone; the first order is right to about J₂."""
    mu, a, e, i = orbits.EARTH_GM, 7178.137, 1e-3, 1.0
    orbit = orbits.secular_j2(mu, a, e, i, node=0.3)
    period = float(2 * np.pi / orbit.mean_motion)
    j2, R = orbits.EARTH_J2, orbits.EARTH_RADIUS

    def rhs(t, y):
        r = y[:3]
        d = np.linalg.norm(r)
        z = 5 * (r[2] / d) ** 2
        pull = -mu / d**3 * r - 1.5 * j2 * mu * R**2 / d**5 * r * np.array([1 - z, 1 - z, 3 - z])
        return np.concatenate([y[3:], pull])

    y = solve_ivp(rhs, (0, 15 * period), np.concatenate(orbit(0.0)), "DOP853", rtol=1e-9).y[:, -1]
    h = np.cross(y[:3], y[3:])
    node = np.arctan2(h[0], -h[1])
    assert (node - 0.3) / (15 * period) == pytest.approx(float(orbit.rates[0]), rel=0.01)
    # heliosynchronous: 360° in a tropical year at 98.6° (Vallado 2013, 11.4.1)
    day = orbits.secular_j2(mu, a, 0.0, np.deg2rad(98.6)).rates[0] * 86400
    assert np.rad2deg(float(day)) == pytest.approx(360 / 365.2422, rel=2e-3)
    t = jnp.asarray(4000.0)
    rate = jax.jvp(lambda t: orbit(t)[0], (t,), (jnp.ones_like(t),))[1]
    np.testing.assert_allclose(orbit(t)[1], rate, rtol=0, atol=1e-13)


def test_the_local_frame_points_down_and_rotates_as_it_says():
    frame = orbits.lvlh(ORBIT)
    t, dt = 0.8, 1e-4
    r, v = ORBIT(t)
    R = frame.matrix(t)
    np.testing.assert_allclose(R.T @ R, np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(R[:, 2], -r / np.linalg.norm(r), rtol=0, atol=1e-15)
    assert float(v @ R[:, 0]) > 0
    np.testing.assert_allclose(so3.to_matrix(frame(t)), R, rtol=0, atol=1e-15)
    turned = so3.log(so3.multiply(so3.inverse(frame(t - dt)), frame(t + dt))) / (2 * dt)
    np.testing.assert_allclose(frame.angular_velocity(t), turned, rtol=0, atol=1e-8)
    circle = orbits.kepler(1.0, 1.0, 0.0, 0.5)
    np.testing.assert_allclose(orbits.lvlh(circle).angular_velocity(0.3), [0, -1, 0], rtol=0, atol=1e-15)


@pytest.mark.quick
def test_a_shared_function_has_the_values_but_no_leaves():
    """Two of the same numbers are equal, so a program is compiled once for them; a frame remains a frame."""
    orbit, other = (orbits.kepler(398600.4418, 7000.0 + height, 0.01, 0.9) for height in (0.0, 1.0))
    frame, t = orbits.lvlh(orbit), jnp.asarray(1234.5)
    for function in (orbit, frame):
        same, again = orbits.shared(function), orbits.shared(function)
        assert not jax.tree.leaves(same)
        assert jax.tree.structure(same) == jax.tree.structure(again)
        for found, expected in zip(jax.tree.leaves(same(t)), jax.tree.leaves(function(t)), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)
    assert jax.tree.structure(orbits.shared(orbit)) != jax.tree.structure(orbits.shared(other))
    rate = orbits.shared(frame).angular_velocity(t)
    np.testing.assert_allclose(rate, frame.angular_velocity(t), rtol=0, atol=1e-16)


@pytest.mark.quick
def test_days_and_the_rotation_of_the_earth():
    """IERS Conventions 2010: the angle at J2000 is 0.7790572732640 of a turn; it gains a turn in a sidereal day."""
    assert orbits.julian_date(2000, 1, 1, 12.0) == 2451545.0
    assert orbits.julian_date(2025, 1, 1) == 2460676.5
    angle = orbits.earth_rotation_angle
    assert float(angle(2451545.0)) == pytest.approx(2 * np.pi * 0.7790572732640, abs=1e-14)
    later = float(angle(2451545.0 + 86164.098903691 / 86400))  # a stellar day
    assert later == pytest.approx(2 * np.pi * 0.7790572732640, abs=1e-8)


def test_the_field_is_the_gradient_of_its_potential_and_rotates():
    """In axes of the Earth: V = R(R/r)²[g₁⁰ cos θ + (g₁¹ cos φ + h₁¹ sin φ) sin θ], b = −∇V."""
    date = orbits.julian_date(2025, 1, 1)
    field = orbits.earth_field(LOW, date)
    g11, h11, g10 = np.array([-1410.3, 4545.5, -29350.0]) * 1e-9  # IGRF-14, 2025.0
    np.testing.assert_allclose(field.coefficients, [g11, h11, g10], rtol=1e-12)

    def V(x):
        r = jnp.linalg.norm(x)
        cos, phi = x[2] / r, jnp.arctan2(x[1], x[0])
        return (
            6371.2 * (6371.2 / r) ** 2 * (g10 * cos + (g11 * jnp.cos(phi) + h11 * jnp.sin(phi)) * jnp.sqrt(1 - cos**2))
        )

    t = 2000.0
    angle = float(orbits.earth_rotation_angle(date)) + orbits.EARTH_RATE * t
    to_space = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    wanted = -to_space @ jax.grad(V)(to_space.T @ LOW(t)[0])
    np.testing.assert_allclose(field(t), wanted, rtol=0, atol=1e-18)
    assert 1.8e-5 < np.linalg.norm(wanted) < 5e-5  # tesla
    halfway = orbits.earth_field(LOW, orbits.julian_date(2022, 7, 2, 12.0)).coefficients[2]
    assert float(halfway) == pytest.approx(1e-9 * (-29403.41 - 29350.0) / 2, rel=1e-7)


def test_the_air_thins_with_height_and_rotates_with_the_earth():
    air = orbits.atmosphere(LOW, 6.967e-13, 63.822, 500.0)
    density, velocity = air(1000.0)
    r, v = LOW(1000.0)
    height = np.linalg.norm(r) - 6378.137
    assert float(density) == pytest.approx(6.967e-13 * np.exp(-(height - 500) / 63.822), rel=1e-10, abs=0)
    np.testing.assert_allclose(velocity, v - np.cross([0, 0, orbits.EARTH_RATE], r), rtol=0, atol=1e-14)


@pytest.mark.quick
def test_the_sun_stands_where_seasons_begin():
    """Equinox 2024 March 20, 3:06 UT, and solstice June 20, 20:51 UT (US Naval Observatory), to 0.01°."""
    spring = orbits.sun_direction(orbits.julian_date(2024, 3, 20, 3 + 6 / 60))(0.0)
    np.testing.assert_allclose(spring, [1, 0, 0], rtol=0, atol=2e-4)
    summer = orbits.sun_direction(orbits.julian_date(2024, 6, 20))((20 + 51 / 60) * 3600.0)
    np.testing.assert_allclose(summer, [0, np.cos(np.deg2rad(23.436)), np.sin(np.deg2rad(23.436))], rtol=0, atol=2e-4)


def test_shadows_of_a_cylinder_and_of_a_cone():
    circle = orbits.kepler(1.0, 1.5, 0.0)
    sun = jnp.array([1.0, 0, 0])
    t = np.linspace(0, 2 * np.pi * 1.5**1.5, 4001)
    dark = 1 - jax.jit(jax.vmap(orbits.eclipse(circle, sun, 1.0, "cylindrical")))(t)
    assert float(dark.mean()) == pytest.approx(np.arcsin(1 / 1.5) / np.pi, abs=1e-3)
    cone = jax.jit(jax.vmap(orbits.eclipse(circle, sun, 1.0, angle=0.1)))
    light = np.asarray(cone(t))
    assert light.min() == 0
    assert light.max() == 1
    # the covered part of a disc, by counting the cells of a grid
    k = np.flatnonzero((light > 0.2) & (light < 0.9))[0]
    r = np.asarray(circle(t[k])[0])
    c = np.arccos(-r[0] / 1.5)
    x, y = np.meshgrid(*[np.linspace(-0.1, 0.1, 1501)] * 2)
    disc, earth = x**2 + y**2 < 0.01, (x - c) ** 2 + y**2 < np.arcsin(1 / 1.5) ** 2
    assert light[k] == pytest.approx(1 - (disc & earth).sum() / disc.sum(), abs=2e-3)
    assert np.isfinite(jax.vmap(jax.grad(orbits.eclipse(circle, sun, 1.0)))(t[::40])).all()


@pytest.mark.parametrize("shadow", ["conical", "cylindrical"])
def test_the_shadow_of_a_direction_does_not_depend_on_its_length(shadow):
    """That of a function of time, which is not checked when the eclipse is made."""
    circle, t = orbits.kepler(1.0, 1.5, 0.0), np.linspace(0, 2 * np.pi * 1.5**1.5, 401)
    light = [
        jax.jit(jax.vmap(orbits.eclipse(circle, sun, 1.0, shadow)))(t)
        for sun in ([1.0, 0, 0], lambda t: jnp.array([2.0, 0, 0]), lambda t: jnp.array([0.3, 0, 0]))
    ]
    assert 0 < float(light[0].mean()) < 1
    np.testing.assert_allclose(light[1:], [light[0]] * 2, rtol=0, atol=1e-12)
