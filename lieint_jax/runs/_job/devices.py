"""Members over processes and devices.

The mesh axis "members" runs over devices and processes; each process has consecutive members. On a CPU one program
computes them all, in threads. The accelerators of a process share them; there the batch is padded with copies of its
last member, so that each has equally many.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from lieint_jax import _checks

_T = TypeVar("_T")
Tree = Any  # a tree of arrays
Numbers = Array | np.ndarray
AXIS = "members"


class Layout(NamedTuple):
    """The members of each process.

    Attributes:
        mesh: the devices of all processes.
        members: the number of members.
        each: the number of places of a process; the last ones may have no members.
        local_members: the members of this process.
    """

    mesh: Mesh
    members: int
    each: int
    local_members: range

    @property
    def computed_members(self) -> range:
        """The members that this process computes: the last one, if it has none."""
        return self.local_members or range(self.members - 1, self.members)


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
    """The number of cores that this process may use, at least 1.

    The least of those on which it may run, of the CPU quota of its control group (1 for half a CPU), and of
    SLURM_CPUS_PER_TASK and OMP_NUM_THREADS, by which SLURM, Dask, Ray and joblib give each worker its share.
    """
    limits = [float(len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1)]
    for quota in _checks.limits_of_groups("cpu", "cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us"):
        limits += [quota[0] / quota[1]] if quota[0] > 0 else []
    shares = (os.environ.get(name, "").split(",")[0] for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS"))
    limits += [float(share) for share in shares if share.isdecimal() and int(share)]
    return math.ceil(min(limits))


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


def layout_of(mesh: Mesh, members: int, chunk: int = 1) -> Layout:
    """The layout of so many members, of which each process but the last one has whole chunks."""
    processes = list(dict.fromkeys(device.process_index for device in mesh.devices.flat))
    each = chunk * -(-members // (len(processes) * chunk))
    first = processes.index(jax.process_index()) * each
    return Layout(mesh, members, each, range(min(first, members), min(first + each, members)))


def placed(layout: Layout, tree: _T, own: bool = True, first: int = 0) -> _T:
    """The part of this process of host arrays that begin at member `first`, on its devices.

    If members do not have their `own`, all of it on all devices.
    """
    tree, mine = jax.tree.map(on_host, tree), layout.computed_members
    if own:
        tree = jax.tree.map(lambda x: x[mine.start - first : mine.stop - first], tree)
    if _on_cpu(layout):
        return tree
    devices = layout.mesh.local_devices
    if own and (missing := -len(mine) % len(devices)):
        tree = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], missing, axis=0)]), tree)
    return jax.device_put(tree, NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(*[AXIS] * own)))


def on_host(x: Numbers) -> Numbers:
    """An array of NumPy, where there is one: random keys have none."""
    is_key = isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.extended)
    return x if is_key else np.asarray(x)


def _on_cpu(layout: Layout) -> bool:
    return layout.mesh.local_devices[0].platform == "cpu"


def local_part(layout: Layout, x: Numbers, axis: int = 0) -> np.ndarray:
    """The members of this process as a host array, without padding; `axis` is the member axis."""
    return np.asarray(x)[*(slice(None),) * axis, : len(layout.local_members)]


def gather(layout: Layout, tree: Tree, axis: int = 0) -> Tree:
    """The arrays of all members on every process, without padding; `axis` is the member axis."""
    return jax.tree.map(lambda x: _gather_leaf(layout, x, axis), tree)


def _gather_leaf(layout: Layout, x: Numbers, axis: int) -> np.ndarray:
    mine, processes = local_part(layout, x, axis), count_processes(layout.mesh)
    if processes == 1:
        return mine
    mine, devices = np.moveaxis(mine, axis, 0), layout.mesh.size // processes
    per_device = -(-layout.each // devices)
    mine = np.concatenate([mine, np.zeros((devices * per_device - len(mine), *mine.shape[1:]), mine.dtype)])
    whole = _all_gather_rows(layout.mesh, mine.reshape(devices, per_device, *mine.shape[1:]))
    whole = whole.reshape(processes, devices * per_device, *mine.shape[1:])[:, : layout.each]
    whole = whole.reshape(processes * layout.each, *mine.shape[1:])
    return np.moveaxis(whole[: layout.members], 0, axis)


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


def all_gather(mesh: Mesh, row: ArrayLike) -> np.ndarray:
    """The row of values of each process, (processes, values), on every process."""
    count, mine = count_processes(mesh), np.asarray(row)[None]
    if count == 1:
        return mine
    devices = mesh.size // count
    return _all_gather_rows(mesh, np.tile(mine, (devices, 1)))[::devices]


def fail_together(mesh: Mesh, action: Callable[[], _T]) -> _T:
    """The result of `action`, which every process calls; if it fails on one process, it raises ValueError on all."""
    result, error = None, None
    try:
        result = action()
    except (ValueError, OSError) as failure:
        error = failure
    failed = np.flatnonzero(all_gather(mesh, [error is not None]))
    if error is not None:
        raise error
    if failed.size:
        raise ValueError(f"process {', '.join(map(str, failed))} of this run has failed; see its own error message")
    return cast("_T", result)


def all_reduce_max(mesh: Mesh, *values: float) -> tuple[float, ...]:
    """The maximum of each value over all processes (all-reduce), so that they decide alike."""
    return tuple(all_gather(mesh, np.array(values, float)).max(axis=0).tolist())


def worst_energy_error(layout: Layout, H0: Numbers, H: Numbers, failed: Numbers) -> tuple[float, int]:
    """max|H − H₀| / max|H₀| over all members, and the number of members that have failed."""
    H0_, H_, failed_ = (local_part(layout, x) for x in (H0, H, failed))
    change, size = (np.max(np.abs(x), initial=0.0) for x in (H_ - H0_, H0_))
    found = all_gather(layout.mesh, [float(change), float(size), float(np.sum(failed_ >= 0))])
    change, size = found[:, :2].max(axis=0)
    return float(change / size if size else change), int(found[:, 2].sum())
