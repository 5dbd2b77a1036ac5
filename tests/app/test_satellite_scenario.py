"""`lieint run cubesat`: the balance of all laws, what detumbles, captures and unloads, and the members' spread."""

import datetime

import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import satellite
from lieint_jax.groups import so3
from lieint_jax.measure import captured_since
from tests.lib.scenario_runs import run

pytestmark = pytest.mark.long

SHORT = {  # rods and drag are in the long test: each adds seconds of compilation
    "steps": 150,
    "save_every": 5,
    "members": 6,
    "detumbling": {"window": [0.0, 100.0], "gain": 4e4},
    "pointing": {"window": [100.0, 300.0], "frequency": 0.03},
    "unloading": {"window": [200.0, 300.0], "gain": 1e-3},
}


@pytest.fixture(scope="module")
def short():
    table = {key: value for key, value in scenarios.table("cubesat").items() if key not in ("rods", "drag")}
    scenario = scenarios.parse(table | SHORT, "short")
    return scenario, run(scenario)


def test_the_energy_less_the_work_of_all_laws_is_constant(short):
    """Observed: 1e-15 of the largest energy. The total work is the sum of the laws', and each law does some."""
    scenario, made = short
    assert bool(np.all(made.info.converged))
    (balance,) = scenario.conserved(made)
    assert balance.change().max() < 1e-14
    c = scenario.course(made)
    np.testing.assert_allclose(made.state.work, c.works.sum(axis=-1), rtol=0, atol=1e-14 * abs(c.energy).max())
    assert c.names == ["gravity_gradient", "dipole", "bdot", "unloading", "wheels"]
    assert (np.abs(np.diff(c.works, axis=0)).max(axis=(0, 1)) > 0).all()


def test_laws_of_control_act_in_their_windows(short):
    scenario, made = short
    c, t = scenario.course(made), np.asarray(made.t)
    bdot, unloading, wheels = (np.diff(c.works[..., c.names.index(x)], axis=0) for x in ("bdot", "unloading", "wheels"))
    after = t[:-1] >= 100.0
    assert (bdot[~after] < 0).all()
    assert not bdot[after].any()
    assert not wheels[~after].any()
    assert not unloading[t[:-1] < 200.0].any()
    assert np.median(c.nadir_angle[-1]) < 15 < np.median(c.nadir_angle[20])  # the wheels point the camera
    assert [name for name, *_ in scenario.phases(t)] == ["detumbling", "pointing", "pointing and unloading"]


def test_a_stored_run_is_opened_and_goes_on_with_its_orbit_and_field(short, tmp_path):
    """The functions of time are constants of the step, which the store describes."""
    _, made = short
    path = tmp_path / "run.zarr"
    made.save(path)
    found = li.open(path)
    np.testing.assert_array_equal(found.energy_error(), made.energy_error())
    np.testing.assert_array_equal(found.load().extend(5).state.q[-1], made.extend(5).state.q[-1])


def test_the_report_lists_phases_and_works(short):
    scenario, made = short
    text = scenario.report(made)
    assert "never raised the energy between two saved times: 6 of 6" in text
    assert "energy less the work of all laws" in text
    lines = [line.split() for line in text.splitlines()]
    c = scenario.course(made)
    row = next(line for line in lines if line[:1] == ["bdot"])
    assert float(row[1]) == pytest.approx(1e6 * c.works[20, :, c.names.index("bdot")].mean(), abs=1e-4)


def test_pictures_name_the_laws_and_count_the_captured(short):
    scenario, made = short
    c = scenario.course(made)
    left, right = scenario.draw_works(made).axes
    drawn = {line.get_label(): line.get_ydata() for line in left.get_lines()}
    for name, work in zip(c.names, c.works[:, 0].T, strict=True):
        np.testing.assert_allclose(drawn[name.replace("_", " ")], 1e6 * work, rtol=1e-12)
    assert left.get_ylabel() == "work of each law (µJ)"
    worst = next(line for line in right.get_lines() if line.get_label() == "worst member")
    assert np.max(worst.get_ydata()) < 1e-14
    fates, course = scenario.draw_capture(made).axes
    captured = int(np.isfinite(captured_since(made.t, c.nadir_angle, 10.0)).sum())
    names = [text.get_text() for text in fates.get_legend().get_texts()]
    assert names == [f"captured: {captured} of 6", f"not captured: {6 - captured} of 6"]
    curves = {line.get_label(): line.get_ydata() for line in course.get_lines()}
    np.testing.assert_allclose(
        curves["z within 90° of the nadir"], 100 * (c.nadir_angle <= 90).mean(axis=1), rtol=1e-15
    )


@pytest.mark.quick
def test_the_error_of_a_fraction_is_that_of_drawing_starts():
    """Against 20 000 draws of 400 starts. Where all are captured, it is still not 0."""
    rng = np.random.default_rng(2)
    drawn = rng.binomial(400, 0.3, 20_000) / 400
    part, error = satellite.fraction(np.arange(400) < 120)
    assert part == 0.3
    assert error == pytest.approx(drawn.std(), rel=0.02)
    part, error = satellite.fraction(np.ones(10_000, bool))
    assert part == 1.0
    assert 5e-5 < error < 1e-4


def test_the_members_have_inertias_and_dipoles_of_their_own():
    scenario = scenarios.load("cubesat", members=400, steps=20)
    step, states = scenario.build()
    gravity, dipole = step.system.laws[:2]
    J = np.asarray(gravity.inertia)
    P = np.trace(J, axis1=1, axis2=2)[:, None] / 2 - np.diagonal(J, axis1=1, axis2=2)
    np.testing.assert_allclose(J[0], np.diag(scenario.inertia), rtol=0, atol=1e-16)
    np.testing.assert_allclose(np.std(np.log(P), axis=0), 0.05, rtol=0.15)
    np.testing.assert_allclose(np.std(dipole.moment, axis=0), 0.002, rtol=0.15)
    np.testing.assert_allclose(dipole.moment[0], scenario.residual_dipole, rtol=1e-15)
    assert states.p.shape == (400, 3)
    wheels = scenario.wheels.axes()
    body = J[0] - 5e-6 * np.asarray(wheels).T @ np.asarray(wheels)
    np.testing.assert_allclose(step.system.inertia[0], body, rtol=0, atol=2e-21)


def test_a_state_relative_to_the_orbit_rotates_with_its_axes():
    """At rest in the axes of the orbit z points to the nadir, and the body rotates with the orbit."""
    state = {"quaternion": [1.0, 0, 0, 0], "angular_velocity_rad": [0.0, 0.0, 0.0], "relative_to": "orbit"}
    scenario = scenarios.load("cubesat", state=state)
    around = scenario.environment()
    q, Omega = scenario._pose(around)
    r, v = (np.asarray(x) for x in around.orbit(0.0))
    np.testing.assert_allclose(so3.to_matrix(q)[:, 2], -r / np.linalg.norm(r), rtol=0, atol=1e-15)
    normal = np.cross(r, v)
    np.testing.assert_allclose(so3.Ad(q, Omega), normal / (r @ r), rtol=0, atol=1e-17)


@pytest.mark.quick
def test_the_epoch_of_a_satellite_takes_the_place_of_its_date():
    table = {key: value for key, value in scenarios.table("cubesat").items() if key != "date"}
    by_epoch = scenarios.parse(table | {"epoch": datetime.date(2026, 3, 1)}, "file")  # TOML has dates
    assert (by_epoch.epoch, by_epoch.date_of_zero()) == ("2026-03-01T00:00:00 UTC",) * 2
    np.testing.assert_array_equal(by_epoch.environment().field(9.0), scenarios.load("cubesat").environment().field(9.0))


def test_every_start_of_the_shipped_scenario_is_captured_and_unloaded(tmp_path, monkeypatch, capsys):
    """Order of events: detumbling to below 0.5 °/s, the camera within 1° of the nadir, less momentum in the wheels."""
    scenario = scenarios.load("cubesat", members=20)
    made = run(scenario)
    (balance,) = scenario.conserved(made)
    assert balance.change().max() < 2e-14  # observed: 3e-15
    c, t = scenario.course(made), np.asarray(made.t)
    (_, _, slow), (_, _, pointed), _ = scenario.phases(t)
    assert (c.rate[slow] < satellite._SLOW).all()
    assert (c.nadir_angle[pointed:] < 1).all()
    assert np.median(c.wheels[-1]) < 0.7 * np.median(c.wheels[pointed])
    bdot = c.works[..., c.names.index("bdot")]
    assert (np.diff(bdot, axis=0) <= 0).all()
    assert any(type(law).__name__ == "Windowed" for law in made.system.laws)
    for draw in scenario.pictures().values():
        assert draw(scenario, made).axes


@pytest.mark.quick
def test_a_percentage_has_two_digits_of_its_error():
    assert satellite._percent(1.0, 0.0601) == "(100.0 ± 6.0) %"
    assert satellite._percent(0.9731, 0.0016) == "(97.31 ± 0.16) %"
    assert satellite._percent(0.5, 0.25) == "(50 ± 25) %"
