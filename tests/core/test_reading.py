"""Runs read back: a store gives its system too, old stores and files still open, and any run of a system is drawn."""

import json
import re
import shutil
import zipfile
from functools import partial
from pathlib import Path

import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import lieint_jax as li
from lieint_jax.app.command import cli
from lieint_jax.runs import store as archives
from lieint_jax.runs.store._description import describe, make
from lieint_jax.systems._pseudo_rigid_body import examples as pseudo_rigid_bodies
from lieint_jax.systems._shared.older_laws import OlderLaw

DATA = Path(__file__).parents[1] / "data"
BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATES = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))(
    np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8], [-1.0, 0.1, 0.0]])
)
EXAMPLES = {name.partition("-")[0]: step for name, step, *_ in reversed(grid.steps())}  # the first step of each


def stored(tmp_path, **options):
    """A short run of three bodies in a store."""
    path, step = tmp_path / "run.zarr", li.schemes.so3_midpoint(BODY)
    run = li.ensemble.run(step, STATES, 0.05, 20, save_every=10, store=path, progress=False, **options)
    return path, run


@pytest.mark.parametrize(("name", "body"), [pytest.param(name, x[0], id=name) for name, x in grid.systems()])
def test_every_system_of_the_package_is_made_again_from_its_description(name, body):
    """The same leaves, bit for bit, and the same structure: jit takes the same program."""
    description, arrays = describe(EXAMPLES[name])
    assert sorted(arrays)
    again = make(json.loads(json.dumps(description))["system"], arrays, {})
    assert jax.tree.structure(again) == jax.tree.structure(body)
    jax.tree.map(np.testing.assert_array_equal, again, body)


@pytest.mark.long
def test_a_store_gives_the_trajectory_and_the_system_back(tmp_path):
    path, run = stored(tmp_path)
    again, body = li.ensemble.open(path)
    np.testing.assert_array_equal(again.state.q[:], run.state.q[:])
    assert jax.tree.structure(body) == jax.tree.structure(BODY)
    last = jax.tree.map(lambda x: jnp.asarray(x[-1]), again.state)
    np.testing.assert_array_equal(jax.vmap(body.energy)(last), jax.vmap(BODY.energy)(last))
    shown = xarray.open_zarr(path)
    np.testing.assert_array_equal(shown.system_inertia, [1, 2, 3])
    assert (shown.attrs["format"], shown.attrs["leaves"]) == (7, ["q", "p"])


@pytest.mark.long
@pytest.mark.parametrize("step", [pytest.param(step, id=name) for name, step, *_ in grid.steps()])
def test_every_step_of_the_package_is_made_again_from_its_description(step):
    description, arrays = describe(step)
    description = json.loads(json.dumps(description))
    again = make(description["step"], arrays, {}, make(description["system"], arrays, {}))
    assert jax.tree.structure(again) == jax.tree.structure(step)
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(step), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.long
def test_systems_of_members_are_read_back(tmp_path):
    J = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [2.0, 4.0, 5.0]])
    steps = jax.vmap(lambda J: li.schemes.so3_midpoint(li.systems.RigidBody(J)))(J)
    li.ensemble.run(steps, STATES, 0.05, 4, store=tmp_path / "own.zarr", step_axis=0, progress=False)
    run, bodies = li.ensemble.open(tmp_path / "own.zarr")
    np.testing.assert_array_equal(bodies.inertia, J)
    assert xarray.open_zarr(tmp_path / "own.zarr").system_inertia.dims[0] == "member"
    last = jax.tree.map(lambda x: jnp.asarray(x[-1]), run.state)
    energies = jax.vmap(lambda body, z: body.energy(z))
    np.testing.assert_allclose(energies(bodies, last), energies(bodies, STATES), rtol=2e-15)  # seen: 4e-16


@pytest.mark.long
def test_a_summary_is_read_back_with_its_system(tmp_path):
    path, run = stored(tmp_path, reduce="energy")
    again, body = li.ensemble.open(path)
    np.testing.assert_array_equal(again.greatest, run.greatest)
    np.testing.assert_array_equal(body.inertia, [1, 2, 3])


def my_wells(R):
    return jnp.sum(R**4)


@pytest.mark.long
def test_a_custom_function_is_requested_by_its_name():
    top = li.systems.potential_top([1.0, 2.0, 3.0], my_wells, axis=None)
    description, arrays = describe(li.schemes.splitting(top))
    name = f"{my_wells.__module__}.my_wells"
    with pytest.raises(ValueError, match=f"'{name}' does not belong to this package: pass it as own=.* to li.open"):
        make(description["system"], arrays, {})
    again = make(description["system"], arrays, {name: my_wells})
    assert jax.tree.structure(again) == jax.tree.structure(top)


@pytest.mark.parametrize(
    ("stored", "present"),
    [
        ("lieint_jax.systems.heavy_top.Linear", li.systems.LinearPotential),  # by version 0.2
        ("lieint_jax.systems._heavy_top.Linear", li.systems.LinearPotential),  # by 0.3.0, as all below
        ("lieint_jax.torques._older.OlderLaw", OlderLaw),
        ("lieint_jax.schemes._shared.free_bodies.FreeFlight", li.schemes.FreeFlight),
        ("lieint_jax.types.Total", li.types.LawSum),
    ],
)
def test_names_that_earlier_versions_stored_are_found(stored, present):
    assert make({"name": stored}, {}, {}) is present


def of_version_0_4(name, **fields):
    """The description of an object as version 0.4 stored it."""
    numbers = {key: {"constant": x, "dtype": "<f8"} for key, x in fields.items() if isinstance(x, float | list)}
    return {"class": f"lieint_jax.{name}", "fields": fields | numbers}


def test_fields_that_version_0_4_stored_are_found():
    """They have other names now, or are in another object."""
    position, velocity = [0.0, 2.0, 0.0], [-0.7, 0.0, 0.1]
    kepler = of_version_0_4("orbits.KeplerFromState", mu=1.0, position=position, velocity=velocity, start=0.5)
    air = of_version_0_4("orbits.Air", orbit=kepler, density=0.3, distance=1.9, scale_height=0.2, rate=0.06)
    light = of_version_0_4("orbits.Eclipse", orbit=kepler, sun=[0.0, -1.0, 0.0], radius=1.0, angle=0.1, cylinder=True)
    plates = of_version_0_4("torques.Plates", sizes=[2.0], normals=[[1.0, 0.0, 0.0]], arms=[[0.0, 1.0, 0.5]])
    sail = {"plates": plates, "sun": [0.6, 0.8, 0.0], "light": None, "specular": 0.3, "diffuse": 0.1}
    orbit = li.orbits.from_state(1.0, position, velocity, 0.5)
    around = li.orbits.atmosphere(orbit, 0.3, 0.2, 0.9, radius=1.0, rate=0.06)
    plate = [2.0], [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.5]]
    instant = jnp.array(0.3), jnp.array([0.8, 0.0, 0.6, 0.0]), jnp.array([0.5, -0.2, 0.3])
    for stored, present, arguments in (
        (kepler, orbit, instant[:1]),
        (air, around, instant[:1]),
        (light, li.orbits.eclipse(orbit, [0.0, -1.0, 0.0], 1.0, "cylindrical", angle=0.1), instant[:1]),
        (
            of_version_0_4("torques.SolarPlates", **sail),
            li.torques.solar_plates(*plate, [0.6, 0.8, 0.0], specular=0.3, diffuse=0.1),
            instant,
        ),
        (
            of_version_0_4("torques.Aerodynamic", plates=plates, air=air, drag=2.0),
            li.torques.aerodynamic(around, *plate, drag=2.0),
            instant,
        ),
    ):
        again = make(stored, {}, {})
        assert jax.tree.structure(again) == jax.tree.structure(present)
        jax.tree.map(np.testing.assert_array_equal, again(*arguments), present(*arguments))


@pytest.mark.parametrize(
    "name",
    ["os.system", "lieint_jax.nothing", "lieint_jax.app.command.cli.os.system", "lieint_jax.runs._storage.disk.shutil"],
)
def test_a_description_cannot_name_code_outside_the_package(name):
    with pytest.raises(ValueError, match="does not belong to this package"):
        make({"name": name}, {}, {})


def test_a_damaged_constant_array_raises_an_error(tmp_path):
    path, _ = stored(tmp_path)
    [chunk] = (path / "system_inertia" / "c").rglob("0")
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(ValueError, match=r"system_inertia/c/0 is altered"):
        li.ensemble.open(path)


def old(tmp_path, name):
    """Results that version 0.1, 0.2 or 0.3 wrote."""
    if name.endswith(".npz"):
        return shutil.copy(DATA / name, tmp_path / name)
    with zipfile.ZipFile(DATA / f"{name}.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path / re.sub(r"-0\.\d", "", name)


@pytest.mark.long
def test_results_of_version_0_1_still_open(tmp_path, lieint):
    path = old(tmp_path, "toutatis-0.1.npz")
    run, _ = archives.load_results(Path(path))
    assert run.state.q.shape == (11, 2, 4)
    assert "2 of 2 members converged at every step" in lieint("info", str(path))


@pytest.mark.long
def test_results_of_version_0_1_are_drawn(tmp_path, lieint):
    assert "precession period" in lieint("plot", str(old(tmp_path, "toutatis-0.1.npz")))


@pytest.mark.parametrize("resume", [True, False])
def test_a_store_of_version_0_1_is_refused_with_what_reads_it(tmp_path, resume):
    path = old(tmp_path, "toutatis-0.1.zarr")
    step = li.schemes.so3_midpoint(BODY)
    resumed = partial(li.ensemble.run, step, STATES, 0.05, 20, store=path, resume=True, progress=False)
    with pytest.raises(ValueError, match=r"was written by version 0.1: only its states can be read, by xarray"):
        resumed() if resume else li.ensemble.open(path)


def test_a_store_of_version_0_2_still_opens_and_is_checked(tmp_path):
    """Its names have dots, and its chunks have checksums but no record of their places."""
    path = old(tmp_path, "gyrostat-0.2.zarr")
    run, body = li.ensemble.open(path)
    np.testing.assert_allclose(run.state.extra["rotor"][-1], [[0.0, 0.0, 0.15]] * 2, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(body.motor.momentum, [0.0, 0.0, 0.3])
    assert run.state.t.shape == run.state.work.shape == (3, 2)
    step = li.schemes.so3_midpoint(BODY)
    with pytest.raises(ValueError, match=r"was written by an older version.*run again into another store"):
        li.ensemble.run(step, STATES, 0.05, 20, store=path, resume=True, progress=False)
    chunk = path / "extra.rotor" / "c" / "0" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(ValueError, match=r"extra.rotor/c/0/0/0 is altered \(extra.rotor of time 0 … 2, member 0 … 1\)"):
        li.ensemble.open(path)


def test_a_store_of_version_0_3_that_is_not_complete_still_opens(tmp_path):
    """Its checkpoint is in arrays, and κ of its step has a name of JAX."""
    run = li.open(old(tmp_path, "body-0.3.zarr"))
    assert "not complete" in repr(run)
    assert jax.tree.structure(run.step) == jax.tree.structure(li.schemes.so3_midpoint(BODY))
    again = li.run(run.step, jax.tree.map(lambda x: x[0], run.state), 0.05, 35, save_every=5, progress=False)
    np.testing.assert_allclose(run.state.q[:], again.state.q, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(run.failed, [-1, -1])
    assert np.abs(run.energy_error()).max() < 2e-15  # observed: 2e-16
    with pytest.raises(ValueError, match=r"was written by an older version.*run again into another store"):
        li.run(run.step, STATES, 0.05, 60, save_every=5, store=tmp_path / "body.zarr", resume=True, progress=False)


@pytest.mark.long
def test_any_run_of_a_known_system_is_drawn_and_drawn_again(tmp_path, lieint):
    path, _ = stored(tmp_path)
    (tmp_path / "pictures").mkdir()
    assert "3 of 3 members converged at every step" in lieint("plot", str(path), "--out", str(tmp_path / "pictures"))
    picture = tmp_path / "pictures" / "run-invariants.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "pictures" / "run-motion.png").exists()
    picture.write_text("precious")
    assert "run-invariants.png exists and is not overwritten; --force" in lieint.refuse(
        "plot", str(path), "--out", str(tmp_path / "pictures")
    )
    assert picture.read_text() == "precious"
    assert cli.main(["plot", str(path), "--out", str(tmp_path / "pictures"), "--force"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "nowhere does not exist" in lieint.refuse("plot", str(path), "--out", str(tmp_path / "nowhere"))


@pytest.mark.long
def test_summaries_and_matrices_are_drawn(tmp_path):
    path, _ = stored(tmp_path, reduce="energy")
    assert cli.main(["plot", str(path)]) == 0
    assert (tmp_path / "run-change.png").exists()
    body, state, dt = pseudo_rigid_bodies()["ball"]
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    li.ensemble.run(
        li.schemes.additive(body), states, dt, 20, save_every=2, store=tmp_path / "ball.zarr", progress=False
    )
    assert cli.main(["plot", str(tmp_path / "ball.zarr")]) == 0
    assert (tmp_path / "ball-motion.png").exists()
