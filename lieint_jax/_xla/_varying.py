"""Arrays that differ between the devices of a `jax.shard_map`, which by its default check have types of their own."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.core import ShapedArray
from jax.sharding import AxisType, NamedSharding, PartitionSpec, reshard

from lieint_jax._xla._compile import Tree

try:
    from jax._src.config import _check_vma as _checked  # no public name
except ImportError:  # no such types, or others: JAX says what it cannot trace
    _checked = None
Value = Any  # an array, a tracer or an abstract value


def differ(tree: Tree) -> bool:
    """Whether some of these arrays may differ between devices, and their types say so."""
    return _checked is not None and _checked.value and any(map(_axes_of, jax.tree.leaves(tree)))


def with_common_axes(arguments: Tree) -> Tree:
    """The same arrays, all of which may differ where one does."""
    axes = frozenset().union(*map(_axes_of, jax.tree.leaves(arguments)))

    def like_others(x: Value) -> Value:
        return lax.pcast(x, tuple(axes - _axes_of(x)), to="varying") if axes - _axes_of(x) else x

    return jax.tree.map(like_others, arguments) if axes else arguments


def with_common_mesh(arguments: Tree) -> Tree:
    """The same arrays, all of the mesh of explicit axes that the type of one names, if one does.

    JAX cannot join a constant, whose type names no mesh, to an array of which vmap spreads the members over one.
    """
    meshes = (_type(x).sharding.mesh for x in jax.tree.leaves(arguments))
    mesh: Any = next((x for x in meshes if AxisType.Explicit in x.axis_types), None)

    def on_mesh(x: Value) -> Value:
        whole: Any = NamedSharding(mesh, PartitionSpec(*[None] * x.ndim))
        return reshard(x, whole) if _type(x).sharding.mesh.empty else x

    return arguments if mesh is None else jax.tree.map(on_mesh, arguments)


def result_like(
    given: Sequence[Value], shape: Sequence[int], dtype: Any, place: int | None = None, spread: Any = None
) -> ShapedArray:
    """The type of a result, given all arguments, which are of `with_common_axes`.

    Over a mesh the type says how its axis `place` is spread: as `axis_spread` of an argument.
    """
    like = next((x for x in map(_type, given) if not x.sharding.mesh.empty), None)
    if like is None:
        return ShapedArray(tuple(shape), dtype)
    spec = PartitionSpec(*(spread if k == place else None for k in range(len(shape))))
    return like.update(shape=tuple(shape), dtype=dtype, weak_type=False, sharding=like.sharding.update(spec=spec))


def axis_spread(x: Value, place: int) -> Any:
    """The axes of a mesh over which an axis of an array is spread, where its type says so (explicit axes); or None."""
    return _type(x).sharding.spec[place]


def unchecked() -> contextlib.AbstractContextManager[Any]:
    """Traces functions without these types; then their loops need not say of each array that it may differ."""
    return contextlib.nullcontext() if _checked is None else _checked(False)


def _axes_of(x: Value) -> frozenset[str]:
    kind = _type(x)
    return kind.manual_axis_type.varying if isinstance(kind, ShapedArray) else frozenset()


def _type(x: Value) -> Any:
    return x if isinstance(x, ShapedArray) else jax.typeof(x)
