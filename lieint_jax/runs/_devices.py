"""Members over devices.

On a CPU one program computes all members, in threads. Accelerators share the members: the axis "members" of a mesh runs
over them, and the batch is padded with copies of its last member, so that each has equally many. Processes share
nothing: each integrates a part of a run of its own.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
from functools import cache
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lieint_jax import _checks

_T = TypeVar("_T")
Tree = Any  # a tree of arrays
Numbers = Array | np.ndarray
AXIS = "members"


def checked_mesh(mesh: Mesh | None) -> Mesh:
    """`mesh`, checked: its one axis is "members", with devices of this process. None means all of these."""
    if mesh is None:
        return first_devices(None)
    if not isinstance(mesh, Mesh) or tuple(mesh.axis_names) != (AXIS,):
        given = tuple(mesh.axis_names) if isinstance(mesh, Mesh) else type(mesh).__name__
        raise ValueError(f'mesh must be a jax.sharding.Mesh of one axis, "{AXIS}", got {given}')
    others = sorted({device.process_index for device in mesh.devices.flat} - {jax.process_index()})
    if others:
        raise ValueError(
            f"mesh must have devices of this process only, number {jax.process_index()}, got some of processes "
            f"{', '.join(map(str, others))}: processes share a run by its parts, part=(k, n)"
        )
    return mesh


def count_cores() -> int:
    """The number of cores that this process may use, at least 1.

    The least of those on which it may run, of the CPU quota of its control group (1 for half a CPU), and of
    SLURM_CPUS_PER_TASK and OMP_NUM_THREADS, by which SLURM, Dask, Ray and joblib give each worker its share.
    """
    limits = [float(len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1)]
    limits += _quotas()
    shares = (os.environ.get(name, "").split(",")[0] for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS"))
    limits += [float(share) for share in shares if share.isdecimal() and int(share)]
    return math.ceil(min(limits))


@cache
def _quotas() -> list[float]:
    """The CPU quotas of the control groups of this process, in cores; their files are read once."""
    quotas = _checks.limits_of_groups("cpu", "cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us")
    return [quota[0] / quota[1] for quota in quotas if quota[0] > 0]


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
    """A mesh for `run` and `over_members` of the first `count` devices of this process; None means all.

    Raises:
        ValueError: the process has fewer devices.
    """
    return _mesh_of(tuple(jax.local_devices()), count)


@cache
def _mesh_of(devices: tuple[Any, ...], count: int | None) -> Mesh:
    if count is not None and count > len(devices):
        raise ValueError(f"{count} devices were requested, and {len(devices)} are available")
    return Mesh(np.array(devices[:count]), (AXIS,))


def placed(mesh: Mesh, tree: _T, own: bool = True) -> _T:
    """Host arrays on the devices of a mesh, padded; if members do not have their `own`, all of it on all devices."""
    tree = jax.tree.map(on_host, tree)
    if on_cpu(mesh):
        return tree
    if own:
        tree = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], -len(x) % mesh.size, axis=0)]), tree)
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(*[AXIS] * own)))


def on_cpu(mesh: Mesh) -> bool:
    """Whether the devices of a mesh are CPUs."""
    return mesh.devices.flat[0].platform == "cpu"


def on_host(x: Numbers) -> Numbers:
    """Convert to NumPy, unless it is an array of random keys, which NumPy does not have."""
    is_key = isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.extended)
    return x if is_key else np.asarray(x)


def without_padding(tree: Tree, members: int, axis: int = 0) -> Tree:
    """The arrays of so many members on the host; `axis` is the member axis."""
    return jax.tree.map(lambda x: np.asarray(x)[*(slice(None),) * axis, :members], tree)


def worst_energy_error(H0: Numbers, H: Numbers) -> float:
    """max|H − H₀| / max|H₀| over all members."""
    change, size = (float(np.max(np.abs(x), initial=0.0)) for x in (np.asarray(H) - np.asarray(H0), np.asarray(H0)))
    return change / size if size else change
