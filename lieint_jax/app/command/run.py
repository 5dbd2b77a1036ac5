"""The command `run`: it integrates a scenario, reports and writes results."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import numpy as np

from lieint_jax import _checks, ensemble
from lieint_jax._version import __version__
from lieint_jax.app import scenarios
from lieint_jax.app.command import files, info
from lieint_jax.app.scenarios._common import Common
from lieint_jax.app.scenarios._runs import nominal
from lieint_jax.diagnostics import certify
from lieint_jax.ensemble.archives import Address, Url

_NOTED = 10**8  # bytes of memory from which on they are printed
_WATCHED = 10_000  # the most steps of a certificate
_LARGE = 10**7  # entries of members, from which on a run's size is looked at before its members are made


def run(
    name: str,
    out: Address | None,
    members: int | None = None,
    steps: int | None = None,
    devices: int | None = None,
    resume: bool = False,
    save_at: Path | None = None,
    *,
    certificate: bool = True,
    pictures: bool = True,
    part: tuple[int, int] | None = None,
) -> None:
    """Integrate a scenario and write the results; for an .npz, also print the report.

    Args:
        name: a shipped scenario or a file.
        out: where results are written, NAME.npz or NAME.zarr, the latter also by a URL; by default after the scenario.
        members, steps, save_at: in place of the scenario's.
        devices: how many to use.
        resume: continue the run in a NAME.zarr.
        certificate: measure what the scheme conserves along the nominal member; of an .npz.
        pictures: draw the run; of an .npz.
        part: (k, n), one of n independent processes that write one NAME.zarr.
    """
    if part is not None:
        resume = True  # a part goes on by itself
    scenario = scenarios.load(name, members=members, steps=steps, save_at=save_at and files.numbers(save_at))
    kind = scenarios.kind(scenario)
    drawings = kind.PICTURES if pictures else {}
    certificate = certificate and getattr(kind, "CERTIFIED", True)
    if out is None:
        file = Path(Path(name).stem).with_suffix(".zarr" if resume else ".npz")
        out = file if resume else files.unused(file, lambda path: files.pictures(path, drawings))
    out = files.free(out, drawings, resume)
    _check_size(scenario, out)
    leader = jax.process_index() == 0
    mesh = ensemble.first_devices(devices)
    step, states = kind.build(scenario)
    if leader:
        print(info.headline(scenario, step), flush=True)
        needed = ensemble.peak_memory(
            states,
            _entries(scenario),
            store=out if out.suffix == ".zarr" else None,
            part=part,
            save_every=scenario.save_every,
        )
        if needed > _NOTED:
            print(f"  about {_checks.spoken_size(needed)} of memory", flush=True)
    kept = {"save_every": scenario.save_every} if scenario.save_at is None else {"save_at": scenario.save_at}
    kept["step_axis"] = scenarios.step_axis(scenario)
    integrate = partial(ensemble.run, step, states, **scenario.clock(), mesh=mesh, resume=resume, part=part, **kept)
    if out.suffix == ".zarr":
        description = {"title": scenario.title, "seed": scenario.seed, "scenario": scenario.model_dump()}
        try:
            integrate(store=ensemble.StoreOptions(out, description, scenario.time_unit))
        except KeyboardInterrupt as stop:
            again = "the same command" if part else "the same command with --resume"
            raise KeyboardInterrupt(f"{stop}: {again}" if stop.args else "") from None
        if part is not None and part[1] > 1:
            print(f"part {part[0]} of {part[1]} is complete in {out}; lieint info {out} names the parts that are not")
        elif leader:
            print(info.contents(out))
            print(f"\nwritten: {out} ({files.megabytes(out)}); lieint plot {out} reports and draws")
        return
    run = integrate()
    if not leader:
        return
    assert not isinstance(out, Url)  # whose suffix is .zarr
    description = {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__}
    own = scenarios.members_numbers(scenario)
    files.save(out, run, description, own)
    if scenario.save_at is not None:
        _report_outputs(out, pictures)
        return
    doing = " and ".join(["drawing"] * pictures + ["certifying"] * certificate)
    print(f"  results in {out}{f'; {doing} …' if doing else ''}", flush=True)
    drawn = info.draw(out, drawings, scenario, step, run)
    print(scenarios.report(scenario, step, run))
    if certificate:
        first = step if kept["step_axis"] is None else jax.tree.map(lambda leaf: leaf[0], step)
        watched = min(scenario.steps, _WATCHED)
        print(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
        print(certify(first, nominal(run), scenario.dt, watched))
    well = int(np.asarray(run.info.converged).all(axis=0).sum())
    print(f"  {well} of {scenario.members} members converged at every step")
    arrays = ", ".join(["t, q, p, residual, converged, metadata", *(f"member.{name}" for name in own)])
    written = [f"{out} ({arrays}; {files.megabytes(out)})", *map(str, drawn)]
    print(f"\nwritten: {', '.join(written)}")


def _report_outputs(out: Path, pictures: bool) -> None:
    """Report on a run with output times, whose scenario's own report and pictures need evenly spaced ones."""
    if pictures:
        info.plot(out)
    else:
        print(f"{info.contents(out)}\n\nwritten: {out} ({files.megabytes(out)})")


def _entries(scenario: Common) -> int:
    """The number of saved entries, that of the start included."""
    return (scenario.steps // scenario.save_every if scenario.save_at is None else len(scenario.save_at)) + 1


def _check_size(scenario: Common, out: Address) -> None:
    """ValueError if a large run has more bytes than this machine's memory, before its members are made."""
    entries = _entries(scenario)
    if scenario.members * entries < _LARGE:
        return
    state = scenarios.build(scenario.model_copy(update={"members": 1}))[1]
    size, stored = scenario.members * _checks.entry_size(state), out.suffix == ".zarr"
    less = "" if stored else ", a larger save_every or --out NAME.zarr"
    _checks.fits_memory(1 if stored else entries, size, f"give fewer members{less}")
