"""Two bodies about one another, against Kepler's motion and small oscillations in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.special import jvp

import lieint_jax as li
from lieint_jax import measure
from lieint_jax.groups import so3


def go(step, states, dt, num_steps, **options):
    return li.run(step, states, dt, num_steps, progress=False, **options)


MU, E = 1.0, 0.05
SATELLITE = np.array([0.9, 1.0, 1.05]) * 1e-14  # B − A = C/10.5; of mass 1e-9 its size is 0.003 of the distance


@pytest.fixture(scope="module")
def pairs():
    """A sphere and a small triaxial moon, locked but for a swing of 0.02; and two spheres in an orbit of e = 0.05."""
    masses, inertias = jnp.array([1.0, 1e-9]), jnp.array([[0.4, 0.4, 0.4], SATELLITE])
    round_moon = jnp.array([[0.4, 0.4, 0.4], [1e-14] * 3])

    @jax.vmap
    def make(J, e, swing):
        bodies = li.systems.rigid_bodies(masses, J, li.potentials.maccullagh(MU, masses, J))
        speed = jnp.sqrt(MU * (1 + 1e-9) * (1 + e) / (1 - e))  # at the distance 1 − e, a = 1
        x, v = jnp.array([1.0, 0, 0]) * (1 - e), jnp.array([0.0, 1, 0]) * speed
        share = jnp.array([-1e-9, 1.0])[:, None] / (1 + 1e-9)
        q = jnp.stack([jnp.array([1.0, 0, 0, 0]), so3.exp(jnp.array([0.0, 0, 1]) * swing)])
        spin = jnp.array([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0]])
        step = li.schemes.compose(li.schemes.splitting(bodies), 4)
        return step, bodies.state(share * x, q, velocities=share * v, angular_velocities=spin)

    step, states = make(jnp.stack([jnp.asarray(inertias), round_moon]), jnp.array([0.002, E]), jnp.array([0.02, 0.0]))
    return go(step, states, 2 * np.pi / 80, 80 * 60, own_step=True, save_every=2)


@pytest.mark.long
def test_the_orbit_of_two_spheres_is_kepler_s(pairs):
    """The pericenter rests, up to the errors of the scheme, 8e-6 of the eccentricity.

    The distance has the line 2J₁′(e) a e, which is resolved to 1e-5 in 60 revolutions.
    """
    motion = measure.relative_motion(pairs)
    assert motion.distance.shape == (2401, 2)
    found = measure.apsides(motion)
    np.testing.assert_allclose(found.period, 2 * np.pi, rtol=3e-5)
    np.testing.assert_allclose(found.anomalistic_period[1], found.period[1], rtol=3e-5)
    np.testing.assert_allclose(found.precession_rate[1], 0, rtol=0, atol=3e-5)
    np.testing.assert_allclose(found.eccentricity[1], E, rtol=2e-5)
    line = measure.line(motion.t, motion.distance[:, 1], 0.9 / (2 * np.pi), 1.1 / (2 * np.pi))
    np.testing.assert_allclose(line, [1 / (2 * np.pi), 2 * E * jvp(1, E)], rtol=5e-5)
    orbit = li.orbits.kepler(1.0, 1.0, E)
    exact = np.array([np.linalg.norm(orbit(t)[0]) for t in np.linspace(0, found.anomalistic_period[1], 9)])
    at = np.interp(np.linspace(0, 2 * np.pi, 9), motion.t, motion.distance[:, 1])
    np.testing.assert_allclose(at, exact, rtol=0, atol=3e-6)
    for name in ("inclination", "out_of_plane", "obliquity"):
        np.testing.assert_allclose(getattr(motion, name), 0, rtol=0, atol=1e-7)
    rates = [measure.mean_rate(motion.t, x) for x in (motion.spin_1, motion.spin_2)]
    np.testing.assert_allclose(rates, [[3.0, 3.0], [1.0, 1.0]], rtol=2e-4)
    np.testing.assert_allclose(measure.distances(pairs)[..., 0], motion.distance, rtol=1e-14)
    ends = measure.distances(pairs, [0.1, 0.0, 0.0])[..., 0]  # of points on the x axes
    apart = motion.spin_1 - motion.longitude
    tips = np.stack([motion.distance, 0 * apart]) + 0.1 * np.stack(
        [np.cos(motion.libration) - np.cos(apart), np.sin(motion.libration) - np.sin(apart)]
    )
    np.testing.assert_allclose(ends, np.hypot(*tips), rtol=1e-9)
    tilts = measure.tilt(pairs, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(np.cos(tilts[:, 1]), np.cos(np.outer(motion.t, [3.0, 1.0])), rtol=0, atol=1e-6)
    np.testing.assert_allclose(measure.pole(pairs).latitude, np.pi / 2, rtol=1e-7)
    np.testing.assert_allclose(measure.rotation_rates(pairs)[:, 1], [[3.0, 1.0]] * 2401, rtol=1e-9)


@pytest.mark.long
def test_a_locked_moon_librates_with_its_free_and_its_forced_line(pairs):
    """Of small swings the free frequency is √(3(B − A)/C) n, and the forced amplitude 2e n²/(n² − ω²)."""
    motion = measure.relative_motion(pairs)
    assert measure.is_librating(motion.libration).tolist() == [True, True]
    found = measure.librations(motion)
    A, B, C = SATELLITE
    omega = np.sqrt(3 * (B - A) / C)
    np.testing.assert_allclose(2 * np.pi / found.free_period[0], omega, rtol=5e-4)
    np.testing.assert_allclose(found.forced[0], 2 * 0.002 / (1 - omega**2), rtol=6e-3)
    one = measure.relative_motion(pairs.member(0), 1, 0)
    np.testing.assert_allclose(one.distance, motion.distance[:, 0], rtol=1e-14)
    np.testing.assert_allclose(
        measure.librations(measure.relative_motion(pairs.member(0)))[0], found.forced[0], rtol=1e-9
    )
    short = measure.relative_motion(go(pairs.member(0).step, jax.tree.map(lambda x: x[0, 0], pairs.state), 0.1, 20))
    assert np.isnan(measure.apsides(short)).all()
    assert np.isnan(measure.librations(short)).all()


@pytest.mark.long
def test_the_energies_of_a_pair_add_up(pairs):
    found = measure.pair_energies(pairs)
    parts = found.orbit + found.spin_1 + found.spin_2 + found.shape
    np.testing.assert_allclose(parts, found.total, rtol=1e-13)
    np.testing.assert_allclose(found.orbit[:, 1], -0.5e-9, rtol=3e-7)
    np.testing.assert_allclose(found.shape[:, 1], 0, rtol=0, atol=1e-20)
    for first, second in ((0, 2), (1, 1), (-1, 0)):
        with pytest.raises(ValueError, match="must be two of the numbers 0 to 1"):
            measure.relative_motion(pairs, first, second)


@pytest.mark.long
def test_over_its_pole_a_body_is_at_a_right_angle_from_its_equator():
    """Of 200 random directions, all along the z axis of the second body; the arcsine was NaN for a third of them."""
    masses, J = jnp.ones(2), jnp.ones((2, 3))
    bodies = li.systems.rigid_bodies(masses, J, li.potentials.point_masses(1.0, masses))
    q = jax.vmap(so3.normalize)(jnp.asarray(np.random.default_rng(0).normal(size=(200, 4))))
    along = jax.vmap(so3.Ad, (0, None))(q, jnp.array([0.0, 0.0, 1.0]))
    home = jnp.array([1.0, 0, 0, 0])
    make = lambda q, d: bodies.state([0 * d, d], [home, q], velocities=[0 * d, jnp.flip(d)], angular_velocities=J)  # noqa: E731
    states = jax.vmap(make)(q, along)
    run = go(li.schemes.splitting(bodies), states, 0.1, 0)
    np.testing.assert_allclose(measure.relative_motion(run).out_of_plane[0], np.pi / 2, rtol=0, atol=1e-15)


def test_the_distances_of_random_points_in_a_ball_have_their_density():
    """1 − 3r/2D + r³/2D³ of N²/2V, for a ball of diameter D; a cluster of equal distances has its peak there."""
    random = np.random.default_rng(0)
    boxes = random.uniform(-1, 1, (200, 400, 3))
    r = np.array([pdist(x[np.sum(x * x, axis=1) < 1][:150]) for x in boxes])
    found = measure.pair_density(r, np.linspace(0.5, 1.8, 27))
    s = found.r / 2
    exact = 150 * 149 / 2 / (4 * np.pi / 3) * (1 - 1.5 * s + 0.5 * s**3)
    np.testing.assert_allclose(found.density, exact, rtol=0, atol=0.01 * exact[0])  # observed 0.005
    edges = np.arange(0.2, 0.6 + 0.0025, 0.005)
    shell = random.normal(0.2812, 0.02, (7, 5, 4000))
    peak = measure.pair_density(shell, edges, peak_below=0.35)
    assert peak.peak == pytest.approx(0.2812 - 2 * 0.02**2 / 0.2812, abs=2e-3)  # r⁻² moves the maximum inward
    assert peak.height == peak.density.max()
    failed = np.concatenate([shell, np.full_like(shell[:, :1], np.nan)], axis=1)  # of one more member
    np.testing.assert_array_equal(measure.pair_density(failed, edges, peak_below=0.35).density, peak.density)
    assert np.isnan(measure.pair_density(failed[:, 5:], edges).peak)
    assert measure.pair_density(np.concatenate([shell, shell + 0.1], axis=-1), edges, peak_below=0.35).peak == peak.peak
    with pytest.raises(ValueError, match="at least three bins"):
        measure.pair_density(shell, [0.1, 0.2])
    with pytest.raises(ValueError, match=r"evenly spaced, got bins from 0\.1 to 0\.3 wide"):
        measure.pair_density(shell, [0.1, 0.2, 0.3, 0.6])
    with pytest.raises(ValueError, match="peak_below must be above the middle of the first bin"):
        measure.pair_density(shell, edges, peak_below=0.0)
    with pytest.raises(ValueError, match="measurements need a run"):
        measure.distances(r)


def test_apsides_precess_about_an_oblate_body():
    """Near a circle by Ω − κ, with Ω² = μ/r³ (1 + 3k/r²) and κ² = μ/r³ (1 − 3k/r²), k = (C − A)/2m, at the radius r of
    the circle of equal angular momentum; L is that of the spin, about which one of the two orbits is retrograde."""
    masses, J = np.array([1.0, 1e-6]), np.array([[0.02, 0.02, 0.03], [1e-12] * 3])
    bodies = li.systems.rigid_bodies(masses, J, li.potentials.maccullagh(1.0, masses, J))
    k, mu, more = 0.005, 1.0 + 1e-6, 1.001  # over the speed in a circle
    b = more**2 * (1 + 3 * k)
    r = (b + np.sqrt(b**2 - 12 * k)) / 2
    Omega, kappa = (np.sqrt(mu / r**3 * (1 + sign * 3 * k / r**2)) for sign in (1, -1))
    for sense in (1, -1):
        v = sense * more * np.sqrt(mu * (1 + 3 * k))
        velocities, spins = [[0, -1e-6 * v / mu, 0], [0, v / mu, 0]], [[0, 0, 1.0], [0, 0, 0]]
        state = bodies.state([[-1e-6 / mu, 0, 0], [1 / mu, 0, 0]], velocities=velocities, angular_velocities=spins)
        run = go(li.schemes.compose(li.schemes.splitting(bodies), 4), state, 0.05, 12000, save_every=4)
        found = measure.apsides(measure.relative_motion(run))
        np.testing.assert_allclose(2 * np.pi / found.period, Omega, rtol=1e-5)
        np.testing.assert_allclose(2 * np.pi / found.anomalistic_period, kappa, rtol=1e-5)
        np.testing.assert_allclose(found.precession_rate, sense * (Omega - kappa), rtol=2e-5)


def test_apsides_of_a_potential_without_gravity_are_nan():
    """Two bodies on a spring have no ellipse about a focus; those in a sum have that of its one term with a G."""
    masses = jnp.array([0.5, 0.5])
    spring = lambda x, R: jnp.sum((x[1] - x[0]) ** 2) / 8  # noqa: E731
    state = dict(velocities=[[0, -0.2, 0], [0, 0.2, 0]], angular_velocities=jnp.zeros((2, 3)))
    found = []
    for potential in (spring, spring + li.potentials.point_masses(1.0, masses)):
        bodies = li.systems.rigid_bodies(masses, jnp.ones((2, 3)), potential)
        run = go(li.schemes.splitting(bodies), bodies.state([[-0.5, 0, 0], [0.5, 0, 0]], **state), 0.02, 8)
        found.append(measure.relative_motion(run))
    assert np.isnan([found[0].eccentricity, found[0].mean_longitude]).all()
    assert np.isnan(measure.apsides(found[0])).all()
    np.testing.assert_allclose(found[1].eccentricity[0], 1 - 0.4**2, rtol=1e-14)  # at its apocenter, where r = v²a/μ
    np.testing.assert_allclose(found[0].longitude[0], found[1].longitude[0], rtol=1e-14)
