"""Many members at once: a function vmapped over them, their batch split over devices and processes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lieint_jax.ensemble import processes
from lieint_jax.ensemble._layout import AXIS, checked_mesh, count_processes


def over_members(function: Callable[..., Any], in_axes: Any = 0, mesh: Mesh | None = None) -> Callable[..., Any]:
    """`function` of one member as a jitted function of many, split over the devices.

    `function` may be a gradient, a fit or a whole study: `over_members(jax.grad(loss))(params, states)`. The result may
    be jitted and differentiated again. With `jax.distributed`, every process calls it with the same arguments and gets
    the same results. One program serves all devices, so the last bits may depend on the number of devices; those of
    `ensemble.run` do not.

    LAPACK calls (`svd`, `qr`, `solve`, …) inside `function` need `jax.custom_batching.sequential_vmap`: where each core
    of a CPU is a device, XLA runs a batch of them on the threads that already wait for it, and hangs.

    Args:
        function: a function of one member, of arrays or trees of arrays.
        in_axes: 0 for an argument with a member axis, None for one that all members share; one value for all arguments,
            or a tuple. For parts of an argument, a tree of 0 and None as in `jax.vmap`: State(0, 0, None, 0) for states
            that share their time.
        mesh: devices, as in `ensemble.run`; None takes all. If their number does not divide the number of members, the
            batch is padded with copies of the last member.

    Returns:
        The function of members; its results carry a leading member axis.

    Raises:
        ValueError: no argument with a member axis, different numbers of members, or a mesh with other axes.
        processes.LostProcess: another process of this run is gone.
    """
    mesh = checked_mesh(mesh)
    split, whole = PartitionSpec(AXIS), PartitionSpec()
    several = count_processes(mesh) > 1

    def many(*arguments: Any) -> Any:
        given = in_axes if type(in_axes) is tuple else (in_axes,) * len(arguments)
        axes = _leaf_axes(given, arguments)
        members = _count(axes, arguments)
        missing = -members % mesh.size

        def filled(leaf: Any) -> Any:
            return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)]) if missing else jnp.asarray(leaf)

        def cut(leaf: Any) -> Any:
            return (
                lax.with_sharding_constraint(leaf[:members], NamedSharding(mesh, whole)) if several else leaf[:members]
            )

        leaves, structure = jax.tree.flatten(arguments)
        full = structure.unflatten(x if axis is None else filled(x) for axis, x in zip(axes, leaves, strict=True))
        specs = structure.unflatten(whole if axis is None else split for axis in axes)
        mapped = jax.vmap(function, structure.unflatten(axes))
        shared = jax.shard_map(mapped, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)
        return jax.tree.map(cut, shared(*full))

    compiled = jax.jit(many)
    if not several:
        return compiled

    def on_all(*arguments: Any) -> Any:
        with processes.name_lost(mesh):
            return jax.block_until_ready(compiled(*jax.tree.map(np.asarray, arguments)))

    return on_all


def _leaf_axes(axes: tuple[Any, ...], arguments: tuple[Any, ...]) -> list[Any]:
    """The axis, 0 or None, of each leaf of the arguments."""

    def is_none(x: Any) -> bool:
        return x is None

    values = jax.tree.leaves(axes, is_leaf=is_none)
    if len(axes) != len(arguments) or any(axis not in (0, None) for axis in values) or 0 not in values:
        raise ValueError(f"in_axes must be 0 or None for each of {len(arguments)} arguments, not all None: {axes}")
    found: list[Any] = []
    for axis, x in zip(axes, arguments, strict=True):
        jax.tree.map(lambda a, part: found.extend([a] * len(jax.tree.leaves(part))), axis, x, is_leaf=is_none)
    return found


def _count(axes: list[Any], arguments: tuple[Any, ...]) -> int:
    """The number of members of the arguments."""
    batched = [leaf for axis, leaf in zip(axes, jax.tree.leaves(arguments), strict=True) if axis == 0]
    counts = {np.shape(leaf)[0] if np.ndim(leaf) else 0 for leaf in batched}
    if len(counts) != 1 or not min(counts):
        raise ValueError(f"arguments must carry one number of members, got {sorted(counts)}")
    [members] = counts
    return members
