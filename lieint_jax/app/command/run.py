"""The command `run`: it integrates a scenario, prints a report and writes the results."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np

from lieint_jax import _checks, runs
from lieint_jax._version import __version__
from lieint_jax.app import scenarios
from lieint_jax.app.command import export, files, info
from lieint_jax.app.printer import readable, show, show_time, show_written
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._runs import nominal_state
from lieint_jax.diagnostics import certify
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address, Url

_NOTED = 10**8  # bytes; the command prints the memory that it needs, if it is more
_WATCHED = 10_000  # largest number of steps of a certificate
_LARGE = 10**7  # members × entries, above which the size of a run is checked before its members are built


def run(
    name: str,
    out: Address | None,
    members: int | None = None,
    steps: int | None = None,
    devices: int | None = None,
    resume: bool = False,
    save_at: Path | None = None,
    *,
    given: Sequence[str] = (),
    certificate: bool = True,
    pictures: bool = True,
    part: tuple[int, int] | None = None,
    exports: Sequence[Path] = (),
    parts: int | None = None,
    executor: runs.Executor | None = None,
    same_bits: bool = True,
) -> None:
    """Integrate a scenario and write the results; for an .npz, also print the report.

    Args:
        name: a shipped scenario or a file.
        out: the file of results, NAME.npz or NAME.zarr, the latter also a URL; by default named after the scenario.
        members, steps, save_at: values that replace those of the scenario.
        given: further ones, as texts KEY=VALUE.
        devices: the number of devices to use.
        resume: continue the run in a NAME.zarr.
        certificate: measure what the scheme conserves along the nominal member, if an .npz is written.
        pictures: draw the run, if an .npz is written.
        part: (k, n), one of n independent processes that write one NAME.zarr.
        exports: further files of the run, in formats of others: see `export`.
        parts, executor, same_bits: as in `li.submit`, for the parts of one NAME.zarr.
    """
    resume = resume or part is not None or parts is not None  # a part always continues what it finds
    times = save_at and files.read_numbers(save_at)
    scenario = scenarios.load(name, given, members=members, steps=steps, save_at=times)
    export.check(exports, scenario)
    if exports and part is not None:
        raise ValueError("--export writes the whole run: open the store of all parts in Python, with li.open")
    drawings = scenario.pictures() if pictures else {}
    certificate = certificate and scenario.certified
    if out is None:
        file = Path(Path(name).stem).with_suffix(".zarr" if resume else ".npz")
        out = file if resume else files.unused_path(file, lambda path: files.pictures(path, drawings))
    out = files.check_writable(out, drawings, resume)
    makes_own = not scenario.has_own_steps()  # a part makes the states of its own members only
    count = parts or (1 if part is None else part[1])
    _check_size(scenario, out, count if makes_own else 1)
    leader = jax.process_index() == 0
    mesh = runs.first_devices(devices)
    if makes_own:
        step, states = scenarios.build_first(scenario, 1), partial(scenarios.states_of, scenario)
    else:
        step, states = scenario.build()
    export.check_system(exports, step.system)
    show_time("making the scenario")
    if leader:
        show(info.headline(scenario, step))
        needed = runs.peak_memory(
            scenarios.shapes_of_states(scenario) if makes_own else states,
            _entries(scenario),
            store=out if out.suffix == ".zarr" else None,
            part=part if parts is None else (0, parts),
            save_every=scenario.save_every,
        )
        if needed > _NOTED:
            show(f"  about {_checks.spoken_size(needed)} of memory")
    options = {"save_every": scenario.save_every} if scenario.save_at is None else {"save_at": scenario.save_at}
    options |= {"own_step": not makes_own, "members": scenario.members if makes_own else None}
    options["epoch"] = scenario.date_of_zero()
    options["same_bits"] = same_bits
    if executor is None:
        integrate = partial(runs.run, mesh=mesh, resume=resume, part=part)
    else:
        integrate = partial(runs.submit, parts=count, executor=executor)
    integrate = partial(integrate, step, states, **scenario.clock(), **options)
    in_store = out.suffix == ".zarr"
    if in_store:
        description = {"title": scenario.title, "seed": scenario.seed, "scenario": scenario.model_dump()}
        integrate = partial(integrate, store=runs.StoreOptions(out, description, scenario.time_unit))
    try:
        run = integrate()
    except KeyboardInterrupt as stop:
        if not in_store:
            raise
        again = "the same command" if part or parts else "the same command with --resume"
        raise KeyboardInterrupt(f"{stop}: {again}" if stop.args else "") from None
    show_time("the run")
    if part is not None and part[1] > 1:
        show(f"part {part[0]} of {part[1]} is complete in {out}; lieint info {out} lists the missing parts")
        return
    if not leader:
        return
    own = {} if in_store else scenarios.members_numbers(scenario)
    if isinstance(out, Url) or in_store:
        show(info.contents(out, own=_of_own_kind(scenario)))
    else:
        description = {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__}
        archives.write_trajectory(out, run.trajectory, description, own)
    for path in exports:
        export.write(path, run, scenario)
    if isinstance(out, Url) or in_store:
        show_written(out, *exports, about=f"{files.megabytes(out)}; lieint plot {out} reports on it and draws it")
        return
    if scenario.save_at is not None:
        _report_outputs(out, pictures, scenario)
        return
    doing = " and ".join(["drawing"] * pictures + ["certifying"] * certificate)
    show(f"  results in {out}{f'; {doing} …' if doing else ''}")
    drawn = info.draw(out, drawings, scenario, run)
    show_time("results and pictures")
    show(readable(scenario).report(run))
    show_time("the report")
    if certificate:
        _certify(scenario, run)
    converged = int(np.asarray(run.info.converged).all(axis=0).sum())
    all_converged = converged == scenario.members
    show(f"  {converged} of {scenario.members} members converged at every step", error=not all_converged)
    arrays = ", ".join(["t, q, p, residual, converged, metadata", *(f"member.{name}" for name in own)])
    show_written(out, *drawn, *exports, about=f"{arrays}; {files.megabytes(out)}")


def _certify(scenario: Kind, run: runs.Run) -> None:
    watched = min(scenario.steps, _WATCHED)
    show(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
    show(certify(run.member(0).step, nominal_state(run), scenario.dt, watched))
    show_time("the certificate")


def _of_own_kind(scenario: Kind) -> Kind | None:
    """The scenario, if its kind is a user's, which results do not name; else None."""
    return None if scenario.system in scenarios.kind_names() else scenario


def _report_outputs(out: Path, pictures: bool, scenario: Kind) -> None:
    """Report on a run with given output times; the report and pictures of its scenario require evenly spaced ones."""
    own = _of_own_kind(scenario)
    if pictures:
        info.plot(out, own=own)
    else:
        show(info.contents(out, own=own))
        show_written(out, about=files.megabytes(out))


def _entries(scenario: Kind) -> int:
    """The number of saved entries, including the initial one."""
    return (scenario.steps // scenario.save_every if scenario.save_at is None else len(scenario.save_at)) + 1


def _check_size(scenario: Kind, out: Address, parts: int) -> None:
    """Raise ValueError, before the members are built, if a large run exceeds the memory of this machine.

    Of `parts` of the run, this process makes one.
    """
    entries, members = _entries(scenario), -(-scenario.members // parts)
    if members * entries < _LARGE:
        return
    state = scenario.model_copy(update={"members": 1}).build()[1]
    size, stored = members * _checks.entry_size(state), out.suffix == ".zarr"
    less = "" if stored else ", a larger save_every or --out NAME.zarr"
    _checks.fits_memory(1 if stored else entries, size, f"give fewer members{less}")
