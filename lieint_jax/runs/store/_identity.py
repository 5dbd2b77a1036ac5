"""Everything that the bits of a run depend on, by which a run is compared with a store before it is resumed."""

from __future__ import annotations

import json
import os
import platform
import re
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path

import jax

from lieint_jax.core import leaves_by_name
from lieint_jax.runs._clock import GridClock
from lieint_jax.runs._digests import digest_of_arrays, reason_of
from lieint_jax.runs._engine import Engine
from lieint_jax.runs._facts import package_versions
from lieint_jax.runs._loop import compiler_options
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.storage import Address

_MACHINE = ("device", "engine", "compiler_options", "XLA_FLAGS")  # keys of a description, besides the versions
_EQUATIONS = ("equations of the step", "equations of reduce", "equations of first", "states that the function makes")
_DIGESTS = (*_EQUATIONS, "numbers of the step", "initial states", "times of the steps", "times of save_at")


def description(plan: Plan, engine: Engine) -> Table:
    """Everything that the bits of a run depend on, as read back from JSON. A run is resumed only if all of it is equal.

    Args:
        plan: the run, of all members.
        engine: computes it, or one of its parts.
    """
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "force_host_platform_device_count" not in f]
    described = {
        "scheme": plan.step.name,
        "system": type(plan.step.system).__name__,
        **engine.equations,
        "numbers of the step": {
            jax.tree_util.keystr(path, simple=True, separator="."): digest_of_arrays(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(plan.step)
        },
        "initial states": None
        if plan.make_states is not None
        else {name: digest_of_arrays(leaf) for name, leaf in leaves_by_name(plan.states).items()},
        "states that the function makes": None if plan.make_states is None else plan.make_states.digest(),
        "members": plan.members,
        "dt": plan.dt,
        "num_steps": plan.planned_steps,
        "save_every": plan.save_every,
        "times of the steps": digest_of_arrays(plan.clock.times) if isinstance(plan.clock, GridClock) else None,
        "times of save_at": None if plan.rests is None else digest_of_arrays(plan.times),
        "own_step": plan.own_step,
        "reduce": getattr(plan.reduction, "__name__", "a function") if plan.reduction is not None else None,
        "per": "member" if plan.per_member else None,
        "epoch": plan.epoch or None,
        "dtype": str(plan.dtype),
        "versions": package_versions(),
        "engine": engine.name,
        "compiler_options": compiler_options() if engine.name == "xla" else {},
        "XLA_FLAGS": " ".join(flags),
        "device": device(),
        "scenario": None if plan.store is None else plan.store.attributes.get("scenario"),
    }
    return json.loads(json.dumps(described))


def machine_of(described: Table) -> Table:
    """What a description has of the machine, on which the last bits of a run depend, and the run itself does not."""
    versions = {name: x for name, x in described["versions"].items() if name != "lieint_jax"}
    return {key: described.get(key) for key in _MACHINE} | {"versions": versions}


def check_same(path: Address, stored: Table, now: Table, same_bits: bool = True) -> None:
    """Raise ValueError if the run in a store differs from the one described, or cannot be compared with it.

    With `same_bits=False` it may have been computed on another machine.
    """
    run = stored["run"]
    for key, reason in (_not_comparable(run) | _not_comparable(now)).items():
        raise ValueError(f"{path} can neither be resumed nor be written in parts: the {key} {reason}")
    versions, equations, machine = (_differences_in(keys, run, now) for keys in (["versions"], _EQUATIONS, _MACHINE))
    others = _differences_in((run.keys() | now.keys()) - {"versions", *_EQUATIONS, *_MACHINE}, run, now)
    other_release = run["versions"].get("lieint_jax") != now["versions"]["lieint_jax"]
    if others or other_release or (equations and not versions):
        different = [*versions, *([] if versions else equations), *machine, *others]
        longer = now["num_steps"] - run["num_steps"] if different == others and len(others) == 1 else 0
        more = f". li.open({str(path)!r}).load().extend({longer}) adds the missing steps" if longer > 0 else ""
        raise ValueError(f"{path} holds another run and cannot be resumed by this one: {'; '.join(different)}{more}")
    if equations:
        raise ValueError(
            f"{path} was begun with other packages, which may trace one function into different equations, so that it "
            f"cannot be seen whether this is the same run: {'; '.join([*versions, *equations])}. Resume it with those "
            "packages, or run again into another store"
        )
    if (versions or machine) and same_bits:
        raise ValueError(
            f"{path} is resumed on another machine, whose last bits may differ: {'; '.join([*versions, *machine])}. "
            "Pass same_bits=False to accept this"
        )


def warn_of_no_resume(described: Table) -> None:
    """Warn at the start of a run that cannot be resumed, because something that it depends on cannot be compared."""
    for key, reason in _not_comparable(described).items():
        warnings.warn(f"this run cannot be resumed: the {key} {reason}", RuntimeWarning, stacklevel=5)


def differences(stored: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> list[str]:
    """The differences between two descriptions of a run, one line for each key, of digests without their value."""
    lines = []
    for key in sorted(stored.keys() | now.keys()):
        a, b = stored.get(key), now.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            if key not in _DIGESTS:
                lines += differences(a, b, f"{prefix}{key}.")
            elif names := sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name)):
                lines.append(f"the {key} differ ({', '.join(names)})")
        elif a != b and key in _DIGESTS:
            lines.append(f"the {key} differ")
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


def _differences_in(keys: Collection[str], stored: Table, now: Table) -> list[str]:
    a, b = ({key: described.get(key) for key in keys} for described in (stored, now))
    return differences(a, b)


def _not_comparable(described: Table) -> dict[str, str]:
    return {key: reason_of(described.get(key)) for key in _EQUATIONS if reason_of(described.get(key))}
