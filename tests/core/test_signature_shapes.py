"""The shapes in signatures are those of the arrays: every call of a function of the library is checked at run time."""

import functools

import jax
import jax.numpy as jnp
import jaxtyping
import pytest
import shape_checks
from grid import steps, systems
from test_structure import FIRST

import lieint_jax as li
from lieint_jax import groups
from lieint_jax.groups import so3

KINDS = {type(system): (system, state) for _, (system, state, _) in reversed(systems())}
SPACES = {type(system.phase_space): (system, state) for system, state in KINDS.values()}


def test_signatures_have_two_hundred_shapes_and_more():
    public = [f for _, name, f in shape_checks.shaped_functions() if not name.startswith("_") or name == "__call__"]
    assert sum(len(shape_checks.hints(f)) for f in public) >= 300


def test_a_wrong_shape_raises_a_type_error():
    with pytest.raises(jaxtyping.TypeCheckError):
        shape_checks.checked(so3.exp)(jnp.zeros(4))
    with pytest.raises(jaxtyping.TypeCheckError):  # the sizes of both are d
        shape_checks.checked(groups.MatrixGroup.ad)(groups.special_euclidean(2), jnp.zeros(3), jnp.zeros(4))


@pytest.mark.long
@pytest.mark.parametrize("group", [so3, groups.special_euclidean(3)], ids=["SO(3)", "SE(3)"])
def test_the_functions_of_a_group_return_the_shapes_that_they_declare(group):
    """Each is traced with arguments of the shapes that it declares."""
    holder, own = (so3, ()) if group is so3 else (groups.MatrixGroup, (group,))
    sizes = {"d": group.dim, "n": len(group.identity), "3": 3, "4": 4}
    count = 0
    for where, _, function in shape_checks.shaped_functions():
        if where is not holder or function.__name__.startswith("_"):
            continue
        declared = {name: hint for name, hint in shape_checks.hints(function).items() if name != "return"}
        shapes = [[sizes[x] for x in first(hint).dim_str.split()] for hint in declared.values()]
        arguments = [jax.ShapeDtypeStruct(tuple(shape), jnp.float32) for shape in shapes]
        missing = function.__code__.co_argcount - len(own) - len(arguments) - len(function.__defaults__ or ())
        if missing <= 0:
            jax.eval_shape(functools.partial(shape_checks.checked(function), *own), *arguments)
            count += 1
    assert count >= 15


def first(hint):
    """The first type of a union of them."""
    return hint if hasattr(hint, "dim_str") else hint.__args__[0]


@pytest.mark.long
def test_systems_and_phase_spaces_have_the_shapes_that_they_declare(monkeypatch):
    called = shape_checks.check_all(monkeypatch)
    for system, state in KINDS.values():
        for method in ("energy", "momentum", "vector_field", "angular_velocity", "body_momentum", "rotation_matrix"):
            if hasattr(system, method):
                jax.eval_shape(getattr(type(system), method), system, state)
    for system, state in SPACES.values():
        jax.eval_shape(_geometry, system, state)
    for room in ("systems", "phase_spaces"):
        assert len([name for name in called if name.startswith(f"lieint_jax.{room}")]) >= 25, called


def _geometry(system, state):
    """All that a phase space can do."""
    space = system.phase_space
    moved = space.perturb(state, jnp.full(space.dim, 0.01, state.p.dtype))
    tangent = space.trivialize(state, system.vector_field(state))
    there = space.displaced(state, space.displacement(state, moved))
    form = space.omega(state) if system.hamiltonian else ()  # kinematics have none
    return tangent, there, form, space.defect(state)


@pytest.mark.long
@pytest.mark.parametrize("part", range(2))
def test_steps_call_nothing_with_another_shape(monkeypatch, part):
    """One step of every class of steps, traced: the arrays have shapes, and no value is computed."""
    called = shape_checks.check_all(monkeypatch)
    chosen = [(step, state, dt) for name, step, state, dt in steps() if name in FIRST.values()]
    for step, state, dt in chosen[part::2]:
        jax.eval_shape(type(step).__call__, step, state, dt)
    assert len(called) >= 40


@pytest.mark.long
def test_diagnostics_have_the_shapes_that_they_declare(monkeypatch):
    called = shape_checks.check_all(monkeypatch)
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    step, state = li.schemes.so3_explicit(body), body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.1, 1.0])

    def measured(state):
        form = li.diagnostics.symplectic_defect(step, state, 0.1), li.diagnostics.reversibility(step, state, 0.1)
        poisson = li.diagnostics.linearization(step, state, 0.1), li.diagnostics.poisson_error(step, state, 0.1, 3)
        return form, poisson, li.diagnostics.lyapunov(step, state, 0.1, 4, every=2)

    jax.eval_shape(measured, state)
    assert len([name for name in called if name.startswith("lieint_jax.diagnostics")]) >= 7, called
