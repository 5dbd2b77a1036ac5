"""Members over devices: a batch is cut into blocks, padded, and placed.

The mesh axis "members" runs over devices and processes. The members of a device are divided into blocks, and the bits
of a result depend neither on the number of devices nor on the place of a member:

* The same program (`_loop`), compiled for one device, advances every block. (XLA would fuse one program for all
  devices, by `shard_map`, differently for each number of devices, and its results would round differently.)
* The size of a block is a multiple of 16, so that it fills whole vector registers. It is followed by 32 copies of a
  member, whose results are dropped: on a CPU the remainder of a vectorized loop runs as scalar code, which rounds
  differently.

On a CPU a block fits the cache. Machine code (`lieint_jax.native`) needs none of this: there the members of a process
are one block (`Place.whole`).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from math import lcm
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_T = TypeVar("_T")
Tree = Any  # a tree of arrays
Numbers = Array | np.ndarray
AXIS = "members"
LANES = 16  # members in a vector register: 16 float32 in 512 bits
_TAIL = 32  # padding after a block, for the remainder of vectorized loops
_BLOCK = 1024  # the most members in a block on a CPU: their states and temporaries fit the cache


class Place(NamedTuple):
    """The devices that compute a run.

    Attributes:
        mesh: the devices of all processes.
        whole: True if all members of a process are one block.
    """

    mesh: Mesh
    whole: bool


class Block(NamedTuple):
    """A block of members on a device of this process; `start` is its first member."""

    device: Any  # jax.Device | None
    start: int


class Layout(NamedTuple):
    """The placement of members on the devices of a mesh.

    Each device holds `blocks_per_device` blocks of `block_size` members, in order. Places beyond the last member are
    padding, copies of that member. A block that would contain only padding is left out. If `place.whole`, the members
    of a process are one block without padding.
    """

    place: Place
    members: int
    block_size: int
    blocks_per_device: int
    tail: int = 0

    @property
    def mesh(self) -> Mesh:
        """The devices of all processes."""
        return self.place.mesh

    @property
    def padded_block_size(self) -> int:
        """The number of members of a block and of the copies after it. A single member needs no copies."""
        return self.block_size + self.tail

    @property
    def per_device(self) -> int:
        """The number of members on a device, padding included."""
        return self.block_size * self.blocks_per_device

    @property
    def local_devices(self) -> list[int]:
        """The positions in the mesh of the devices of this process."""
        return [k for k, device in enumerate(self.mesh.devices.flat) if device.process_index == jax.process_index()]

    @property
    def local_members(self) -> range:
        """The members on the devices of this process, without padding."""
        devices = self.local_devices
        first, last = min(devices) * self.per_device, (max(devices) + 1) * self.per_device
        return range(min(first, self.members), min(last, self.members))

    @property
    def local_blocks(self) -> list[Block]:
        """The blocks of this process, in the order of their members; one block of padding if it has no members."""
        if self.place.whole:
            return [Block(None, min(self.local_members.start, self.members - 1))]
        devices, starts = self.mesh.devices.flat, range(0, self.per_device, self.block_size)
        found = [Block(devices[k], k * self.per_device + start) for k in self.local_devices for start in starts]
        return [block for block in found if block.start < self.members] or found[:1]


def checked_mesh(mesh: Mesh | None) -> Mesh:
    """`mesh`, checked: its one axis is "members", with equally many devices of each process. None means all devices."""
    if mesh is None:
        return first_devices(None)
    if not isinstance(mesh, Mesh) or tuple(mesh.axis_names) != (AXIS,):
        given = tuple(mesh.axis_names) if isinstance(mesh, Mesh) else type(mesh).__name__
        raise ValueError(f'mesh must be a jax.sharding.Mesh of one axis, "{AXIS}", got {given}')
    processes = [device.process_index for device in mesh.devices.flat]
    if processes != sorted(processes) or len({processes.count(p) for p in processes}) > 1:
        raise ValueError(f"mesh must list equally many devices of each process, process by process, got {processes}")
    if jax.process_index() not in processes:
        raise ValueError(f"mesh has no device of this process, {jax.process_index()}")
    return mesh


def count_cores() -> int:
    """The number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def want_devices(count: int | None) -> None:
    """Split the CPU into several JAX devices, so that `over_members` uses all cores.

    It has no effect on accelerators, after JAX has started, or where XLA_FLAGS sets the number.

    Args:
        count: the number of devices; None means one per core, which is fastest.
    """
    if count is None:
        count = count_cores()
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count)


def first_devices(count: int | None) -> Mesh:
    """A mesh for `run` and `over_members` of the first `count` devices of each process; None means all.

    Raises:
        ValueError: a process has fewer devices.
    """
    devices = np.array(jax.devices())
    if count is not None:
        available = jax.local_device_count()
        if count > available:
            raise ValueError(f"{count} devices were requested, and {available} are available")
        devices = devices.reshape(-1, available)[:, :count].ravel()
    return Mesh(devices, (AXIS,))


def layout_of(place: Place, members: int, chunk: int | None = None, alone: bool = True) -> Layout:
    """The layout of `members` members; with `chunk`, each process holds whole chunks of members.

    A single member is computed without padding, unless it is not `alone` but part of a run of more.
    """
    if members == 1 and alone:
        return Layout(place, 1, 1, 1)
    mesh = place.mesh
    processes = count_processes(mesh)
    on_cpu = mesh.devices.flat[0].platform == "cpu" and not place.whole
    unit, tail = (1, 0) if place.whole else (LANES, _TAIL)
    if chunk is None or processes == 1:
        each = -(-members // mesh.size)
        blocks = -(-each // _BLOCK) if on_cpu else 1
        return Layout(place, members, unit * -(-each // (unit * blocks)), blocks, tail)
    devices = mesh.size // processes
    row = lcm(chunk, unit * devices)
    each = row * -(-members // (processes * row)) // devices
    block = max(b for b in range(unit, _BLOCK + 1, unit) if each % b == 0) if on_cpu else each
    return Layout(place, members, block, each // block, tail)


def chunk_of(layout: Layout, most: int) -> int:
    """The number of members in a chunk of a store: at most `most`, but at least one block of each local device."""
    if layout.place.whole:
        return min(layout.per_device * len(layout.local_devices), most)
    row = len(layout.local_devices) * layout.block_size
    return row * min(layout.blocks_per_device, max(1, most // row))


def scatter(layout: Layout, tree: _T, first: int = 0) -> list[_T]:
    """Split host arrays that begin at member `first` into this process' blocks, pad them, and copy them to devices."""
    tree = jax.tree.map(np.asarray, tree)
    if layout.place.whole:
        [start] = [block.start - first for block in layout.local_blocks]
        end = start + max(len(layout.local_members), 1)
        return [jax.tree.map(lambda x: x[start:end], tree)]

    def put_block(block: Block) -> _T:
        rows = np.arange(block.start, block.start + layout.padded_block_size) - first
        return jax.device_put(jax.tree.map(lambda x: x[np.clip(rows, 0, len(x) - 1)], tree), block.device)

    return [put_block(block) for block in layout.local_blocks]


def replicate(layout: Layout, tree: _T) -> list[_T]:
    """A copy of `tree` for each block of this process, on the block's device."""
    if layout.place.whole:
        return [jax.tree.map(np.asarray, tree)]
    copies = {block.device: jax.device_put(tree, block.device) for block in layout.local_blocks}
    return [copies[block.device] for block in layout.local_blocks]


def map_blocks(layout: Layout, function: Callable[..., _T], *arguments: Sequence[object]) -> list[_T]:
    """Apply `function` to the arguments of each block, on all devices at the same time, and wait for all results."""
    work: dict[object, list[int]] = {}
    for k, block in enumerate(layout.local_blocks):
        work.setdefault(block.device, []).append(k)

    def on_device(which: list[int]) -> list[tuple[int, _T]]:
        return jax.block_until_ready([(k, function(*(x[k] for x in arguments))) for k in which])

    if len(work) == 1:
        return [result for which in work.values() for _, result in on_device(which)]
    with ThreadPoolExecutor(len(work)) as pool:
        return [result for done in pool.map(on_device, work.values()) for _, result in done]


def local_part(layout: Layout, blocks: Sequence[Numbers], axis: int = 0) -> np.ndarray:
    """The members of this process as one host array, without padding, from their blocks; `axis` is the member axis."""
    before = (slice(None),) * axis
    size = None if layout.place.whole else layout.block_size
    parts = [np.asarray(x)[*before, :size] for x in blocks]
    return (np.concatenate(parts, axis) if len(parts) > 1 else parts[0])[*before, : len(layout.local_members)]


def gather(layout: Layout, trees: Sequence[Tree], axis: int = 0) -> Tree:
    """The arrays of all members on every process, without padding, from a tree per block; `axis` is the member axis."""
    if layout.place.whole and count_processes(layout.mesh) == 1:
        return jax.tree.map(np.asarray, trees[0])
    return jax.tree.map(lambda *blocks: _gather_leaf(layout, blocks, axis), *trees)


def _gather_leaf(layout: Layout, blocks: Sequence[Numbers], axis: int) -> np.ndarray:
    mine = local_part(layout, blocks, axis)
    if count_processes(layout.mesh) == 1:
        return mine
    mine, devices = np.moveaxis(mine, axis, 0), len(layout.local_devices)
    mine = np.concatenate([mine, np.zeros((devices * layout.per_device - len(mine), *mine.shape[1:]), mine.dtype)])
    whole = _all_gather_rows(layout.mesh, mine.reshape(devices, layout.per_device, *mine.shape[1:]))
    return np.moveaxis(whole.reshape(-1, *mine.shape[1:])[: layout.members], 0, axis)


def _all_gather_rows(mesh: Mesh, mine: np.ndarray) -> np.ndarray:
    """The rows of all processes, one per device, on every process."""
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    first = mesh.devices.size // count_processes(mesh) * jax.process_index()

    def part(index: tuple[slice, ...] | None) -> np.ndarray:
        assert index is not None
        return mine[index[0].start - first : index[0].stop - first]

    array = jax.make_array_from_callback((mesh.size, *mine.shape[1:]), spread, part)
    return np.asarray(_replicator(mesh)(array).addressable_data(0))


@cache
def _replicator(mesh: Mesh) -> Callable[[Array], Array]:
    return jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, PartitionSpec()))


def count_processes(mesh: Mesh) -> int:
    """The number of processes to which the devices of a mesh belong."""
    return len({device.process_index for device in mesh.devices.flat})


def gather_row(mesh: Mesh, row: np.ndarray) -> np.ndarray:
    """The row of each process, (processes, values), on every process."""
    count = count_processes(mesh)
    if count == 1:
        return row[None]
    devices = mesh.size // count
    return _all_gather_rows(mesh, np.tile(row, (devices, 1)))[::devices]


def all_gather(mesh: Mesh, *values: float) -> np.ndarray:
    """The values of each process, (processes, values), on every process."""
    return gather_row(mesh, np.array(values, float))


def fail_together(mesh: Mesh, action: Callable[[], _T]) -> _T:
    """The result of `action`, which every process calls; if it fails on one process, it raises ValueError on all."""
    result, error = None, None
    try:
        result = action()
    except (ValueError, OSError) as failure:
        error = failure
    failed = np.flatnonzero(all_gather(mesh, error is not None))
    if error is not None:
        raise error
    if failed.size:
        raise ValueError(f"process {', '.join(map(str, failed))} of this run has failed; see its own error message")
    return cast("_T", result)


def all_reduce_max(mesh: Mesh, *values: float) -> tuple[float, ...]:
    """The maximum of each value over all processes (all-reduce), so that they decide alike."""
    return tuple(all_gather(mesh, *values).max(axis=0).tolist())


def barrier(mesh: Mesh) -> None:
    """Wait until every process has called this."""
    all_gather(mesh, 0.0)


def worst_energy_error(
    layout: Layout, H0: Sequence[Numbers], H: Sequence[Numbers], failed: Sequence[Numbers]
) -> tuple[float, int]:
    """max|H − H₀| / max|H₀| over all members, and the number of members that have failed."""
    H0_, H_, failed_ = (local_part(layout, x) for x in (H0, H, failed))
    change, size = (np.max(np.abs(x), initial=0.0) for x in (H_ - H0_, H0_))
    found = all_gather(layout.mesh, float(change), float(size), float(np.sum(failed_ >= 0)))
    change, size = found[:, :2].max(axis=0)
    return float(change / size if size else change), int(found[:, 2].sum())
