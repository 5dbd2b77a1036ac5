"""Ten jobs that begin and end with files of other software, each in at most six lines."""

import shutil
from pathlib import Path

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import lieint_jax as li

TETRAHEDRON = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]])
JOBS = [*data_files.table("ten_jobs").values()]


def write_files():
    """What each job begins with, made by the exact motion where it is data."""
    shutil.copytree(data_files.FOLDER / "samples" / "jobs", ".", dirs_exist_ok=True)
    rng = np.random.default_rng(0)
    body = li.systems.rigid_body([0.6, 0.8, 1.0])
    start, t = body.state(angular_velocity=[0.5, 0.3, 0.4]), np.linspace(0.0, 12.0, 25)
    rates = np.array([body.angular_velocity(body.solution(start, x)) for x in t])
    rows = np.column_stack([t, np.rad2deg(rates + 0.002 * rng.normal(size=rates.shape))])
    np.savetxt("gyro.csv", rows, "%.7f", ",", header="t,x,y,z", comments="")
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    start, t = body.state(angular_velocity=[0.2, 0.0, 1.0]), np.linspace(0.0, 4.0, 9)
    q = np.array([body.solution(start, x).q for x in t])
    noise = np.array([li.groups.so3.exp(x) for x in 1e-4 * rng.normal(size=(len(t), 3))])
    noise[0] = [1, 0, 0, 0]
    q = np.array([li.groups.so3.multiply(a, b) for a, b in zip(q, noise, strict=True)])
    np.savetxt("star.csv", np.column_stack([t, np.roll(q, -1, axis=1)]), "%.8f", ",", header="t,x,y,z,w", comments="")
    facts = dict(epoch="2024-03-01T12:00:00 UTC", frame="EME2000", center="EARTH", object="SAT")
    circle = li.orbits.kepler(li.orbits.EARTH_GM, 7e3, 0.0, 0.9)
    li.files.write_oem("sat.oem", circle, times=np.arange(0.0, 1000.0, 20.0), **facts)
    hyperbola = li.orbits.kepler(li.orbits.EARTH_GM, -2e4, 2.0, periapsis_time=30_000.0)
    start = li.dates.epoch("2000-01-01T12:00:00 TDB")
    lines = [
        "Start time      : A.D. 2000-Jan-01 12:00:00.0000 TDB",
        "Output units    : KM-S",
        "Center body name: Earth (399)",
        "Target body name: Rock",
        "Reference frame : ICRF",
    ]
    lines.append("$$SOE")
    for x in np.arange(0.0, 60_001.0, 120.0):
        r, v = hyperbola(x)
        day, _, hour = (start + x).iso(0).partition("T")
        lines.append(f"{2451545.0 + x / 86400:.9f} = A.D. {day.replace('-01-', '-Jan-')} {hour}.0000 TDB ")
        lines.append(" X = {:.15E} Y = {:.15E} Z = {:.15E}".format(*np.asarray(r)))
        lines.append(" VX= {:.15E} VY= {:.15E} VZ= {:.15E}".format(*np.asarray(v)))
    Path("flyby.txt").write_text("\n".join([*lines, "$$EOE", ""]), encoding="utf-8")
    shape = [f"{len(CORNERS)} {len(TETRAHEDRON)}", *(" ".join(map(str, row)) for row in CORNERS)]
    shape += [" ".join(str(k + 1) for k in face) for face in TETRAHEDRON]
    Path("shape.txt").write_text("\n".join([*shape, ""]), encoding="utf-8")
    meta = ["STARTMETADATA", "OBJECTNUMBER=1", "OBJECTNAME=Rock", "FILTER=V", "DELIMITER=PIPE", "ENDMETADATA"]
    meta += [f"DATA={2459000.5 + 0.01 * k:.6f}|{15 + 0.1 * np.sin(k):.3f}|0.010" for k in range(20)] + ["ENDDATA"]
    Path("seen.alcdef").write_text("\n".join([*meta, ""]), encoding="utf-8")
    facets = [_facet(face) for face in TETRAHEDRON]
    Path("part.stl").write_text("\n".join(["solid part", *facets, "endsolid part", ""]), encoding="utf-8")


def _facet(face):
    corners = [f"vertex {x} {y} {z}" for x, y, z in CORNERS[list(face)]]
    return "\n".join(["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files with which the jobs begin."""
    place = tmp_path_factory.mktemp("jobs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_files()
    return place


def do(number, folder, patch, **given):
    """The names that a job defines, run in the folder."""
    patch.chdir(folder)
    code = JOBS[number]
    assert len(code.splitlines()) <= 6
    names = {"li": li, "jax": jax, "jnp": jnp, **given}
    exec(code, names)
    return names


@pytest.mark.long
def test_the_inertia_of_a_gyro(folder, monkeypatch):
    """Within four standard errors of what made the log, and these are of the size of the noise."""
    guess = {"ratios": jnp.array([0.65, 0.85]), "rate": jnp.array([0.48, 0.32, 0.42])}
    bounds = {"ratios": li.fitting.inertia_ratios, "rate": li.fitting.free}
    fit = do(0, folder, monkeypatch, guess=guess, bounds=bounds)["fit"]
    assert fit.success
    error = np.asarray(fit.standard_errors["ratios"])
    assert (abs(np.asarray(fit.params["ratios"]) - [0.6, 0.8]) < 4 * error).all()
    assert (error > 1e-4).all()
    assert (error < 0.02).all()


def test_attitudes_along_an_oem(folder, monkeypatch):
    found = do(1, folder, monkeypatch)
    again = li.files.read_aem("sat.aem")
    assert again.epoch == found["orbit"].epoch
    assert again.object == "SAT"
    assert_allclose(again.attitudes, found["run"].state.q, rtol=0, atol=1e-15)
    assert abs(found["run"].energy_error()).max() < 1e-3 * abs(found["body"].energy(found["start"]))


@pytest.mark.long
def test_detumbling_along_a_tle(folder, monkeypatch):
    pytest.importorskip("sgp4")
    found = do(2, folder, monkeypatch)
    rates = np.linalg.norm(found["run"].map(lambda step, z: step.system.angular_velocity(z)), axis=1)
    assert rates[-1] < 0.9 * rates[0]
    assert abs(found["run"].energy_error()).max() < 1e-14


@pytest.mark.long
def test_a_light_curve_beside_one_seen(folder, monkeypatch):
    """At the dates of the observations; the first value is that of `brightness` at the initial attitude."""
    found = do(3, folder, monkeypatch)
    light = np.asarray(found["light"])
    assert light.shape == found["seen"].intensity.shape == (20,)
    facets = li.shapes.facets(found["corners"], found["faces"])
    first = li.measure.brightness(facets, jnp.eye(3), jnp.array([1.0, 0, 0]), jnp.array([1.0, 0.2, 0]))
    assert_allclose(light[0], first, rtol=1e-13)
    assert np.ptp(light) > 0.1 * light.max()


def test_the_flight_of_a_part_of_a_robot(folder, monkeypatch):
    found = do(4, folder, monkeypatch)
    assert_allclose(found["hand"].inertia, [[3, 0, 0], [0, 4, 0.1], [0, 0.1, 5]], rtol=1e-14, atol=1e-14)
    assert abs(found["run"].momentum_error()).max() < 1e-13


@pytest.mark.long
def test_a_flyby_along_horizons(folder, monkeypatch):
    """The torque of the passage changes the spin, and the table carries the closest approach of 20 000 km."""
    found = do(5, folder, monkeypatch)
    assert_allclose(np.linalg.norm(found["orbit"](30_000.0)[0]), 20_000.0, rtol=1e-6)
    p = np.asarray(found["run"].state.p)
    assert np.linalg.norm(p[-1] - p[0]) > 1e-3 * np.linalg.norm(p[0])


@pytest.mark.long
def test_the_energy_of_a_dimer(folder, monkeypatch):
    """The sum over pairs of sites of the model that lie on the molecules, by hand."""
    found = do(6, folder, monkeypatch)
    water, placed = found["water"], found["placed"]
    assert max(p.rms for p in placed) < 0.002  # nm
    rotations = Rotation.from_quat([np.roll(p.attitude, -1) for p in placed])
    a, b = (p.position + R.apply(water.points) for p, R in zip(placed, rotations, strict=True))
    d = np.linalg.norm(a[:, None] - b[None], axis=-1)
    energy = 138.935458 * np.sum(np.outer(water.charges, water.charges) / d)
    energy += 4 * water.wells[0] * ((water.sizes[0] / d[0, 0]) ** 12 - (water.sizes[0] / d[0, 0]) ** 6)
    assert_allclose(found["energy"], energy, rtol=1e-6)  # of Coulomb's constant, which has nine digits


@pytest.mark.long
def test_the_covariance_of_a_rate(folder, monkeypatch):

    def angle(a, b):
        so3 = li.groups.so3
        return so3.log(so3.multiply(so3.inverse(a), b))

    fit = do(7, folder, monkeypatch, angle=angle)["fit"]
    assert fit.success
    error = np.sqrt(np.diag(fit.covariance))
    assert (abs(np.asarray(fit.params) - [0.2, 0.0, 1.0]) < 5 * error).all()


def test_a_run_as_tables(folder, monkeypatch):
    pytest.importorskip("pandas")
    xarray = pytest.importorskip("xarray")
    found = do(8, folder, monkeypatch)
    q = np.asarray(found["run"].state.q)
    assert_allclose(found["frame"][["q_w", "q_x", "q_y", "q_z"]].to_numpy(), q, rtol=0, atol=0)
    log = li.files.read_csv_log("run.csv", time="time", attitudes=["q_w", "q_x", "q_y", "q_z"])
    assert_allclose(log.attitudes, q, rtol=0, atol=3e-16)
    with xarray.open_dataset("run.nc") as data:
        assert_allclose(data["q"], q, rtol=0, atol=0)


def test_the_moments_of_an_stl(folder, monkeypatch):
    """A tetrahedron with legs aᵢ has the mass ρa₁a₂a₃/6, and second moments m(4δᵢⱼ − 1)aᵢaⱼ/80 about its center."""
    found = do(9, folder, monkeypatch)
    legs = 1e-3 * np.array([2.0, 3.0, 4.0])
    mass = 2700 * legs.prod() / 6
    second = mass / 80 * (4 * np.eye(3) - 1) * np.outer(legs, legs)
    assert_allclose(found["body"].mass, mass, rtol=1e-6)
    assert_allclose(found["moments"], np.linalg.eigvalsh(np.trace(second) * np.eye(3) - second), rtol=1e-6)
