"""Everything that the bits of a run depend on; processes and stores are compared by it before a run starts."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from jax.typing import ArrayLike

from lieint_jax.runs._job import devices
from lieint_jax.runs._job.facts import package_versions
from lieint_jax.runs._job.job import Job
from lieint_jax.runs._job.loop import compiler_options
from lieint_jax.runs._march.clock import GridClock
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.storage import Address
from lieint_jax.runs.store._digest import NotDigestible, digest, python_of
from lieint_jax.types import State, leaves_by_name

_MACHINE = ("device", "engine", "compiler_options", "XLA_FLAGS")  # keys of a description, besides the versions
_NO_DIGEST = "cannot be compared: "  # begins the reason that stands in place of a digest in a description
_ADVICE = (
    "pass the function's data in a jax.tree_util.Partial, or make it a callable pytree, whose numbers are compared one "
    "by one"
)


def description(job: Job, engine: str, scenario: object = None) -> Table:
    """Everything that the bits of a run depend on, as read back from JSON. A run is resumed only if all of it is equal.

    Args:
        job: the run.
        engine: the name of the engine that computes it, "native" (machine code), "kernel" (of a GPU) or "xla".
        scenario: the table that the run was made from, or None.
    """
    leaves, structure = jax.tree.flatten(job.step)
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "force_host_platform_device_count" not in f]
    python = python_of(structure, job.reduction, job.condition, job.make_states)
    described = {
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "functions and options of the step": _digest_or_reason(structure),
        "numbers of the step": _digest_of_arrays(*leaves),
        "initial states": digest_of_states(job.initial) if job.make_states is None else None,
        "function of states": _digest_or_reason(job.make_states),
        "members": job.members,
        "dt": job.dt,
        "num_steps": job.planned_steps,
        "save_every": job.save_every,
        "times": _digest_of_arrays(job.clock.times) if isinstance(job.clock, GridClock) else None,
        "save_at": None if job.rests is None else _digest_of_arrays(job.times),
        "step_axis": job.step_axis,
        "reduce": getattr(job.reduction, "__name__", "a function") if job.reduction is not None else None,
        "function of reduce": _digest_or_reason(job.reduction),
        "per": "member" if job.per_member else None,
        "function of first": _digest_or_reason(job.condition),
        "epoch": job.epoch or None,
        "dtype": str(job.dtype),
        "versions": package_versions() | ({} if python is None else {"python": python}),
        "engine": engine,
        "compiler_options": compiler_options() if engine == "xla" else {},
        "XLA_FLAGS": " ".join(flags),
        "device": device(),
        "scenario": scenario,
    }
    return json.loads(json.dumps(described))


def check_processes(mesh: Mesh, described: Table, **options: object) -> None:
    """Raise ValueError on every process if the processes are about to start different runs.

    Args:
        mesh: the devices of all processes.
        described: the description of this process' run.
        options: other values for JSON on which the processes must agree.
    """
    if devices.count_processes(mesh) == 1:
        return
    parts = {**described, **options}
    mine = [hashlib.sha256(json.dumps(parts[key], sort_keys=True).encode()).digest()[:8] for key in parts]
    found = devices.all_gather(mesh, np.frombuffer(b"".join(mine), np.uint32)).reshape(-1, len(parts), 2)
    different = [key for key, same in zip(parts, (found == found[0]).all(axis=(0, 2)), strict=True) if not same]
    if different:
        raise ValueError(
            f"the processes of this run were given different runs: they differ in {', '.join(different)}. Nothing was "
            "integrated; start every process with the same scenario and the same arguments"
        )


def machine_of(described: Table) -> Table:
    """What a description has of the machine, on which the last bits of a run depend, and the run itself does not."""
    versions = {name: x for name, x in described["versions"].items() if name != "lieint_jax"}
    return {key: described.get(key) for key in _MACHINE} | {"versions": versions}


def check_same(path: Address, stored: Table, now: Table, same_bits: bool = True) -> None:
    """Raise ValueError if the run in a store differs from the one described, or cannot be compared with it.

    With `same_bits=False` it may have been computed on another machine.
    """
    for key, reason in _not_comparable(now).items():
        raise ValueError(f"{path} cannot be resumed: the {key} {reason}; {_ADVICE}")
    run = stored["run"]
    different = differences(run, now)
    if different and different == differences(machine_of(run), machine_of(now)):
        if same_bits:
            raise ValueError(
                f"{path} is resumed on another machine, whose last bits may differ: {'; '.join(different)}. Pass "
                "same_bits=False (--any-machine) to accept this"
            )
    elif different:
        raise ValueError(f"{path} holds another run and cannot be resumed by this one: {'; '.join(different)}")


def warn_of_no_resume(described: Table) -> None:
    """Warn at the start of a run that cannot be resumed, because something that it depends on has no digest."""
    for key, reason in _not_comparable(described).items():
        warnings.warn(f"this run cannot be resumed: the {key} {reason}; {_ADVICE}", RuntimeWarning, stacklevel=5)


def differences(stored: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> list[str]:
    """The differences between two descriptions of a run, one line for each key."""
    lines = []
    for key in sorted(stored.keys() | now.keys()):
        a, b = stored.get(key), now.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += differences(a, b, f"{prefix}{key}.")
        elif a != b:
            lines.append(f"{prefix}{key} is {a!r} in the store and {b!r} here")
    return lines


def device() -> str:
    """The kind of device; of a CPU also its widest vector instructions, on which the compiled code depends."""
    first = jax.devices()[0]
    if first.platform != "cpu":
        return first.device_kind
    try:
        flags = re.search(r"(?m)^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        flags = None
    found = [isa for isa in ("avx512f", "avx2", "avx") if flags and isa in flags.group(1).split()]
    return " ".join([platform.machine(), *found[:1]])


def _not_comparable(described: Table) -> dict[str, str]:
    return {key: x for key, x in described.items() if isinstance(x, str) and x.startswith(_NO_DIGEST)}


def _digest_or_reason(value: object) -> str | None:
    """The digest of a value, or the reason why it has none; None of None."""
    try:
        return None if value is None else digest(value)
    except NotDigestible as reason:
        return f"{_NO_DIGEST}{reason}"


def digest_of_states(states: State) -> str:
    """The digest of the arrays of states: q and p first, then each optional array after its name."""
    q, p, *rest = leaves_by_name(states).items()
    return _digest_of_arrays(q[1], p[1], *(part for name, x in rest for part in (name.encode(), x)))


def _digest_of_arrays(*leaves: ArrayLike | bytes) -> str:
    found = hashlib.sha256()
    for leaf in leaves:
        array = np.frombuffer(leaf, np.uint8) if isinstance(leaf, bytes) else np.asarray(leaf)
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return found.hexdigest()[:16]
