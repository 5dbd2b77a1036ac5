"""Files of other software in scenarios, described by `lieint files`, and written by `lieint run --export`."""

import os
import shutil
from pathlib import Path

import data_files
import numpy as np
import pytest
from numpy.testing import assert_allclose

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import cli

EPOCH = "2024-03-01T12:00:00 UTC"
SHORT = dict(steps=20, save_every=10, members=2)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder with one file of each format."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(data_files.FOLDER / "samples" / "jobs", tmp_path, dirs_exist_ok=True)


def write_orbit(times=None):
    orbit = li.orbits.kepler(li.orbits.EARTH_GM, 7578.0, 0.1, 0.9, node=0.7, periapsis=1.5)
    facts = dict(epoch=EPOCH, frame="EME2000", center="EARTH", object="SAT")
    li.files.write_oem("sat.oem", orbit, times=np.arange(-60.0, 900.0, 10.0) if times is None else times, **facts)
    return orbit


def table(name, **changes):
    """The keys of a shipped scenario without some, `KEY=None`, with others."""
    keys = scenarios.table(name) | SHORT | changes
    return {key: x for key, x in keys.items() if x is not None}


def test_a_body_has_the_inertia_of_a_file():
    """A box of 2 × 1 × 3 with density 2: m (b² + c²)/12, in the file's axes; of several bodies the principal ones."""
    keys = table("driven", inertia=None, shape={"file": "box.obj", "density": 2.0})
    found = scenarios.parse(keys, "mine.toml")
    assert_allclose(found.inertia, np.diag([10.0, 13.0, 5.0]), rtol=1e-14, atol=1e-14)
    hand = scenarios.parse(table("driven", inertia=None, shape={"file": "arm.urdf", "link": "hand"}), "mine.toml")
    assert_allclose(hand.inertia, [[3, 0, 0], [0, 4, 0.1], [0, 0.1, 5]], rtol=1e-14, atol=1e-14)
    bodies = table("sn263")
    first = {k: x for k, x in bodies["bodies"][0].items() if k not in ("semi_axes_m", "density_kg_m3", "mass_kg")}
    bodies["bodies"][0] = first | {"shape": {"file": "box.obj", "mass": 6.0, "scale": 10.0}}
    body = scenarios.parse(bodies, "mine.toml").bodies[0]
    assert body.mass_kg == 6.0
    assert_allclose(body.moments_kg_m2, [250.0, 500.0, 650.0], rtol=1e-14)


@pytest.mark.long
def test_a_satellite_on_the_orbit_of_a_file_moves_as_on_its_kepler_orbit():
    """To the error of a cubic between entries 10 s apart."""
    orbit = write_orbit()
    keys = table("driven", orbit={"file": "sat.oem"}, steps_per_orbit=None, dt=16.0, epoch=EPOCH)
    given = scenarios.parse(keys, "mine.toml")
    assert given.orbit is None
    step, states = given.build(np.arange(1))
    exact = li.schemes.top_energy_momentum(li.systems.gravity_gradient(given.inertia, orbit))
    ends = [li.run(x, states, 16.0, 20, save_every=20, progress=False).state.q[-1] for x in (step, exact)]
    assert_allclose(*ends, rtol=0, atol=1e-9)
    later = scenarios.parse({key: x for key, x in keys.items() if key != "epoch"}, "mine.toml")
    assert later.epoch == "2024-03-01T11:59:00 UTC"
    assert later.ephemeris.times[0] == 0.0


def test_a_satellite_on_the_orbit_of_sgp4():
    """Of the kind `satellite`, in m; the epoch is that of the elements, and follows the Earth's field."""
    pytest.importorskip("sgp4")
    found = scenarios.parse(table("cubesat", orbit={"file": "iss.tle"}, date=None, steps=100), "mine.toml")
    assert found.date_of_zero() == EPOCH
    r, v = found.environment().orbit(0.0)
    reference = li.files.read_tle("iss.tle").orbit((-60.0, 60.0))
    assert_allclose(r, 1e3 * np.asarray(reference(0.0)[0]), rtol=0, atol=0.4)  # m: h⁴n⁴/384 of the radius, h = 60 s
    assert_allclose(v, 1e3 * np.asarray(reference(0.0)[1]), rtol=0, atol=0.02)
    expected = li.orbits.earth_field(reference, EPOCH)(0.0)  # in TEME, by mean sidereal time
    assert_allclose(found.environment().field(0.0), expected, rtol=0, atol=1e-6 * np.linalg.norm(expected))


def test_observations_are_those_of_a_log():
    Path("seen.csv").write_text("t,qw,qx,qy,qz,wx,wy,wz\n0,1,0,0,0,1,2,3\n43200,0,1,0,0,-1,0,0\n", encoding="utf-8")
    seen = {"file": "seen.csv", "units": {"rates": "deg/s"}, "source": "zhao"}
    keys = table("toutatis", observation=seen, dt=0.005, steps=200, save_every=100)
    first, second = scenarios.parse(keys, "mine.toml").observation
    assert (first.t, second.t, second.label, second.source) == (0.0, 0.5, "seen.csv, 2", "zhao")
    assert second.quaternion == [0.0, 1.0, 0.0, 0.0]
    assert_allclose(first.angular_velocity_rad, np.deg2rad([1.0, 2.0, 3.0]) * 86400, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("driven", {"shape": {"file": "box.obj", "density": 1.0}}, "shape gives inertia: leave out one of both"),
        (
            "driven",
            {"inertia": None, "shape": {"file": "box.obj"}},
            "shape: give exactly one of mass, density; got none",
        ),
        (
            "driven",
            {"inertia": None, "shape": {"file": "ball.obj"}},
            "shape: there is no file 'ball.obj', neither here",
        ),
        ("driven", {"inertia": None, "shape": {"file": "box.obj", "weight": 1}}, "shape: weight: unknown key"),
        ("driven", {"orbit": {"file": "box.obj"}}, "orbit: an orbit is read from OEM, .*; this is shape"),
        ("driven", {"orbit": {"file": "sat.oem"}}, "steps_per_orbit is a key of ellipses"),
        (
            "driven",
            {"orbit": {"file": "sat.oem"}, "dt": 1e3, "steps_per_orbit": None},
            "the orbit is given from t = 0 to 950, the run 0 to 20000",
        ),
        ("toutatis", {"observation": {"file": "box.obj"}}, "observation: .*box.obj"),
        ("toutatis", {"time_unit": "year", "observation": {"file": "box.obj"}}, "time_unit must be one of s, min"),
        ("toutatis", {"title": {"file": "box.obj"}}, "title: Input should be a valid string"),
    ],
)
def test_what_a_file_cannot_be_is_named(name, changes, message):
    write_orbit()
    with pytest.raises(ValueError, match=f"mine.toml: .*{message}"):
        scenarios.parse(table(name, **changes), "mine.toml")


def test_results_hold_the_numbers_and_open_no_file(capsys):
    """A stranger's file of results cannot make `lieint plot` read another file."""
    keys = table("driven", inertia=None, shape={"file": "box.obj", "density": 2.0})
    dumped = scenarios.parse(keys, "mine.toml").model_dump()
    assert "box.obj" not in str(dumped)
    assert scenarios.from_results(dumped, "run.npz").inertia == dumped["inertia"]
    with pytest.raises(ValueError, match=r"run\.npz: .*shape: unknown key"):
        scenarios.from_results(dumped | {"shape": {"file": "box.obj", "density": 1.0}}, "run.npz")


def test_the_schema_has_the_keys_of_files():
    kind = scenarios.schema()["$defs"]["Driven"]["properties"]
    assert kind["shape"]["required"] == ["file"]
    assert any("segment" in choice.get("properties", {}) for choice in kind["orbit"]["anyOf"])


@pytest.mark.parametrize(
    ("file", "parts"),
    [
        ("sat.oem", ["CCSDS OEM", "SAT about EARTH, axes EME2000", "96 states", 'orbit = {file = "sat.oem"}']),
        ("sat.aem", ["CCSDS AEM", "11 attitudes from 2024-03-01T12:00:00 UTC over 1 s", "read_aem("]),
        ("iss.tle", ["TLE", "ISS (ZARYA), mean elements of 2024-03-01T12:00:00", "15.4956 revolutions a day"]),
        ("box.obj", ["8 vertices, 12 triangles, 2 × 1 × 3, volume 6", "read_shape("]),
        ("arm.urdf", ["URDF", 'read_urdf_inertia("arm.urdf", link)']),
        ("water.xyz", ["1 molecule(s), the first of 3 atoms and 18.01"]),
        ("lc.txt", ["1 curve(s) of 2 points, JD 2451545.00000 to 2451545.10000"]),
        ("sat.csv", ["11 rows of time, q_w, q_x, q_y, q_z, angular_velocity_x"]),
    ],
)
def test_a_file_is_described(file, parts, lieint):
    write_orbit()
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    run = li.run(li.schemes.so3_midpoint(body), state, 0.1, 10, epoch=EPOCH, progress=False)
    li.files.write_aem("sat.aem", run, object="SAT")
    li.files.write_csv("sat.csv", run)
    out = lieint("files", file)
    assert [part for part in parts if part not in out] == [], out


def test_a_file_of_no_format_is_refused(lieint):
    Path("noise.bin").write_bytes(bytes(range(256)))
    assert "noise.bin has none of the formats OEM, AEM" in lieint.refuse("files", "noise.bin")
    Path("my.toml").write_text('title = "My body"\nsystem = "rigid_body"\n')  # "table" before, as a CSV with two words
    assert "lieint run runs a scenario" in lieint.refuse("files", "my.toml")


def test_files_before_one_that_is_refused_are_described(lieint, capsys):
    assert cli.main(["files", "box.obj", "nothing.oem"]) == 2
    out, err = capsys.readouterr()
    assert "box.obj: a surface of triangles" in out
    assert "there is no file nothing.oem" in err


@pytest.mark.long
def test_a_run_is_exported(lieint):
    """The nominal member as AEM and, with all others, as CSV and netCDF: equal to the digits of each."""
    arguments = ["run", "driven", "--members", "2", "--steps", "40", "--no-pictures", "--no-certificate"]
    exports = [f"sat{end}" for end in (".aem", ".csv", ".nc")]
    given = [x for file in exports for x in ("--export", file)]
    assert "sat.aem, sat.csv, sat.nc" in lieint(*arguments, "--set", f"epoch={EPOCH}", "--out", "run.npz", *given)
    with np.load("run.npz") as stored:
        q, t = stored["q"], stored["t"]
    found = li.files.read_aem("sat.aem")
    assert str(found.epoch) == EPOCH
    signs = np.sign(np.sum(found.attitudes * q[:, 0], axis=1, keepdims=True))
    assert_allclose(found.attitudes * signs, q[:, 0], rtol=0, atol=1e-15)
    log = li.files.read_csv_log("sat.csv", time="time", attitudes=["q_w", "q_x", "q_y", "q_z"], member=1)
    assert_allclose(log.times, t, rtol=0, atol=0)
    assert_allclose(abs(np.sum(log.attitudes * q[:, 1], axis=1)), 1.0, rtol=0, atol=4e-16)
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset("sat.nc") as data:
        assert_allclose(data["q"].values.reshape(q.shape), q, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("sat.txt", "--export writes .aem, .oem, .csv, .nc"),
        ("box.obj", "--export writes"),
        ("no/sat.csv", "there is no folder"),
        ("sat.aem", "needs the date of t = 0"),
    ],
)
def test_what_cannot_be_exported_is_refused_before_the_run(file, message, lieint):
    assert message in lieint.refuse("run", "driven", "--export", file)


@pytest.mark.parametrize("ending", [".csv", ".aem"])
def test_a_run_without_attitudes_is_not_exported_as_such(ending, lieint, monkeypatch):
    given = ["run", "pendulum", "--set", f"epoch={EPOCH}", "--export", f"x{ending}"]
    assert f"x{ending} has attitudes of rigid bodies, and Pendulum is none: .nc has any run" in lieint.refuse(*given)
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert f"the folder of x{ending} cannot be written to" in lieint.refuse(*given)
    assert not list(Path().glob("pendulum*"))


@pytest.mark.long
def test_the_orbit_of_a_binary_is_exported():
    assert cli.main(["run", "sn263", "--members", "1", "--steps", "40", "--no-pictures", "--no-certificate",
                     "--set", f"epoch={EPOCH}", "--out", "run.npz", "--export", "moon.oem"]) == 0  # fmt: skip
    found = li.files.read_oem("moon.oem")
    with np.load("run.npz") as stored:
        x = stored["q"][:, 0, :, :3]
    assert_allclose(found.positions, 1e-3 * (x[:, 1] - x[:, 0]), rtol=1e-14)


@pytest.mark.long
def test_the_orbit_of_a_satellite_is_exported():
    assert cli.main(["run", "cubesat", "--members", "1", "--set", "steps=40", "--set", "save_every=10", "--no-pictures",
                     "--out", "run.npz", "--export", "sat.oem"]) == 0  # fmt: skip
    found = li.files.read_oem("sat.oem")
    assert found.times.tolist() == np.load("run.npz")["t"].tolist()
    height = np.linalg.norm(found.positions, axis=1) - 6371
    assert ((height > 300) & (height < 800)).all()
    swept = (
        np.diff(found.positions, axis=0)
        - (found.velocities[1:] + found.velocities[:-1]) / 2 * np.diff(found.times)[:, None]
    )
    assert np.abs(swept).max() < 1e-3 * np.abs(np.diff(found.positions, axis=0)).max()
