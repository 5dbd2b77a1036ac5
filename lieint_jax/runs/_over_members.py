"""A function of one member, vmapped over many, with the batch split over devices."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jax.typing import ArrayLike

from lieint_jax._xla import rereading_jit
from lieint_jax.runs._devices import AXIS, Tree, checked_mesh
from lieint_jax.runs._loop import Axes, axes_of_leaves


def over_members(function: Callable[..., Tree], in_axes: Axes = 0, mesh: Mesh | None = None) -> Callable[..., Tree]:
    """Apply any function of one member to many on all devices: a gradient, a fit or a whole study.

    For example `over_members(jax.grad(loss))(params, states)`. The result may be jitted and differentiated again.
    All devices run one program, so the last bits may depend on the number of devices; those of machine code in `run` do
    not.

    It is compiled once, and again if `function` reads other numbers from outside than before.

    LAPACK calls (`svd`, `qr`, `solve`, …) inside `function` need `jax.custom_batching.sequential_vmap`: where each core
    of a CPU is a device, XLA runs a batch of them on the threads that already wait for it, and hangs.

    Args:
        function: a function of one member, of arrays or trees of arrays.
        in_axes: 0 for an argument with a member axis, None for one that all members share; one value for all arguments,
            or a tuple. For parts of an argument, a tree of 0 and None as in `jax.vmap`: State(0, 0, None, 0) for states
            that share their time.
        mesh: devices, as in `li.run`; None means all. If their number does not divide the number of members, the
            batch is padded with copies of the last member.

    Returns:
        The compiled function of many members; its results carry a leading member axis.

    Raises:
        ValueError: no argument with a member axis, different numbers of members, or a mesh with other axes.
    """
    mesh = checked_mesh(mesh)
    split, whole = PartitionSpec(AXIS), PartitionSpec()

    def map_members(*arguments: Tree) -> Tree:
        given = in_axes if type(in_axes) is tuple else (in_axes,) * len(arguments)
        axes = _leaf_axes(given, arguments)
        members = _count(axes, arguments)
        missing = -members % mesh.size

        def pad(leaf: ArrayLike) -> Array:
            leaf = jnp.asarray(leaf)
            return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)]) if missing else leaf

        leaves, structure = jax.tree.flatten(arguments)
        full = structure.unflatten(x if axis is None else pad(x) for axis, x in zip(axes, leaves, strict=True))
        specs = structure.unflatten(whole if axis is None else split for axis in axes)
        mapped = jax.vmap(function, structure.unflatten(axes))
        shared = jax.shard_map(mapped, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)
        return jax.tree.map(lambda leaf: leaf[:members], shared(*full))

    return rereading_jit(map_members)


def _leaf_axes(axes: tuple[Axes, ...], arguments: tuple[Tree, ...]) -> list[int | None]:
    """The axis, 0 or None, of each leaf of the arguments."""
    values = jax.tree.leaves(axes, is_leaf=lambda x: x is None)
    if len(axes) != len(arguments) or any(axis not in (0, None) for axis in values) or 0 not in values:
        raise ValueError(f"in_axes must be 0 or None for each of {len(arguments)} arguments, not all None: {axes}")
    return axes_of_leaves(axes, arguments)


def _count(axes: list[int | None], arguments: tuple[Tree, ...]) -> int:
    """The number of members of the arguments."""
    batched = [leaf for axis, leaf in zip(axes, jax.tree.leaves(arguments), strict=True) if axis == 0]
    counts = {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in batched}
    if len(counts) != 1 or not min(counts):
        raise ValueError(f"arguments must have the same number of members, got {sorted(counts)}")
    [members] = counts
    return members
