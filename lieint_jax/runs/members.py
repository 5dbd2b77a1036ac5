"""The member axis: whether a batch has one system per member, and functions evaluated along the runs of a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import remembered
from lieint_jax.core import Trajectory

Axis = int | Literal["auto"] | None


def axes(run: Trajectory) -> tuple[str, ...]:
    """The names of the leading axes of a trajectory's states: time, and member for a batch."""
    if np.ndim(run.t) != 1:
        raise ValueError(
            f"t must have shape (n+1,), got {np.shape(run.t)}: a vmapped `integrate` gives the axes (member, time). "
            "Use li.run, or jax.vmap(…, out_axes=lieint_jax.Trajectory(None, 1, 1)), for (time, member); or "
            "apply jax.vmap to the function that you call here"
        )
    return ("time", "member")[: 1 if run.info is None else np.ndim(run.info.residual)]


def map_over_run(
    function: Callable[[PyTree, PyTree], Array], system: PyTree, run: Trajectory, system_axis: Axis = "auto"
) -> Array:
    """The values of function(system, state) along a run: (times, …), or (times, members, …) for a batch.

    Args:
        function: of one system and one state.
        system: that of the run; with the member axis on its leaves if each member has its own.
        run: a trajectory of one body or of a batch.
        system_axis: see `member_axis`; of one body, None or "auto".
    """
    states = jax.tree.map(jnp.asarray, run.state)
    if len(axes(run)) == 1:
        _check_single(system, states, system_axis)
        return jax.vmap(lambda z: function(system, z))(states)
    one, members = _member_shapes(states, 2), np.shape(run.info.residual)[1]
    axis = member_axis(system, one, members, system_axis)

    def of_all(states: PyTree) -> Array:
        return jax.vmap(jax.vmap(lambda z: function(system, z)))(states)

    def of_each(states: PyTree) -> Array:
        return jax.vmap(jax.vmap(function), (None, 0))(system, states)

    if axis == "values":
        return lax.cond(_has_tensors(system), of_all, of_each, states)
    return of_all(states) if axis is None else of_each(states)


def member_axis(
    system: PyTree, one: PyTree, members: int, given: Axis, name: str = "system_axis"
) -> Literal["values"] | int | None:
    """0 if there is one system per member, on the leading axis of all leaves of `system`; None if all share one.

    With "auto" a system of all members is one whose arrays have the shapes of one system, any other has a member axis.
    Where they have the shapes of both, the result is "values": for three members, an inertia (3, 3) is one tensor if it
    is symmetric and positive definite (see `_has_tensors`), or else the principal moments of each.

    Args:
        system: the system of all members, or the stacked systems of each.
        one: the state of one member, or its shapes.
        members: the number of members.
        given: 0, None, or "auto" to infer the result from the shapes.
        name: the name of the argument, for messages.

    Raises:
        ValueError: the shapes contradict `given`.
    """
    if isinstance(given, bool) or given not in (0, None, "auto"):
        raise ValueError(f'{name} must be None (one system for all), 0 (one per member) or "auto", got {given!r}')
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(system)]
    if not shapes:
        return None
    led = all(shape[:1] == (members,) for shape in shapes)
    told = f"{members} members, and leaves of shapes {', '.join(map(str, dict.fromkeys(shapes)))}"
    if given == 0 and not led:
        raise ValueError(
            f"{name}=0 needs a system for each member, made by jax.vmap, so that every leaf has a leading member axis; "
            f"got {told}. Give {name}=None where all members have one system"
        )
    if given == 0:
        return 0
    if not led:
        return None
    shared, own = _fits(system, one), _fits(jax.tree.map(lambda x: x[0], system), one)
    if given is None and own and not shared:
        words = "own_step=True" if name == "own_step" else f"{name}=0"
        raise ValueError(f"there is one system per member ({told}): give {words}")
    if given == "auto" and own and shared:
        return "values"
    return 0 if own and not shared else None


def _has_tensors(system: PyTree) -> Array:
    """Whether all square leaves of a system are tensors, symmetric and positive definite."""
    leaves = map(jnp.asarray, jax.tree.leaves(system))
    square = [x for x in leaves if x.ndim == 2 and x.shape[0] == x.shape[1]]
    symmetric = [jnp.allclose(x, x.T, rtol=1e-6, atol=1e-6 * jnp.abs(x).max()) for x in square]
    positive = [jnp.isfinite(jnp.linalg.cholesky(x)).all() for x in square]
    return jnp.asarray([*symmetric, *positive], bool).all()


def _check_single(system: PyTree, states: PyTree, given: Axis) -> None:
    """ValueError if the system of a run of one body has a member axis."""
    if given not in (None, "auto"):
        raise ValueError(f"system_axis is of batches; this run is of one body, got system_axis={given!r}")
    firsts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(system)}
    if len(firsts) != 1 or firsts == {()}:
        return
    one = _member_shapes(states, 1)
    if not _fits(system, one) and _fits(jax.tree.map(lambda x: x[0], system), one):
        [(members,)] = firsts
        raise ValueError(
            f"the run is of one body, but the system has a member axis of {members}: pass the system of its member k, "
            "jax.tree.map(lambda x: x[k], system)"
        )


def _member_shapes(states: PyTree, leading: int) -> PyTree:
    """The shapes of one state."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[leading:], x.dtype), states)


def _fits(system: PyTree, one: PyTree) -> bool:
    """Whether a system has the shapes of a single one: it accepts this state, and its energy is a scalar."""
    leaves, structure = jax.tree.flatten((system, one))
    return _is_single(structure, tuple((np.shape(x), jnp.result_type(x)) for x in leaves))


@remembered(64)
def _is_single(structure: PyTree, shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]) -> bool:
    """`_fits` of a system and a state of these shapes and types."""

    def checked_energy(system: PyTree, state: PyTree) -> Array:
        system.check(state)
        return system.energy(state)

    try:
        system, one = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*x) for x in shapes])
        return jax.eval_shape(checked_energy, system, one).shape == ()
    except (TypeError, ValueError, IndexError):
        return False
