"""The script of the CubeSat: the balance of all laws, what detumbles, captures and unloads, and the members' spread."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from example_runs import run_example

import lieint_jax as li
from lieint_jax.examples import cubesat

pytestmark = pytest.mark.long

LAWS = ["gravity gradient", "residual dipole", "air", "rod along x", "rod along y", "B-dot", "unloading", "wheels"]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Six members for 300 s, in which all phases are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cubesat, "BEGINS", {"detumbling": 0.0, "pointing": 100.0, "pointing and unloading": 200.0})
        return run_example(cubesat, tmp_path_factory.mktemp("cubesat"), members=6, steps=160)


def works_of(run):
    """The work of each law, (times, members), by name."""
    return dict(zip(LAWS, np.moveaxis(np.asarray(run.state.extra["works"]), -1, 0), strict=True))


def energy_of(run):
    return np.asarray(run.map(lambda step, z: step.system.energy(z)))


def test_the_energy_less_the_work_of_all_laws_is_constant(short):
    """Observed: 1e-15 of the largest energy. The total work is the sum of the laws', and each law does some."""
    text, run = short
    assert "6 of 6 members converged" in text
    H, works = energy_of(run), works_of(run)
    total = sum(works.values())
    left = H - total
    assert (abs(left - left[0]).max(axis=0) / abs(H).max(axis=0)).max() < 1e-14
    np.testing.assert_allclose(run.state.work, total, rtol=0, atol=1e-14 * abs(H).max())
    assert all(np.abs(np.diff(work, axis=0)).max() > 0 for work in works.values())


def test_laws_of_control_act_in_their_windows(short):
    _, run = short
    works, t = works_of(run), np.asarray(run.t)
    bdot, unloading, wheels = (np.diff(works[x], axis=0) for x in ("B-dot", "unloading", "wheels"))
    before, after = t[1:] <= 100.0, t[:-1] >= 100.0
    assert (bdot[before] < 0).all()
    assert not bdot[after].any()
    assert not wheels[before].any()
    assert wheels[after].any()
    assert not unloading[t[1:] <= 200.0].any()
    assert unloading[t[:-1] >= 200.0].any()


def test_a_stored_run_is_opened_and_goes_on_with_its_orbit_and_field(short):
    """The functions of time are constants of the step, which the store describes."""
    _, run = short
    longer = run.load().extend(20)
    assert longer.t[-1] == run.t[-1] + 40
    again = li.open(run.facts.source).load().extend(20)
    np.testing.assert_array_equal(again.state.q[-1], longer.state.q[-1])


def test_the_report_lists_phases_and_works(short):
    text, run = short
    assert "never raised the energy between two saved times: 6 of 6" in text
    assert "energy less the work of all laws" in text
    rows = {name: cells for name, *cells in (re.split(r"  +", line.strip()) for line in text.splitlines())}
    assert rows["phase"] == ["detumbling", "pointing", "pointing and unloading"]
    edges = np.searchsorted(run.t, [0.0, 100.0, 200.0, run.t[-1]])
    for name, work in works_of(run).items():
        means = 1e6 * np.diff(work[edges].mean(axis=1))
        np.testing.assert_allclose(np.array(rows[f"work (µJ), mean: {name}"], float), means, rtol=0, atol=6e-5)


def test_the_picture_has_rates_angles_and_momenta(short):
    _, run = short
    t, x = np.asarray(run.t), np.ones((len(run.t), 6))
    series = {"rate (°/s)": 2 * x, "z axis from the nadir (°)": 90 * x, "momentum of the wheels (mN m s)": x}
    axes = cubesat.draw(t, series).axes
    assert [ax.get_ylabel() for ax in axes] == list(series)
    assert axes[0].get_yscale() == "log"
    assert axes[1].get_ylim() == (0, 180)


def test_the_members_have_inertias_and_dipoles_of_their_own(tmp_path):
    text, run = run_example(cubesat, tmp_path, members=100, steps=20)
    assert "residual dipole 0.002 A m²" in text
    gravity, dipole = run.step.system.laws[:2]
    J = np.asarray(gravity.inertia)
    P = np.trace(J, axis1=1, axis2=2)[:, None] / 2 - np.diagonal(J, axis1=1, axis2=2)
    np.testing.assert_allclose(J[0], np.diag(cubesat.INERTIA), rtol=0, atol=1e-16)
    np.testing.assert_allclose(np.std(np.log(P), axis=0), 0.05, rtol=0.25)
    np.testing.assert_allclose(np.std(dipole.moment, axis=0), 0.002, rtol=0.25)
    np.testing.assert_allclose(dipole.moment[0], cubesat.DIPOLE, rtol=1e-15)
    wheels = np.asarray(cubesat.WHEELS)
    body = J[0] - cubesat.WHEEL_INERTIA * wheels.T @ wheels
    np.testing.assert_allclose(run.step.system.inertia[0], body, rtol=0, atol=2e-21)


def test_at_rest_in_the_axes_of_the_orbit_z_points_to_the_nadir():
    """The frame in which the camera points: the body would rotate with the orbit."""
    orbit = li.orbits.kepler(1e9 * li.orbits.EARTH_GM, 6878e3, 0.001, np.deg2rad(97.4), node=np.deg2rad(40.0))
    frame = li.orbits.lvlh(orbit)
    r, v = (np.asarray(x) for x in orbit(300.0))
    q, normal = frame(300.0), np.cross(r, v)
    np.testing.assert_allclose(li.groups.so3.to_matrix(q)[:, 2], -r / np.linalg.norm(r), rtol=0, atol=1e-15)
    Omega = li.groups.so3.Ad(q, frame.angular_velocity(300.0))
    np.testing.assert_allclose(Omega, normal / (r @ r), rtol=0, atol=1e-17)


@pytest.mark.quick
def test_the_error_of_a_share_is_that_of_drawing_starts():
    """Against 20 000 draws of 400 starts, as the script computes it. Where all are captured, it is still not 0."""

    def error(k, n):
        p = (k + 0.5) / (n + 1)
        return np.sqrt(p * (1 - p) / (n + 2))

    drawn = np.random.default_rng(2).binomial(400, 0.3, 20_000) / 400
    assert error(120, 400) == pytest.approx(drawn.std(), rel=0.02)
    assert 5e-5 < error(10_000, 10_000) < 1e-4


def test_every_start_of_the_script_is_captured_and_unloaded(tmp_path):
    """Order of events: detumbling to below 0.5 °/s, the camera within 1° of the nadir, less momentum in the wheels."""
    text, run = run_example(cubesat, tmp_path, members=20)
    assert "at the end within 10° of the nadir: 20 of 20, (100.00 ± 3.25) % of all starts" in text
    balance = re.search(r"energy less the work of all laws +(\S+)", text)
    assert float(balance[1]) < 2e-14  # observed: 3e-15
    t, so3 = np.asarray(run.t), li.groups.so3
    rate = np.rad2deg(li.measure.rotation_rates(run))
    frame = li.orbits.lvlh(run.step.system.laws[0].orbit)
    down = jnp.array([0.0, 0.0, 1.0])
    nadir = np.rad2deg(li.measure.tilt(run, direction=lambda t: so3.Ad(frame(t), down)))
    wheels = np.linalg.norm(np.asarray(run.state.extra["wheels"]) @ np.asarray(cubesat.WHEELS), axis=-1)
    slow, pointed = np.searchsorted(t, [11400.0, 17100.0])
    assert (rate[slow] < cubesat.SLOW).all()
    assert (nadir[pointed:] < 1).all()
    assert np.median(wheels[-1]) < 0.7 * np.median(wheels[pointed])
    assert (np.diff(works_of(run)["B-dot"], axis=0) <= 0).all()
