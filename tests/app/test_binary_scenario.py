"""`lieint run didymos` and `lieint run kw4`: their keys and members, what is measured, files and resumed stores."""

import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenario_runs import run
from two_bodies import reference

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import _report, _runs, binary
from lieint_jax.app.scenarios._keys import Published

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("fresh_folder")]


def changed(name, **tables):
    """The shipped scenario with keys of its tables replaced."""
    given = scenarios.load(name).model_dump(exclude_none=True)
    return scenarios.parse(given | {key: given.get(key, {}) | keys for key, keys in tables.items()}, name)


def test_members_have_bodies_of_their_own_and_the_first_is_the_nominal_one():
    scenario = scenarios.load("didymos", members=3)
    step, states = scenario.build()
    masses, moments = np.asarray(step.system.masses), np.asarray(step.system.inertias)
    np.testing.assert_array_equal(masses[0], [scenario.primary.mass_kg, scenario.secondary.mass_kg])
    np.testing.assert_allclose(
        moments[0], [scenario.primary.moments_kg_m2, scenario.secondary.moments_kg_m2], rtol=3e-15
    )
    assert np.ptp(moments[:, 0], axis=0).max() == 0
    assert (np.ptp(moments[:, 1], axis=0) > 0).all()
    x, p = np.asarray(states.q)[:, :, :3], np.asarray(states.p)[:, :, :3]
    assert abs((masses[..., None] * x).sum(axis=1)).max() < 1e-15 * abs(masses[..., None] * x).max()
    assert abs(p.sum(axis=1)).max() < 1e-15 * abs(p).max()
    v = p[:, 1] / masses[:, 1, None] - p[:, 0] / masses[:, 0, None]
    np.testing.assert_allclose(v[0], [0, 0.17329064 - 2.7268e-3, 0], rtol=1e-14)
    assert 1e-5 < np.abs(v[1:] - v[0]).max() < 5e-4
    np.testing.assert_allclose(x[0, 1] - x[0, 0], [1180.0, 0, 0], rtol=1e-15)
    fewer = scenarios.build_first(scenario, 2)
    np.testing.assert_array_equal(fewer.system.inertias, moments[:2])


@pytest.mark.parametrize(
    ("scheme", "error"),
    [("kepler_splitting", 0.01), ("nystrom", 0.01), ("splitting", 0.01), ("bodies_energy_momentum", 0.1)],
)
def test_every_scheme_can_be_chosen(scheme, error):
    """By key, each at its lowest order: errors of position after an orbit, over the distance; the last was 0.034."""
    scenario = scenarios.load("kw4", scheme=scheme, order=4 if scheme == "nystrom" else 2)
    scenario = scenario.model_copy(update=dict(steps=100, save_every=100, dt=670.0, members=2))
    path = run(scenario)
    assert scheme in path.step.name
    assert path.info.converged.all()
    fine = run(scenarios.load("kw4").model_copy(update=dict(steps=100, save_every=100, dt=670.0, members=2)))
    assert abs(path.state.q[-1, :, :, :3] - fine.state.q[-1, :, :, :3]).max() < error * 2548


@cache
def nominal_didymos():
    scenario = scenarios.load("didymos", members=2)
    return scenario, run(scenario)


def apsides(scenario, path):
    """The mean rate of the vector of Laplace, Runge and Lenz of every member, in °/d."""
    m, q, p = (np.asarray(x) for x in (path.system.masses, path.state.q[..., :3], path.state.p[..., :3]))
    d, v = q[:, :, 1] - q[:, :, 0], p[:, :, 1] / m[:, 1, None] - p[:, :, 0] / m[:, 0, None]
    e = np.cross(v, np.cross(d, v)) / (scenario.G * m.sum(axis=1)[:, None]) - d / np.linalg.norm(d, axis=-1)[..., None]
    angle = np.unwrap(np.arctan2(e[..., 1], e[..., 0]), axis=0)
    return np.rad2deg(np.polyfit(path.t, angle, 1)[0]) * 86400


def test_the_report_of_didymos_has_the_published_periods_and_the_rate_of_its_apsides():
    """The nominal one; the apsides' rate beside that of the vector of Laplace, Runge and Lenz."""
    scenario, path = nominal_didymos()
    rows = {row.name: row.nominal for row in scenario.quantities(path)}
    assert rows["orbital period (h)"] == pytest.approx(11.372, abs=2e-4)
    assert rows["primary's spin period (h)"] == pytest.approx(2.26, abs=1e-3)
    assert rows["libration of the secondary, largest (°)"] == pytest.approx(22.27, abs=0.1)
    rate = apsides(scenario, path)[0]
    assert rows["precession of the line of apsides (°/d)"] == pytest.approx(rate, abs=0.05)  # −5.838 and −5.845
    kept = {x.name: x.change().max() for x in scenario.conserved(path)}
    assert kept["energy, over |energy|"] < 3e-11  # 8e-12
    assert kept["linear momentum, over that of the secondary"] < 1e-15
    assert kept["angular momentum, relative"] < 5e-14


@pytest.mark.quick
def test_the_report_notes_a_spread_beyond_the_published_error_and_a_wrong_sign():
    published = Published(value=6.7, error=0.2, source="a book", remark="The primary is rounder.")
    scenario = scenarios.load("didymos", members=1)

    def notes(values):
        row = _report.Quantity("precession (°/d)", np.array(values), published=published)
        _, head, _, *lines = _report.text(scenario, [], [row]).split("\n")
        assert "published" in head
        return " ".join(line.strip() for line in lines)

    far = notes([-5.8, -11.9, -3.5, -6.8])
    assert "differs from the published value by -12.5, 62 times the published error, and in its sign" in far
    assert "spread is 18 times the published error" in far
    assert "the median is -6.3000, and 68 % of them lie from -9.4520 to -4.6040. The primary is rounder." in far
    assert "differs" not in notes([6.6, 5.6, 7.4, 6.5])
    assert "spread is 3.7 times" in notes([6.6, 5.6, 7.4, 6.5])
    assert notes([6.6, 6.7, 6.65, 6.6]) == ""


def test_the_spread_of_the_apsides_of_didymos_is_that_of_the_librations():
    """Of its members, by the vector of Laplace, Runge and Lenz too: no noise of the measurement."""
    scenario = scenarios.load("didymos", members=12)
    path = run(scenario)
    found = scenario.motion(path)
    [row] = [row for row in scenario.quantities(path) if "apsides" in row.name]
    rates = apsides(scenario, path)
    assert row.spread > 3
    assert np.std(rates, ddof=1) == pytest.approx(row.spread, abs=0.2)
    swing = abs(found.libration).max(axis=0)
    assert np.corrcoef(rates, swing)[0, 1] < -0.8


def test_didymos_in_steps_of_half_an_hour_agrees_with_dop853():
    """Five days; observed 2e-5 m."""
    _, path = nominal_didymos()
    start = jax.tree.map(lambda x: jnp.asarray(x[0, 0]), path.state)
    k = int(np.searchsorted(path.t, 5 * 86400.0))
    x, _ = reference(path.member(0).system, start, float(path.t[k]), 1e-12, 1e-12)
    q = path.state.q[k, 0, :, :3]
    assert np.linalg.norm((q[1] - q[0]) - (x[1] - x[0])) < 1e-4


def test_a_change_of_the_period_determines_the_change_of_speed():
    scenario, path = nominal_didymos()
    found = scenario.impact(path)
    assert found.period_unchanged == pytest.approx(11.9216, abs=2e-4)
    assert found.change == pytest.approx(-2.7268, abs=2e-3)
    assert found.kepler == pytest.approx(-2.783, abs=2e-3)
    assert found.change * found.slope == pytest.approx(11.372 - 11.9216, rel=5e-3)


def test_spheres_have_kepler_s_period_and_its_derivative():
    """Two spheres: T = 2π√(a³/GM), dT/dv = 3Tav/GM. Forty orbits; observed 2e-6 and 9e-4, which the fit leaves."""
    sphere = dict(moments_kg_m2=[1e13, 1e13, 1e13])
    scenario = changed("didymos", primary=sphere | dict(mass_kg=5e11), secondary=sphere).model_copy(
        update={"members": 1}
    )
    step, states = scenario.build()
    first, start = _runs.nominal_member(step), jax.tree.map(lambda x: x[0], states)
    measure = partial(binary.orbital_period, first, start, scenario.dt, scenario.steps, scenario.save_every)
    period, slope = (float(x) for x in measure(jnp.asarray(0.0)))
    mu, v = scenario.G * (5e11 + scenario.secondary.mass()), 0.17329064 - 2.7268e-3
    a = 1 / (2 / 1180.0 - v * v / mu)
    true = 2 * np.pi * np.sqrt(a**3 / mu)
    assert period == pytest.approx(true, rel=1e-5)
    assert slope == pytest.approx(3 * true * a * v / mu, rel=3e-3)
    change = binary.speed_change_for(1.05 * true, measure)
    assert change == pytest.approx(binary.kepler_speed(mu, 1180.0, 1.05 * true) - v, rel=3e-3)


@pytest.mark.parametrize("name", ["didymos", "kw4"])
def test_shipped_binaries_run_and_plot_from_the_command_line(name, lieint):
    out = lieint("run", name, "--members", "3", "--steps", "288", "--out", "x.npz")
    assert "3 of 3 members converged" in out
    assert re.search(r"orbital period \(h\) +1[18]\.\d+ ", out)
    assert ("change of speed between" in out) == (name == "didymos")
    lieint.drew(*(f"x-{picture}.png" for picture in binary.Binary.pictures()))
    kept = re.search(r"largest change of energy.*\((\S+) of the largest", lieint("info", "x.npz"))
    assert float(kept[1]) < 1e-10  # with each member's own bodies
    assert "3 of 3 members: one end" in lieint("plot", "x.npz", "--force")
