"""Runs read back: a store gives its system too, and any run of a system is drawn."""

import json
from pathlib import Path

import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import lieint_jax as li
from lieint_jax.command import cli
from lieint_jax.runs.store._description import describe, make
from lieint_jax.systems._pseudo_rigid_body import examples as pseudo_rigid_bodies

DATA = Path(__file__).parents[1] / "data"
BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATES = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))(
    np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8], [-1.0, 0.1, 0.0]])
)
EXAMPLES = {name.partition("-")[0]: step for name, step, *_ in reversed(grid.steps())}  # the first step of each


def stored(tmp_path, **options):
    """A short run of three bodies in a store."""
    path, step = tmp_path / "run.zarr", li.schemes.so3_midpoint(BODY)
    run = li.run(step, STATES, 0.05, 20, save_every=10, store=path, progress=False, **options)
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
    again = li.open(path)
    body = again.system
    np.testing.assert_array_equal(again.state.q[:], run.state.q[:])
    assert jax.tree.structure(body) == jax.tree.structure(BODY)
    last = jax.tree.map(lambda x: jnp.asarray(x[-1]), again.state)
    np.testing.assert_array_equal(jax.vmap(body.energy)(last), jax.vmap(BODY.energy)(last))
    shown = xarray.open_zarr(path)
    np.testing.assert_array_equal(xarray.open_zarr(path, group="step").system_inertia, [1, 2, 3])
    assert "system_inertia" not in shown
    assert (shown.attrs["format"], shown.attrs["leaves"]) == (8, ["q", "p"])


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
    li.run(steps, STATES, 0.05, 4, store=tmp_path / "own.zarr", own_step=True, progress=False, save_every=None)
    run = li.open(tmp_path / "own.zarr")
    bodies = run.system
    np.testing.assert_array_equal(bodies.inertia, J)
    assert xarray.open_zarr(tmp_path / "own.zarr", group="step").system_inertia.dims[0] == "member"
    last = jax.tree.map(lambda x: jnp.asarray(x[-1]), run.state)
    energies = jax.vmap(lambda body, z: body.energy(z))
    np.testing.assert_allclose(energies(bodies, last), energies(bodies, STATES), rtol=2e-15)  # seen: 4e-16


@pytest.mark.long
def test_a_summary_is_read_back_with_its_system(tmp_path):
    path, run = stored(tmp_path, reduce="energy")
    again = li.open(path)
    np.testing.assert_array_equal(again.summary.greatest, run.summary.greatest)
    np.testing.assert_array_equal(again.system.inertia, [1, 2, 3])


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
    "name",
    ["os.system", "lieint_jax.nothing", "lieint_jax.command.cli.os.system", "lieint_jax.runs._storage.disk.shutil"],
)
def test_a_description_cannot_name_code_outside_the_package(name):
    with pytest.raises(ValueError, match="does not belong to this package"):
        make({"name": name}, {}, {})


@pytest.mark.parametrize("other", [{"energy": {"name": "lieint_jax.maps.cayley"}}, None])
def test_a_description_has_the_fields_of_its_class(other):
    """No other ones, which could be methods, and no fewer."""
    description, arrays = describe(li.schemes.so3_midpoint(BODY))
    system = description["system"]
    system["fields"] = system["fields"] | other if other else {}
    with pytest.raises(ValueError, match=f"RigidBody has other fields .*: {'energy' if other else 'inertia'}"):
        make(system, arrays, {})


def test_a_damaged_constant_array_raises_an_error(tmp_path):
    path, _ = stored(tmp_path)
    [chunk] = (path / "step" / "system_inertia" / "c").rglob("0")
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(ValueError, match=r"step/system_inertia/c/0 is altered"):
        li.open(path)


@pytest.mark.long
def test_any_run_of_a_known_system_is_drawn_and_drawn_again(tmp_path, lieint):
    path, _ = stored(tmp_path)
    (tmp_path / "pictures").mkdir()
    assert "3 of 3 members converged at every step" in lieint("plot", str(path), "--out", str(tmp_path / "pictures"))
    picture = tmp_path / "pictures" / "run-errors.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "pictures" / "run-motion.png").exists()
    picture.write_text("precious")
    assert "run-errors.png exists and is not overwritten; --force" in lieint.refuse(
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
    li.run(li.schemes.additive(body), states, dt, 20, save_every=2, store=tmp_path / "ball.zarr", progress=False)
    assert cli.main(["plot", str(tmp_path / "ball.zarr")]) == 0
    assert (tmp_path / "ball-motion.png").exists()
