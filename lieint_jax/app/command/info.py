"""The commands `info` and `plot`: they describe and draw the results of a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import _checks, plots
from lieint_jax.app import scenarios
from lieint_jax.app.command import files
from lieint_jax.app.printer import readable, show, show_written
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._runs import POINTS, kinetic_energy, series
from lieint_jax.plots import runs as pictures
from lieint_jax.runs import Run
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address, UnknownNameError, UnreadableError, check_system, step_from_store
from lieint_jax.types import Step, Trajectory, energy_less_work

_SHOWN = 2**28  # largest number of bytes that are read from a store to draw it
_LINE = 400  # largest number of characters of a line with the numbers of parts
_TIMES, _BLOCK = 17, 8192  # number of saved times at which energies are computed, and of members at once


def plot(
    path: Address, out: Path | None = None, force: bool = False, own_kind: str = "", own: Kind | None = None
) -> None:
    """Report on a file of results and draw it: the pictures of its scenario, or those of a run of any system.

    The pictures of a scenario require states at evenly spaced steps; a run with `save_at` is drawn as any other run.

    Args:
        path: the file of results.
        out: the folder of the pictures; by default that of the file.
        force: replace existing pictures.
        own_kind: the kind of its scenario, FILE.py:CLASS, if it is a user's.
        own: in place of `own_kind`, its scenario.
    """
    run, metadata = archives.load_results(path)
    if len(_times(run)) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to draw yet")
    plain = files.path_in_folder(path, out)
    kind = _table(metadata).get("system")
    own = own or own_scenario(path, metadata, own_kind)
    unknown = "description" in metadata and not (own or kind is None or kind in scenarios.kind_names())
    scenario = None if unknown else own or _scenario(path, metadata)
    if scenario and scenario.save_at is None and isinstance(run, Trajectory):
        drawn = _plot_scenario(scenario, run, path, plain, force)
    else:
        drawn = _plot_any(path, run, metadata, plain, force, own)
    if unknown:  # a file of results does not choose what is imported
        kind = _checks.printable(kind)
        gone = "" if Path(kind.partition(":")[0]).is_file() else f" ({kind} is not here: give the place of its file)"
        show(f"  --kind {kind} draws and reports as its own kind does{gone}")
    show_written(*drawn)


def _plot_scenario(scenario: Kind, run: Trajectory, path: Address, plain: Path, force: bool) -> list[Path]:
    drawings, members = scenario.pictures(), scenario.members
    files.check_replaceable(files.pictures(plain, drawings), force)
    shown = slice(_count_drawn(run))
    saved = Trajectory(run.t, *jax.tree.map(lambda x: x[:, shown], (run.state, run.info)))
    changes = {"steps": (len(saved.t) - 1) * scenario.save_every, "members": saved.state.p.shape[1]}
    step = scenarios.build_first(scenario, changes["members"])
    check_system(path, step.system, saved, scenario.has_own_steps())
    made = Run.of(step, saved, scenario.has_own_steps(), scenario.date_of_zero())
    scenario = scenario.model_copy(update=changes)
    show(headline(scenario, step))
    if scenario.members < members:
        show(f"  the first {scenario.members} of {members} members")
    drawn = draw(plain, drawings, scenario, made)
    show(readable(scenario).report(made))
    return drawn


def _plot_any(
    path: Address, run: Any, metadata: dict[str, Any], plain: Path, force: bool, own: Kind | None
) -> list[Path]:
    saved = isinstance(run, Trajectory)
    kinds: dict[str, Callable[..., Any]] = (
        pictures.pictures_of(run.state) if saved else {"change": pictures.reduced_change}
    )
    files.check_replaceable(files.pictures(plain, kinds), force)
    if saved:
        title, select = title_and_states(path, run, metadata, own)
        times = np.unique(np.linspace(0, len(run.t) - 1, min(len(run.t), POINTS)).astype(int))
        arguments = select(times, slice(_count_drawn(run))), title
    else:
        arguments = run, _title(path, metadata), _time_unit(metadata)
    show(contents(path, run, metadata, own))
    return draw(plain, kinds, *arguments)


def draw(path: Path, kinds: Mapping[str, Callable[..., Any]], *arguments: Any) -> list[Path]:
    """Write the pictures that the functions `kinds` draw as PNG and PDF, named after `path`, and return their paths."""
    drawn = []
    for suffix, picture in kinds.items():
        drawn += plots.save(picture(*map(readable, arguments)), files.picture(path, suffix))
    return drawn


def _count_drawn(run: Trajectory) -> int:
    """How many members are drawn: as many, from the first on, as `_SHOWN` allows."""
    return max(1, min(_SHOWN // sum(x[:, 0].nbytes for x in jax.tree.leaves(run.state)), run.state.p.shape[1]))


def _times(run: Any) -> Any:
    return run.t if isinstance(run, Trajectory) else run["time"]


def _scenario(path: Address, metadata: dict[str, Any], own_kind: str = "") -> Any:
    """The scenario of results; None if `lieint run` did not write them."""
    table = _table(metadata)
    return scenarios.from_results(table, str(path), own_kind) if "system" in table else None


def own_scenario(path: Address, metadata: dict[str, Any], own_kind: str) -> Any:
    """The scenario of results whose kind, FILE.py:CLASS, is a user's; None without a kind."""
    if not own_kind:
        return None
    if (found := _scenario(path, metadata, own_kind)) is None:
        raise ValueError(f"{path} holds no scenario: leave out --kind")
    return found


def _table(metadata: dict[str, Any]) -> dict[str, Any]:
    """The keys of the scenario of results; empty if there is no scenario, or other software wrote it."""
    table = metadata.get("scenario")
    return table if isinstance(table, dict) else {}


def _title(path: Address, metadata: dict[str, Any]) -> str:
    """The title of a run: the given one, or else the system and the name of the file."""
    if metadata.get("title", metadata["scheme"]) != metadata["scheme"]:
        return _checks.printable(metadata["title"])
    return f"{re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', metadata['system']).capitalize()}, {path.name}"


def title_and_states(
    path: Address, run: Trajectory, metadata: dict[str, Any], own: Kind | None = None
) -> tuple[str, Callable[..., Run]]:
    """The title of a run, and select(times, members), its saves of these indices as a `Run` in memory.

    `own` is its scenario, if that is of a user's kind: the step is then made by it, not by the results.

    Raises:
        ValueError: the results hold neither a step nor a scenario that has one.
    """
    scenario = own or (None if "description" in metadata else _scenario(path, metadata))
    if scenario:
        step, own_step = scenarios.build_first(scenario, run.state.p.shape[1]), scenario.has_own_steps()
        title = _checks.printable(scenario.title)
    elif "run" in metadata:
        step, own_step = _stored_step(path, metadata), metadata["run"]["step_axis"] == 0
        title = _title(path, metadata)
    else:
        raise ValueError(f"{path} holds neither a scenario nor the parameters of its system")
    check_system(path, step.system, run, own_step)

    def select(times: np.ndarray | None = None, members: slice = slice(None)) -> Run:
        chosen = slice(None) if times is None else times
        state, info = jax.tree.map(lambda x: np.asarray(x[chosen, members]), (run.state, run.info))
        own = jax.tree.map(lambda x: x[members], step) if own_step else step
        saved = Trajectory(jnp.asarray(np.asarray(run.t)[chosen]), state, info)
        return Run.of(own, saved, own_step, time_unit=_time_unit(metadata) or "1")

    return title, select


def _stored_step(path: Address, metadata: dict[str, Any]) -> Step:
    try:
        return step_from_store(path, metadata)
    except UnknownNameError as error:
        kind = _table(metadata).get("system")
        if kind is None or kind in scenarios.kind_names():
            raise
        raise ValueError(
            f"{path}: the system has functions of the kind {_checks.printable(kind)}, and a store does not choose what "
            "is imported: give --kind FILE.py:CLASS if it is yours"
        ) from error


def _time_unit(metadata: dict[str, Any]) -> str:
    """The unit of a run's times; empty if there is none."""
    unit = _checks.printable(metadata.get("time_unit") or _table(metadata).get("time_unit", ""))
    return "" if unit == "1" else unit


def describe(path: Address, own_kind: str) -> str:
    """A description of a file of results as text, of whose scenario the kind may be a user's, FILE.py:CLASS."""
    run, metadata = archives.load_results(path, thorough=True)
    return contents(path, run, metadata, own_scenario(path, metadata, own_kind))


def contents(path: Address, run: Any = None, metadata: Any = None, own: Kind | None = None) -> str:
    """A description of a file of results, as text; `own` is its scenario, if that is of a user's kind."""
    if run is None:
        run, metadata = archives.load_results(path, thorough=True)
    title = metadata.get("title") or _table(metadata).get("title", str(path))
    lines = [_checks.printable(title), *_origin(path, run, metadata)]
    t = _times(run)
    if not len(t):
        return "\n".join(lines)
    date = metadata.get("run", {}).get("epoch") or _table(metadata).get("epoch")
    since = f"; t = 0 at {_checks.printable(date)}" if date else ""
    lines.append(f"  t = {t[0]:.6g} … {t[-1]:.6g} {_time_unit(metadata)}".rstrip() + since)
    if not isinstance(run, Trajectory):
        return "\n".join([*lines, *_changes(run, metadata["reduce"])])
    if metadata.get("missing"):
        lines.append("  energies are not computed: the run is incomplete")
    elif len(t) > 1:
        try:
            lines += _conservation(run, title_and_states(path, run, metadata, own)[1])
        except UnreadableError:
            raise
        except ValueError as unknown:
            lines.append(f"  energies are not computed: {unknown}")
    return "\n".join(lines)


def _origin(path: Address, run: Any, metadata: dict[str, Any]) -> list[str]:
    """Lines with the scheme, the system and the size of a run, its progress, and the versions of the software."""
    if not (progress := metadata.get("progress")):
        if "lieint_jax" not in metadata:
            raise UnreadableError(f"{path} is no file of results that lieint wrote: its metadata has no lieint_jax")
        version = _checks.printable(metadata["lieint_jax"])
        return [f"  {run.state.p.shape[1]} member(s), {len(run.t)} entries; lieint_jax {version}"]
    planned, dt = metadata["num_steps"], metadata["dt"]
    sizes = "between given times" if dt is None else f"of {dt:.6g} {_time_unit(metadata)}".rstrip()
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
        f"  {state}: {len(_times(run))} of {entries} entries",
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


def headline(scenario: Kind, step: Step) -> str:
    """The first lines of a scenario's report: its title, its size and its scheme."""
    scenario = readable(scenario)
    since = f", t = 0 at {scenario.epoch}" if scenario.epoch else ""
    lines = [scenario.title, f"  {scenario.members} member(s), {scenario.describe_steps()}{since}, {step.name}"]
    if scenario.members > 1 and scenario.assumption():
        lines.append(f"  {scenario.assumption()}")
    return "\n".join(lines)
