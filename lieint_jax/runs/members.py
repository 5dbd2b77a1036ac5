"""The member axis of a batch: the axes of its arrays, and whether each member has a system of its own."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import remembered
from lieint_jax.core import Trajectory


def axes(run: Trajectory) -> tuple[str, ...]:
    """The names of the leading axes of a trajectory's states: time, and member for a batch."""
    if np.ndim(run.t) != 1:
        raise ValueError(
            f"t must have shape (n+1,), got {np.shape(run.t)}: a vmapped `integrate` gives the axes (member, time). "
            "Use li.run, or jax.vmap(…, out_axes=lieint_jax.Trajectory(None, 1, 1)), for (time, member); or "
            "apply jax.vmap to the function that you call here"
        )
    return ("time", "member")[: 1 if run.info is None else np.ndim(run.info.residual)]


def check_own_step(system: PyTree, state: PyTree, members: int | None, own_step: bool) -> None:
    """Raise ValueError unless a system has a leading member axis on all leaves if, and only if, `own_step`.

    Args:
        system: the system of all members, or the stacked systems of each.
        state: the state of one member, or its shapes.
        members: the number of members; None for a run of one body.
        own_step: whether each member has a system of its own.
    """
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(system)]
    expected = next(iter(shapes), ())[:1] if members is None else (members,)
    led = expected != () and all(shape[:1] == expected for shape in shapes)
    whose = "one body" if members is None else f"{members} members"
    told = f"{whose}, and leaves of shapes {', '.join(map(str, dict.fromkeys(shapes)))}"
    if own_step and not led:
        raise ValueError(
            "own_step=True needs a system for each member, made by jax.vmap, so that every leaf has a leading member "
            f"axis; got {told}. Give own_step=False where all members have one system"
        )
    if own_step or not shapes or not led or _fits(system, state):
        return
    if _fits(jax.tree.map(lambda x: x[0], system), state):
        raise ValueError(f"there is one system per member ({told}): give own_step=True")


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
