"""The command `run`: it integrates a scenario, reports and writes results."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import numpy as np

from lieint_jax import ensemble, scenarios
from lieint_jax._version import __version__
from lieint_jax.command import files, results
from lieint_jax.diagnostics import certify
from lieint_jax.scenarios._common import nominal


def run(
    name: str,
    out: Path | None,
    members: int | None = None,
    steps: int | None = None,
    devices: int | None = None,
    resume: bool = False,
    save_at: Path | None = None,
) -> None:
    """Integrate a scenario and write the results; for an .npz, also print the report and draw pictures."""
    scenario = scenarios.load(name, members=members, steps=steps, save_at=save_at and files.numbers(save_at))
    kind = scenarios.kind(scenario)
    if out is None:
        file = Path(Path(name).stem).with_suffix(".zarr" if resume else ".npz")
        out = file if resume else files.unused(file, lambda path: files.pictures(path, kind.PICTURES))
    out = files.free(out, kind.PICTURES, resume)
    leader = jax.process_index() == 0
    mesh = ensemble.first_devices(devices)
    step, states = kind.build(scenario)
    if leader:
        print(results.headline(scenario, step), flush=True)
    kept = {"save_every": scenario.save_every} if scenario.save_at is None else {"save_at": scenario.save_at}
    kept["step_axis"] = scenarios.step_axis(scenario)
    integrate = partial(ensemble.run, step, states, **scenario.clock(), mesh=mesh, resume=resume, **kept)
    if out.suffix == ".zarr":
        description = {"title": scenario.title, "seed": scenario.seed, "scenario": scenario.model_dump()}
        try:
            integrate(store=ensemble.StoreOptions(out, description, scenario.time_unit))
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(f"{stop}: the same command with --resume" if stop.args else "") from None
        if leader:
            print(results.contents(out))
            print(f"\nwritten: {out} ({files.megabytes(out)}); lieint plot {out} reports and draws")
        return
    run = integrate()
    if not leader:
        return
    files.save(out, run, {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__})
    if scenario.save_at is not None:
        results.plot(out)
        return
    print(f"  results in {out}; drawing and certifying …", flush=True)
    drawn = results.draw(out, kind.PICTURES, scenario, step, run)
    print(kind.report(scenario, step, run))
    watched = min(scenario.steps, 10_000)
    print(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
    first = step if kept["step_axis"] is None else jax.tree.map(lambda leaf: leaf[0], step)
    print(certify(first, nominal(run), scenario.dt, watched))
    well = int(np.asarray(run.info.converged).all(axis=0).sum())
    print(f"  {well} of {scenario.members} members converged at every step")
    written = [f"{out} (t, q, p, residual, converged, metadata; {files.megabytes(out)})", *map(str, drawn)]
    print(f"\nwritten: {', '.join(written)}")
