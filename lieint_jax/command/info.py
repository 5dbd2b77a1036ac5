"""The command `info`: it describes the run in a store, and what it conserved."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from lieint_jax import _checks
from lieint_jax.command.printer import show
from lieint_jax.core import Trajectory, energy_less_work
from lieint_jax.plots.runs import kinetic_energy, series
from lieint_jax.runs import Run
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address, UnreadableError, check_system, step_from_store

_LINE = 400  # largest number of characters of a line with the numbers of parts
_TIMES, _BLOCK = 17, 8192  # number of saved times at which energies are computed, and of members at once


def describe(path: tyro.conf.Positional[str]) -> None:
    """Describe the run in a store: its system and size, its progress, its parts, and what it conserved.

    Args:
        path: the store, NAME.zarr or NAME.zip, by its path or URL.
    """
    show(text(archives.address(path)))


def text(path: Address) -> str:
    """A description of the run in a store, as text."""
    run, metadata = archives.load_store(path, thorough=True)
    lines = [title_of(path, metadata), *_origin(run, metadata)]
    t = times_of(run)
    if not len(t):
        return "\n".join(lines)
    date = metadata["run"].get("epoch")
    since = f"; t = 0 at {_checks.printable(date)}" if date else ""
    lines.append(f"  t = {t[0]:.6g} … {t[-1]:.6g} {time_unit_of(metadata)}".rstrip() + since)
    if not isinstance(run, Trajectory):
        return "\n".join([*lines, *_changes(run, metadata["reduce"])])
    if metadata.get("missing"):
        lines.append("  energies are not computed: the run is incomplete")
    elif len(t) > 1:
        try:
            lines += _conservation(run, select_from(path, run, metadata))
        except UnreadableError:
            raise
        except ValueError as unknown:
            lines.append(f"  energies are not computed: {unknown}")
    return "\n".join(lines)


def select_from(path: Address, run: Trajectory, metadata: dict[str, Any]) -> Callable[..., Run]:
    """select(times, members): the saves of these indices, of the run in a store, as a `Run` in memory.

    Raises:
        ValueError: the system of the run is of classes from outside this package; the message names the call of
            Python that opens it.
    """
    step, own_step = step_from_store(path, metadata), metadata["run"]["own_step"]
    known = {"dt": metadata["dt"], "num_steps": metadata["run"]["num_steps"], "save_every": metadata["save_every"]}
    check_system(path, step.system, run, own_step)

    def select(times: np.ndarray | None = None, members: slice = slice(None)) -> Run:
        chosen = slice(None) if times is None else times
        state, info = jax.tree.map(lambda x: np.asarray(x[chosen, members]), (run.state, run.info))
        own = jax.tree.map(lambda x: x[members], step) if own_step else step
        saved = Trajectory(jnp.asarray(np.asarray(run.t)[chosen]), state, info)
        made = Run.of(own, saved, own_step, time_unit=time_unit_of(metadata) or "1")
        return dataclasses.replace(made, facts=made.facts._replace(**known, source=str(path)))

    return select


def title_of(path: Address, metadata: dict[str, Any]) -> str:
    """The title of the run in a store: the given one, or else its system and the name of the file."""
    if metadata.get("title", metadata["scheme"]) != metadata["scheme"]:
        return _checks.printable(metadata["title"])
    return _checks.printable(f"{re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', metadata['system']).capitalize()}, {path.name}")


def times_of(run: Any) -> Any:
    """The times of the saves of a run, or of a reduced one."""
    return run.t if isinstance(run, Trajectory) else run["time"]


def time_unit_of(metadata: dict[str, Any]) -> str:
    """The unit of a run's times; empty if there is none."""
    unit = _checks.printable(metadata.get("time_unit", ""))
    return "" if unit == "1" else unit


def _origin(run: Any, metadata: dict[str, Any]) -> list[str]:
    """Lines with the scheme, the system and the size of a run, its progress, and the versions of the software."""
    progress, planned, dt = metadata["progress"], metadata["num_steps"], metadata["dt"]
    sizes = "between given times" if dt is None else f"of {dt:.6g} {time_unit_of(metadata)}".rstrip()
    entries = metadata["num_entries"]
    more = "; --resume continues it" if "parts" not in metadata else ""
    state = "complete" if progress["complete"] else f"{progress['steps']} of {planned} steps{more}"
    versions = ", ".join(f"{name} {version}" for name, version in metadata["run"]["versions"].items())
    written = metadata["run"]
    how = "machine code" if written["engine"] == "native" else f"XLA, {written['compiler_options']}"
    scheme, system, device, versions, how = map(
        _checks.printable, (metadata["scheme"], metadata["system"], written["device"], versions, how)
    )
    return [
        f"  {scheme} · {system}, {metadata['members']} member(s), {planned} steps {sizes}",
        f"  {state}: {len(times_of(run))} of {entries} entries",
        f"  written by {versions} on {device}, {how}",
        *_machines(metadata),
        *_parts(metadata),
    ]


def _machines(metadata: dict[str, Any]) -> list[str]:
    """A line for each kind of machine that has computed parts of a store, where there are several."""
    found: dict[str, list[int]] = {}
    for part, machine in metadata["machines"]:
        versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
        found.setdefault(_checks.printable(f"{machine['device']}, {machine['engine']}, {versions}"), []).append(part)
    lines = (f"  part {', '.join(map(str, parts))} on {machine}" for machine, parts in found.items())
    return [_checks.printable(line, _LINE) for line in lines] if len(found) > 1 else []


def _parts(metadata: dict[str, Any]) -> list[str]:
    """The number of complete parts of a store, and a line for each part that is missing, damaged or incomplete."""
    if "parts" not in metadata:
        return []
    missing = metadata["missing"]
    complete = f"  {metadata['parts'] - len(missing)} of {metadata['parts']} part(s) complete"
    return [complete, *(f"  {x}" for x in missing)]


def _changes(series: dict[str, np.ndarray], quantity: str) -> list[str]:
    """Lines: the values or changes of a reduced quantity, and the convergence of the steps."""
    quantity = _checks.printable(quantity)
    least, greatest = series["least"].min(), series["greatest"].max()
    if "mean" in series:
        mean = series["mean"].mean()
        lines = [f"  change of {quantity} since the start: least {least:.3g}, greatest {greatest:.3g}, mean {mean:.3g}"]
    else:
        lines = [f"  {quantity} of all members at all steps: least {least:.3g}, greatest {greatest:.3g}"]
    if "first" in series:
        reached = series["first"][~np.isnan(series["first"])]
        when = f", from t = {reached.min():.6g} to {reached.max():.6g}" if reached.size else ""
        lines.append(f"  the condition became true for {reached.size} of {len(series['first'])} member(s){when}")
    residual, failed = series["residual"].max(), series["unconverged"].max()
    return [*lines, f"  largest residual {residual:.2g}; unconverged members {failed}"]


def _conservation(run: Trajectory, select: Callable[..., Run]) -> list[str]:
    """Lines of the largest change of energy (less work, if counted) at `_TIMES` saves, and of the converged members."""
    count = run.state.p.shape[1]
    times = np.unique(np.linspace(0, len(run.t) - 1, _TIMES).astype(int))
    worst = size = failed = 0.0
    has_energy = True
    for first in range(0, count, _BLOCK):
        part = slice(first, first + _BLOCK)
        chosen = select(times, part)
        if has_energy := chosen.system.hamiltonian:
            H, K = series(energy_less_work, chosen), series(kinetic_energy, chosen)
            worst = max(worst, float(abs(H - H[0]).max()))
            size = max(size, float(abs(H[0]).max()), float(K.max()))
        failed += int((~np.asarray(run.info.converged[:, part])).any(axis=0).sum())
    converged = f"  {int(count - failed)} of {count} members converged at every step"
    if not has_energy:
        return [converged]
    what = "energy" if run.state.work is None else "energy less work"
    relative = f" ({worst / size:.2g} of the largest energy)" if size else ""
    sample = f"at {len(times)} of {len(run.t)} saved times"
    largest = f"  largest change of {what}, all members, {sample}: {worst:.2g} in the run's units{relative}"
    return [largest, converged]
