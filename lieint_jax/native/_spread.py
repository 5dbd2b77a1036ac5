"""Calls of machine code whose members are spread over devices: each device computes its own."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

from jax.experimental.custom_partitioning import ArrayMapping, SdyShardingRule, custom_partitioning
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lieint_jax.native._march import AnyArrays, Arrays

try:
    from jax._src.dispatch import prim_requires_devices_during_lowering as _of_devices  # no public name
except ImportError:  # then members are gathered
    _of_devices = set()
Places = Sequence[int | None]  # of the axis of members in each array, if it has one


def let_spread(primitive: Any) -> None:
    """Let JAX lower a primitive for the devices of a mesh, which its rule sees in the context."""
    _of_devices.add(primitive)


def spread(
    call: Callable[[AnyArrays, int], Arrays], members: int, arrays: AnyArrays, places: Places, of_results: Places
) -> Arrays:
    """call(arrays, members), in which each device has the part of the members that XLA gives it."""

    def partition(mesh: Mesh, given: AnyArrays, found: AnyArrays) -> tuple[Any, ...]:
        axes = _axes_of_members(mesh, [*found, *given], [*of_results, *places])
        part = -(-members // math.prod(mesh.shape[x] for x in axes))
        own, of_arrays = ([NamedSharding(mesh, _spec(axes, place)) for place in of] for of in (of_results, places))
        return mesh, lambda *arrays: call(arrays, part), own, tuple(of_arrays)

    function = custom_partitioning(lambda *arrays: call(arrays, members))
    function.def_partition(
        partition,
        decode_shardings=False,
        sharding_rule=lambda mesh, given, found: _rule([*given, *found], [*places, *of_results], len(given)),
    )
    return list(function(*arrays))


def _rule(types: AnyArrays, places: Places, inputs: int) -> SdyShardingRule:
    """Only the axis of members may be spread, and is in all arrays alike."""
    names = map("x{}".format, itertools.count())
    dims = [
        ["members" if k == place else next(names) for k in range(x.rank)]
        for x, place in zip(types, places, strict=True)
    ]
    whole = tuple(x for each in dims for x in each if x != "members")
    maps = [ArrayMapping(*x) for x in dims]
    return SdyShardingRule(tuple(maps[:inputs]), tuple(maps[inputs:]), need_replication_factors=whole)


def _spec(axes: tuple[str, ...], place: int | None) -> PartitionSpec:
    return PartitionSpec() if place is None else PartitionSpec(*[None] * place, axes)


def _axes_of_members(mesh: Mesh, arrays: AnyArrays, places: Places) -> tuple[str, ...]:
    """The axes of the mesh over which one of these arrays spreads its members; none if they are parts of axes."""
    names = mesh.axis_names
    choices = [x for k in range(len(names)) for x in itertools.permutations(names, k + 1)]
    for x, place in zip(arrays, places, strict=True):
        for axes in choices if place is not None else ():
            if NamedSharding(mesh, _spec(axes, place)).is_equivalent_to(x.sharding, len(x.shape)):
                return axes
    return ()
