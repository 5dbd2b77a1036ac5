"""The example Hyperion: the conventions of its data, the section, exponents beside DOP853 and published numbers."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import diagnostics, orbits, schemes, systems
from lieint_jax.examples import hyperion

TABLE_1 = {  # Goldberg & Batygin 2024: θ, φ, ψ, the unit spin axis, |ω|
    ("1981-08-23", "fit"): ([5.676, 0.965, 3.448], [0.211, -0.019, 0.977], 4.225),
    ("2005-06-10", "those"): ([1.713, 1.148, 1.508], [0.067, 0.451, 0.890], 4.433),
    ("2005-08-16", "those"): ([0.559, 0.661, 0.587], [0.162, 0.389, 0.907], 4.255),
    ("2005-09-25", "those"): ([5.734, 0.134, 0.705], [0.133, 0.411, 0.902], 4.255),
    ("2005-06-10", "corrected as"): ([2.055, 0.963, 2.210], [-0.010, -0.182, 0.983], 4.433),
    ("2005-08-16", "corrected as"): ([1.025, 0.819, 1.112], [-0.166, 0.009, 0.986], 4.255),
    ("2005-09-25", "corrected as"): ([0.527, 0.393, 0.525], [-0.095, 0.157, 0.983], 4.255),
}
DRAWN = {  # spin vectors in space, in the authors' notebook current_state, beside their model
    "2005-06-10": [3.399, -1.511, 2.411],
    "2005-08-16": [3.026, 1.909, 2.303],
    "2005-09-25": [1.151, 2.018, 3.565],
}
CASSINI = list(DRAWN)


def state(date, reading):
    """Attitude and spin axis of an observed state."""
    [(_, _, euler, axis)] = [x for x in hyperion.OBSERVED if x[0] == date and x[1].startswith(reading)]
    return Rotation.from_euler("ZXZ", euler, degrees=True), np.array(axis) / np.linalg.norm(axis)


def apart(a, b):
    return float(np.rad2deg(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


@pytest.mark.parametrize(("date", "reading"), TABLE_1)
def test_table_1_of_the_source_orders_the_axes_b_c_a_and_maps_space_to_body(date, reading):
    angles, axis, rate = TABLE_1[date, reading]
    attitude, own = state(date, reading)
    inertia, *_, given = hyperion.DATES[date]
    np.testing.assert_allclose(own[[1, 2, 0]], axis, rtol=0, atol=1.5e-3)
    assert given == rate
    permuted = attitude * Rotation.from_matrix(np.eye(3)[[1, 2, 0]]).inv()
    told = Rotation.from_euler("ZXZ", angles)
    assert np.rad2deg((permuted * told).magnitude()) < 0.2
    assert np.rad2deg((permuted.inv() * told).magnitude()) > 4  # read as body to space, it is another attitude
    assert inertia == tuple(sorted(inertia))


@pytest.mark.parametrize("date", CASSINI)
def test_the_spin_vectors_in_space_are_those_that_the_authors_draw(date):
    attitude, own = state(date, "those")
    assert np.linalg.norm(DRAWN[date]) == pytest.approx(hyperion.DATES[date][-1], abs=1e-3)
    assert apart(attitude.apply(own), np.array(DRAWN[date])) < 5  # 4.5, 1.8, 0.04


def test_the_corrected_axes_do_not_rest_in_the_body():
    """One rotation of the body's axes keeps the angles between spin axes; both readings have the same spin in space."""
    between = {}
    for reading in ("those", "corrected as"):
        found = [state(date, reading) for date in CASSINI]
        between[reading] = [apart(found[i][1], found[j][1]) for i, j in ((0, 1), (0, 2), (1, 2))]
        for (attitude, own), date in zip(found, CASSINI, strict=True):
            plain = state(date, "those")
            np.testing.assert_allclose(attitude.apply(own), plain[0].apply(plain[1]), rtol=0, atol=2e-4)
    np.testing.assert_allclose(between["those"], [6.6, 4.5, 2.1], rtol=0, atol=0.1)
    np.testing.assert_allclose(between["corrected as"], [14.1, 20.1, 9.4], rtol=0, atol=0.1)


def angle_and_rate(states):
    """θ in [0, π) and θ̇ of planar states."""
    theta = Rotation.from_quat(states.q, scalar_first=True).as_rotvec()[:, 2] % np.pi
    return np.where(theta > np.pi - 1e-9, 0.0, theta), np.asarray(states.p)[:, 2] / hyperion.INERTIA[2]


def test_members_start_on_a_grid_at_pericenter_and_are_planar():
    step, states = hyperion.planar_step_and_starts(72)
    theta, rate = angle_and_rate(states)
    np.testing.assert_allclose(theta.reshape(3, 24), np.tile(np.pi / 24 * np.arange(24), (3, 1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(rate.reshape(3, 24), np.repeat([[0.0], [2.0], [4.0]], 24, axis=1), rtol=0, atol=1e-15)
    assert states.t.shape == ()
    np.testing.assert_allclose(step.system.orbit(states.t)[0], [0.9, 0, 0], rtol=0, atol=1e-15)


def test_members_that_fill_no_grid_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"members must be a multiple of 24, and steps of 60; got 25 and 60"):
        hyperion.main(members=25, steps=60, out=tmp_path / "a.zarr")


@pytest.mark.long
def test_a_small_run_reports_all_exponents_and_draws(tmp_path, capsys):
    out = tmp_path / "small.zarr"
    hyperion.main(members=72, steps=1200, spatial_starts=2, orbits=10, out=out)
    text = capsys.readouterr().out
    for line in (
        "planar motions, 72 starts (24 angles × 3 rates) × 20 orbits",
        "in space, from there, 2 starts × 10 orbits",
        "observed states, 10 orbits; chaotic: largest exponent above",
        "0 of these runs had a step that did not converge",
        "72 of 72 members converged",
    ):
        assert line in text
    assert float(re.search(r"largest sum of six +(\S+)", text)[1]) < 1e-14
    for date, reading, *_ in hyperion.OBSERVED:
        row = re.search(rf"{date} +{re.escape(reading)} +(\S+) ± (\S+) +\d+ d", text)
        assert all(float(x) > 0 for x in row.groups())
    assert (tmp_path / "small-section.png").exists()
    assert li.open(out).load().members == 72


def planar_growth(e, squared, theta, rate, span):
    """ln of the growth of (δθ, δθ̇) = (1, 0) by θ̈ = −½ω₀² sin 2(θ − f)/r³ and its variational equation, and where."""

    def slope(t, y):
        E = t
        for _ in range(60):
            E = t + e * np.sin(E)
        x, z = np.cos(E) - e, np.sqrt(1 - e * e) * np.sin(E)
        r, f = np.hypot(x, z), np.arctan2(z, x)
        strength = squared / r**3
        return [y[1], -0.5 * strength * np.sin(2 * (y[0] - f)), y[3], -strength * np.cos(2 * (y[0] - f)) * y[2]]

    return solve_ivp(slope, (0, span), [theta, rate, 1.0, 0.0], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


@pytest.mark.long
def test_the_planar_exponent_agrees_with_another_formulation():
    """Six orbits of the case of REBOUND's notebook ChaoticHyperion: 3(B−A)/C = 0.78, e = 0.123233, θ = 0.01, θ̇ = 1."""
    A, B, C = 0.6, 0.86, 1.0
    body = systems.gravity_gradient([A, B, C], orbits.kepler(1.0, 1.0, 0.123233))
    start = body.state([np.cos(0.005), 0.0, 0.0, np.sin(0.005)], angular_velocity=[0.0, 0.0, 1.0], t=0.0)
    step = schemes.compose(schemes.splitting(body), 6)
    count = 6 * 80
    vector = np.zeros((6, 1))
    vector[2] = 1.0
    found = diagnostics.lyapunov(step, start, 2 * np.pi / 80, count, every=count, vectors=vector, batches=1)
    y = planar_growth(0.123233, 3 * (B - A) / C, 0.01, 1.0, 12 * np.pi)
    known = np.log(np.hypot(y[2], C * y[3] / C))  # δπ in units of π = C θ̇ at the start
    assert known > 2
    assert float(found.growth[0, 0]) == pytest.approx(known, abs=1e-5)


@pytest.mark.long
def test_hyperion_has_a_chaotic_zone_and_three_exponents():
    """Half of the shipped grid: the zone, three exponents, the spectrum, and an island of unstable attitudes."""
    step, starts = hyperion.planar_step_and_starts(504)

    def exponents(states, orbits, vectors):
        return np.asarray(hyperion.exponents(step, states, orbits, hyperion.PER_ORBIT, vectors, hyperion.SHARED)[0])

    section = exponents(starts, 300, hyperion.PLANES)
    chaotic = section[:, 0] > hyperion.chaos_limit(300)
    assert np.mean(chaotic) == pytest.approx(0.43, abs=0.03)
    zone = np.flatnonzero(section[:, 0] > np.median(section[chaotic, 0]) / 2)
    chosen = zone[np.unique(np.linspace(0, zone.size - 1, 24).round().astype(int))]
    few = starts._replace(q=starts.q[chosen], p=starts.p[chosen])
    inside, outside = exponents(few, 1000, hyperion.PLANES).mean(axis=0)
    assert inside == pytest.approx(0.116, abs=0.01)
    assert outside == pytest.approx(0.041, abs=0.006)
    theta, rate = angle_and_rate(starts)
    synchronous = (abs(theta) < 0.01) & (abs(rate - 0.6) < 0.05)
    assert synchronous.sum() == 1
    assert (section[synchronous, 0] < hyperion.chaos_limit(300)).all()
    assert (section[synchronous, 1] > 0.03).all()  # an island where the attitude is unstable
    tilted = Rotation.from_rotvec([hyperion.TILT, 0, 0]) * Rotation.from_quat(few.q, scalar_first=True)
    spatial = exponents(few._replace(q=tilted.as_quat(scalar_first=True)), 1000, np.eye(6))
    spatial = np.sort(spatial, axis=1)[:, ::-1]
    assert abs(spatial.sum(axis=1)).max() < 1e-14
    three, own = spatial[:, :3], spatial[:, :3].std(axis=0, ddof=1) / np.sqrt(24)
    error = np.hypot(own, [0.010, 0.005, 0.003])
    assert (own < [0.015, 0.008, 0.004]).all()
    np.testing.assert_array_less(abs(three.mean(axis=0) - [0.124, 0.054, 0.017]), 3 * error)


@pytest.mark.long
def test_the_observed_states_are_chaotic_by_the_axes_of_the_shape_and_less_so_by_corrected_ones():
    found, limit = hyperion.observed_exponents(1500), hyperion.chaos_limit(1500)
    assert limit == pytest.approx(0.0029, abs=5e-5)
    assert np.asarray(found.info.converged).all()
    seen = {row[:2]: x for row, x in zip(hyperion.OBSERVED, np.asarray(found.exponents)[:, 0], strict=True)}
    for date in CASSINI:
        shape, corrected = seen[date, "those of the shape model"], seen[date, "corrected as in table 1"]
        assert shape > limit
        assert 50 < hyperion.PERIOD / (2 * np.pi * shape) < 350  # "on the order of 100 days"
        assert corrected < 0.4 * shape  # 0.08, 0.16, 0.22
    assert seen["2005-06-10", "corrected as in table 1"] < limit
