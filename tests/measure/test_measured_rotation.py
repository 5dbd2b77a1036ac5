"""Periods, tilts, poles, rates and librations of one body, against motions in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import measure
from lieint_jax.groups import so3

TILTED = so3.exp(jnp.array([0.5, -0.2, 0.3]))


def go(step, states, dt, num_steps, **options):
    return li.run(step, states, dt, num_steps, progress=False, **options)


def test_the_periods_of_a_tumbling_body_are_those_in_closed_form():
    """Over 12.4 rotations, and, with the fourth power of the duration, over 49.4: observed 1.7e-6 and 7e-9. The short
    axis precesses by one more revolution than the long one in each rotation. The axes of the body are not its principal
    ones."""
    turn = so3.to_matrix(so3.exp(jnp.array([0.4, -0.2, 0.7])))
    body = li.systems.rigid_body(turn @ jnp.diag(jnp.array([1.0, 2.0, 2.4])) @ turn.T)
    step, closed_form = li.schemes.exact(body), jax.jit(body.periods)
    for long_axis, rate in ((True, [1.0, 0.3, 0.2]), (False, [0.2, 0.1, 0.9])):
        state = body.state(TILTED, angular_velocity=turn @ jnp.array(rate))
        exact = closed_form(state)
        precession = 1 / (1 / exact.precession + (0 if long_axis else 1 / exact.rotation))
        for steps, rtol in ((744, 3e-6), (2964, 3e-6 / 4**4)):
            found = measure.tumbling_periods(go(step, state, float(exact.rotation) / 60, steps))
            assert bool(found.long_axis) == long_axis == bool(exact.long_axis)
            np.testing.assert_allclose([found.precession, found.rotation], [precession, exact.rotation], rtol=rtol)


@pytest.fixture(scope="module")
def tumblers():
    """Three bodies of their own inertia: in the long-axis mode, in the short-axis mode, and at rest."""
    bodies = jax.vmap(li.systems.rigid_body)(jnp.array([[1.0, 2.0, 2.4], [2.4, 1.0, 2.0], [2.0, 2.4, 1.0]]))
    rates = jnp.array([[0.9, 0.1, 0.3], [0.9, 0.2, 0.1], [0.0, 0.0, 0.0]])
    states = jax.vmap(lambda body, w: body.state(TILTED, angular_velocity=w))(bodies, rates)
    return go(jax.vmap(li.schemes.so3_midpoint)(bodies), states, 0.05, 6000, own_step=True)


def test_a_body_that_spins_about_an_axis_has_no_periods_of_tumbling():
    """The rounding of its attitude would be a wobble, of any period; one of 1e-9 rad is measured."""
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    rates = jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1e-9, 0.0, 1.0]])
    run = go(li.schemes.exact(body), jax.vmap(lambda w: body.state(TILTED, angular_velocity=w))(rates), 0.2, 1000)
    found = measure.tumbling_periods(run)
    assert np.isnan([found.precession[:2], found.rotation[:2]]).all()
    np.testing.assert_allclose(found.rotation[2], 2 * np.pi, rtol=5e-3)  # Ω₃√((J₃−J₁)(J₃−J₂)/J₁J₂) = 1


def test_periods_of_members_with_their_own_bodies_and_modes(tumblers):
    found = measure.tumbling_periods(tumblers)
    expected = jax.jit(jax.vmap(lambda body, z: body.periods(z)))(
        tumblers.system, jax.tree.map(lambda x: x[0], tumblers.state)
    )
    assert found.long_axis[:2].tolist() == [True, False] == expected.long_axis[:2].tolist()
    np.testing.assert_allclose(found.rotation[:2], expected.rotation[:2], rtol=2e-3)
    np.testing.assert_allclose(found.precession[0], expected.precession[0], rtol=5e-4)
    assert np.isnan([found.precession[2], found.rotation[2]]).all()
    for k in range(3):
        np.testing.assert_allclose(measure.tumbling_periods(tumblers.member(k)), [x[k] for x in found], rtol=1e-12)
    start = jax.tree.map(lambda x: x[0], tumblers.state)
    coarse = measure.tumbling_periods(go(tumblers.step, start, 0.05, 6000, own_step=True, save_every=60))
    assert np.isnan([coarse.precession, coarse.rotation]).all()
    with pytest.raises(ValueError, match="nutation is that of a top"):
        measure.nutation(tumblers)


def test_a_run_on_disk_shows_the_same(tumblers, tmp_path):
    stored = tumblers.save(tmp_path / "tumblers.zarr")
    for function in (measure.tilt, measure.rotation_rates, measure.tumbling_periods, measure.pole):
        np.testing.assert_array_equal(function(stored), function(tumblers))


def test_a_longitude_of_a_pole_is_below_a_whole_revolution():
    """Also an angle that is so little below 0 that with 2π it would be 2π; without rotation both angles are 0."""
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    Pi = jnp.array([[1.0, -1e-17, 0.0], [1.0, -1e-30, 1.0], [-1.0, -1e-17, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    found = measure.pole(go(li.schemes.exact(body), jax.vmap(lambda p: body.state(spatial_momentum=p))(Pi), 0.1, 0))
    np.testing.assert_allclose(found.longitude[0], [0, 0, np.pi, 1.5 * np.pi, 0], rtol=1e-15)
    np.testing.assert_allclose(found.latitude[0], [0, np.pi / 4, 0, 0, 0], rtol=1e-15)


def test_a_spinning_body_has_its_tilt_pole_and_rate():
    """About its z axis, which is tilted: the x axis is 2 arcsin |sin(Ωt/2)| from where it began."""
    body = li.systems.rigid_body([1.0, 2.0, 2.4])
    run = go(li.schemes.exact(body), body.state(TILTED, angular_velocity=[0.0, 0.0, 0.7]), 0.25, 40)
    t = np.asarray(run.t)
    np.testing.assert_allclose(measure.tilt(run, [2.0, 0, 0]), 2 * np.arcsin(abs(np.sin(0.35 * t))), rtol=0, atol=1e-13)
    np.testing.assert_allclose(measure.tilt(run), 0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(measure.rotation_rates(run), 0.7, rtol=1e-14)
    z = np.asarray(so3.Ad(TILTED, jnp.array([0.0, 0.0, 1.0])))
    found = measure.pole(run)
    expected = np.arctan2(z[1], z[0]) % (2 * np.pi), np.arcsin(z[2])
    np.testing.assert_allclose(np.stack(found, axis=1), np.broadcast_to(expected, (41, 2)), rtol=1e-13)

    def follows(t):
        spun = so3.exp(jnp.stack([0 * t, 0 * t, 0.7 * t]))
        return so3.Ad(so3.multiply(TILTED, spun), jnp.array([1.0, 1, 0]))

    np.testing.assert_allclose(measure.tilt(run, [1, 0, 0], follows), np.pi / 4, rtol=1e-12)
    table = np.array([follows(x) for x in t])
    np.testing.assert_allclose(measure.tilt(run, [1, 0, 0], table), np.pi / 4, rtol=1e-12)
    np.testing.assert_allclose(measure.tilt(run, [1e-200, 0, 0], 1e-9 * table), np.pi / 4, rtol=1e-12)
    with pytest.raises(ValueError, match=r"direction must have shape \(3,\) or \(41, 3\)"):
        measure.tilt(run, direction=[[0.0, 0.0, 1.0]])


@pytest.mark.long
def test_tilt_and_rates_of_groups_and_of_several_bodies():
    """In an ideal fluid a body of revolution spins about its axis; two bodies each have a tilt and a rate."""
    swimmer = li.systems.kirchhoff([1.0, 1.0, 2.0])
    state = swimmer.state(velocity=[0.0, 0.0, 0.6, 0.0, 0.0, 1.0])
    run = go(li.schemes.group_midpoint(swimmer, li.maps.exponential), state, 0.1, 20)
    np.testing.assert_allclose(measure.tilt(run, [1, 0, 0]), 0.6 * np.asarray(run.t), rtol=1e-13)
    np.testing.assert_allclose(measure.tilt(run), 0, rtol=0, atol=1e-12)
    for function in (measure.rotation_rates, measure.pole):
        with pytest.raises(ValueError, match="the system must be of rigid bodies"):
            function(run)


@pytest.mark.long
def test_angles_of_satellites_of_their_own_inertia_are_those_of_each_alone():
    """Each by the axis of its own least inertia: x of the first, y of the second."""
    orbit = li.orbits.kepler(1.0, 1.0, 0.1)
    J = jnp.array([[1.0, 1.4, 1.6], [1.6, 1.0, 1.4]])

    def member(J):
        body = li.systems.gravity_gradient(J, orbit)
        state = body.state(so3.exp(jnp.array([0.1, -0.2, 0.3])), angular_velocity=jnp.array([0.1, 0.2, 1.0]), t=0.0)
        return li.schemes.splitting(body), state

    run = go(*jax.vmap(member)(J), 0.05, 40, own_step=True)
    found = measure.orbit_angles(run)
    for k in range(2):
        alone = measure.orbit_angles(run.member(k))
        for many, one in zip(found, alone, strict=True):
            np.testing.assert_allclose(many[:, k], one, rtol=0, atol=1e-15)
    up = jax.vmap(lambda t: orbit(t)[0] / jnp.linalg.norm(orbit(t)[0]))(jnp.asarray(run.t))
    long_axis = jax.vmap(so3.Ad, (0, None))(jnp.asarray(run.state.q[:, 1]), jnp.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(np.cos(found.vertical[:, 1]), jnp.sum(up * long_axis, axis=1), rtol=0, atol=1e-14)


@pytest.mark.long
def test_a_satellite_librates_about_the_vertical(tumblers):
    """In a circle: pitch with √(3(B − A)/C) n; one that spins fast crosses the horizon."""
    J = np.array([1.0, 1.4, 1.6])
    body = li.systems.gravity_gradient(J, li.orbits.kepler(1.0, 1.0, 0.0, inclination=0.5))
    R, rate = measure.orbit_axes(body.orbit, jnp.zeros(()))
    starts = jnp.stack([so3.multiply(so3.from_matrix(R), so3.exp(jnp.array([0.0, 0.0, x]))) for x in (0.05, 0.3)])
    spins = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]])
    states = jax.vmap(lambda q, w: body.state(q, angular_velocity=w, t=0.0, work=0.0))(starts, spins)
    run = go(li.schemes.splitting(body), states, 2 * np.pi / 100, 3000)
    found = measure.orbit_angles(run)
    np.testing.assert_allclose(found.normal, 0, rtol=0, atol=1e-12)
    assert found.vertical[:, 0].max() == pytest.approx(0.05, rel=1e-3)
    assert measure.is_librating(found.vertical).tolist() == [True, False]
    omega = np.sqrt(3 * (J[1] - J[0]) / J[2])
    twice = measure.line(run.t, found.vertical[:, 0] ** 2, 0.2, 0.5)  # the angle has no sign: its square beats twice
    assert 2 * np.pi * twice.frequency == pytest.approx(2 * omega, rel=2e-3)
    np.testing.assert_allclose(np.cross(rate, R, axisb=0).T[:, 2], 0, rtol=0, atol=1e-15)
    ball = li.systems.gravity_gradient([1.0, 1.0, 1.6], body.orbit)
    flat = measure.orbit_angles(go(li.schemes.splitting(ball), states, 0.1, 3))
    assert np.isnan(flat.vertical).all()
    assert not np.isnan(flat.normal).any()
    with pytest.raises(ValueError, match="the body must have an orbit"):
        measure.orbit_angles(tumblers)
    with pytest.raises(ValueError, match="periods are those of a free body"):
        measure.tumbling_periods(run)


def test_the_orbit_s_axes_rotate_at_the_returned_rate():
    """Ṙ = ω × R by forward differentiation, and the columns are r̂, the direction of motion and the normal."""
    orbit = li.orbits.kepler(2.0, 1.5, 0.4, 0.5, node=0.3, periapsis=0.9)
    t = jnp.array(0.7)
    (R, spin), (rate, _) = jax.jvp(jax.jit(lambda t: measure.orbit_axes(orbit, t)), (t,), (jnp.ones(()),))
    np.testing.assert_allclose(np.cross(spin, R, axisb=0, axisc=0), rate, rtol=0, atol=3e-15)  # 7e-16
    position, velocity = (np.asarray(x) for x in orbit(t))
    np.testing.assert_allclose(R[:, 0], position / np.linalg.norm(position), rtol=0, atol=1e-15)
    np.testing.assert_allclose(R.T @ R, np.eye(3), rtol=0, atol=1e-15)
    assert R[:, 1] @ velocity > 0
    assert np.cross(position, velocity) @ R[:, 2] > 0
