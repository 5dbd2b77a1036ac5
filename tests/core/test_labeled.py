"""Trajectories in other packages' forms, and states that print in a line."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cubes import CUBE, FACES

import lieint_jax as li
from lieint_jax.core import State, StepInfo, Trajectory
from lieint_jax.runs import labeled

pytestmark = pytest.mark.long

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
T = np.linspace(0, 3, 5)
RATES = np.array([[0.2, 0.0, 1.0], [0.1, 1.0, 0.3]])


def run(*members):
    """The closed form of the motion, without a step: entries, and members if asked."""
    state = jax.vmap(lambda w: BODY.state([0.5, 0.5, 0.5, 0.5], angular_velocity=w))(jnp.asarray(RATES))
    path = jax.vmap(jax.vmap(BODY.solution, (0, None)), (None, 0))(state, jnp.asarray(T))
    shape = path.p.shape[:2]
    both = Trajectory(jnp.asarray(T), path, StepInfo(jnp.zeros(shape), jnp.ones(shape, bool)))
    one = both._replace(**jax.tree.map(lambda x: x[:, 0], both._asdict() | {"t": T[:, None]}))
    return li.Run.of(li.schemes.so3_midpoint(BODY), both if members else one)


def test_a_run_becomes_a_dataset_with_coordinates():
    found = run().to_xarray(units={"time": "d", "energy": "J"})
    assert found.q.dims == ("time", "quaternion")
    np.testing.assert_array_equal(found.q.sel(quaternion="w"), run().state.q[:, 0])
    assert (found.time.attrs["units"], found.energy.attrs["units"]) == ("d", "J")
    np.testing.assert_allclose(found.energy, 0.5 * (RATES[0] ** 2) @ [1, 2, 3], rtol=1e-14)
    np.testing.assert_allclose(found.angular_velocity[0], RATES[0], rtol=0, atol=3e-15)
    np.testing.assert_allclose(found.momentum_map, found.p, rtol=0)
    assert found.converged.all()
    with pytest.raises(ValueError, match=r"units of spin are given, but the variables are .*q"):
        run().to_xarray(units={"spin": "rad"})
    with pytest.raises(ValueError, match=r"units of t are given.*; did you mean time\?"):
        run().to_xarray(units={"t": "s"})


def test_a_batch_as_a_dataset_has_members():
    found = run("members").to_xarray()
    assert dict(found.sizes) == {"time": 5, "member": 2, "quaternion": 4, "axis": 3, "momentum_map_component": 3}
    assert found.energy.dims == found.residual.dims == ("time", "member")


def test_several_bodies_and_matrices_have_axes_of_their_own():
    flags = StepInfo(jnp.zeros(5), jnp.ones(5, bool))
    pair = li.systems.rigid_bodies(np.ones(2), np.ones((2, 3)), li.potentials.point_masses(1.0, np.ones(2)))
    poses = jnp.tile(jnp.array([[0.0, 0, 0, 1, 0, 0, 0], [2.0, 0, 0, 1, 0, 0, 0]]), (5, 1, 1))
    states = State(poses, jnp.zeros((5, 2, 6)), jnp.asarray(T))
    two = li.Run.of(li.schemes.splitting(pair), Trajectory(T, states, flags)).to_xarray()
    assert (two.q.dims, two.p.dims) == (("time", "body", "pose"), ("time", "body", "momenta"))
    assert two.t.dims == ("time",)
    ball = li.systems.pseudo_rigid_body(np.ones(3), li.systems.mooney_rivlin(1.0, 1.0))
    carried = State(jnp.tile(jnp.eye(3), (5, 1, 1)), jnp.zeros((5, 3, 3)), extra={"rotor": jnp.zeros((5, 3))})
    elastic = li.Run.of(li.schemes.splitting(ball), Trajectory(T, carried, flags)).to_xarray()
    assert elastic.q.dims == ("time", "row", "column")
    assert elastic.extra_rotor.dims == ("time", "extra_rotor_component")


@pytest.mark.parametrize("name", ["special_unitary(3)", "special_linear(2)", "special_orthogonal(3)"])
def test_states_on_matrix_groups_have_rows_and_columns_and_momenta_no_axes_but_for_rotations(name):
    """Those of SU(3), 6 by 6, were labeled as bodies, and momenta on SL(2) with x, y and z."""
    group = getattr(li.groups, name[:-3])(int(name[-2]))
    states = State(jnp.tile(jnp.eye(group.size), (5, 1, 1)), jnp.ones((5, group.dim)))
    step = li.schemes.group_midpoint(li.systems.euler(group, np.eye(group.dim)))
    found = li.Run.of(step, Trajectory(T, states, StepInfo(jnp.zeros(5), jnp.ones(5, bool)))).to_xarray()
    assert found.q.dims == ("time", "row", "column")
    assert found.p.dims == ("time", "axis" if name == "special_orthogonal(3)" else "p_component")
    assert set(found.coords) == {"time"} | ({"axis"} if name == "special_orthogonal(3)" else set())


def test_attitudes_become_rotations_and_euler_angles():
    path = run()
    turns = path.rotations()
    np.testing.assert_allclose(turns.as_matrix(), jax.vmap(BODY.rotation_matrix)(path.state), rtol=0, atol=1e-15)
    angles = np.deg2rad(turns.as_euler("ZXZ", degrees=True))
    ours = jax.vmap(li.groups.so3.to_euler_313)(path.state.q)
    np.testing.assert_allclose(np.cos(angles - ours), 1, rtol=0, atol=1e-13)
    flags = StepInfo(jnp.zeros(5), jnp.ones(5, bool))
    two = Trajectory(T, State(jnp.ones((5, 2, 7)), jnp.zeros((5, 2, 6))), flags)
    assert labeled.rotations(two).as_matrix().shape == (5, 2, 3, 3)
    for shape, words in (((5, 3, 3), "need not be rotations"), ((5, 3), "attitudes are quaternions")):
        with pytest.raises(ValueError, match=words):
            labeled.rotations(Trajectory(T, State(jnp.ones(shape), jnp.zeros((5, 3))), flags))


def test_states_print_in_a_line(capsys):
    state = State(np.array([1.0, 0, 0, 0]), np.array([0.2, 0, 3]), extra={"rho": np.float64(0.5)})
    assert str(state) == "State(q=[1., 0., 0., 0.], p=[0.2, 0. , 3. ], extra={rho: 0.5})"
    assert str(State(0, None)) == "State(q=0)"
    jax.jit(lambda z: print(z))(state._replace(extra=None))
    assert capsys.readouterr().out == "State(q=float64[4], p=float64[3])\n"
    assert repr(StepInfo(np.float64(0), np.bool_(False))) == "StepInfo(residual=0., converged=False)"
    assert str(run("members").trajectory) == (
        "Trajectory(5 entries of 2 members, t = 0 … 3, all converged, State(q=float64[5, 2, 4], p=float64[5, 2, 3]))"
    )
    assert "1 not converged" in str(run().trajectory._replace(info=StepInfo(np.zeros(5), np.arange(5) > 0)))


def test_laws_systems_and_steps_print_in_a_short_line():
    """Of IGRF to degree 13, 680 coefficients; of a mesh, and of many bodies; and in errors."""
    field = li.orbits.earth_field(li.orbits.kepler(398600.4, 7000.0, 0.01), "2025-01-01", degree=13)
    law = li.torques.dipole([0.01, 0.0, 0.02], field)
    body = li.systems.torqued_body([1.0, 2.0, 2.5], law + li.torques.viscous(1e-3))
    many = li.systems.rigid_bodies(np.ones(40), np.ones((40, 3)), li.potentials.point_masses(1.0, np.ones(40)))
    mesh = li.potentials.polyhedron(1.0, (np.asarray(CUBE, float), FACES), 1.0)
    facets = li.shapes.ellipsoid_facets([1.0, 2.0, 3.0], 6)
    for x in (field, law, body, li.schemes.torqued_midpoint(body), many, li.schemes.splitting(many), mesh, facets):
        text = repr(x)
        assert text.startswith(f"{type(x).__name__}(")
        assert len(text) < 700
        assert "\n" not in text
    assert "eccentricity=0.01" in repr(law)
    assert "masses=float64[40]" in repr(many)
    assert "groups=tuple of 1" not in repr(many)
    jax.jit(lambda law: repr(law) and 1.0)(law)  # inside of jit, too
    state = body.state(angular_velocity=[0.0, 0.0, 1.0])
    with pytest.raises(ValueError) as error:
        li.measure.distances(li.run(li.schemes.torqued_midpoint(body), state, 0.1, 0, progress=False))
    assert "table" in str(error.value) or "float64[" in str(error.value)
    assert len(str(error.value)) < 800


def test_a_missing_package_is_named_in_a_sentence(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match="xarray is not installed: pip install xarray"):
        run().to_xarray()
