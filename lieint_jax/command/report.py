"""The commands `run`, `info`, `plot` and `check`: they print reports and certificates and write results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import _discover, ensemble, scenarios, schemes, systems
from lieint_jax._version import __version__
from lieint_jax.command import by_group, files
from lieint_jax.diagnostics import certify
from lieint_jax.scenarios._common import Common, nominal
from lieint_jax.types import State, Step, Trajectory

_SHOWN = 2**28  # the most bytes of a store that are read to draw it
_TIMES, _BLOCK = 17, 8192  # saved times at which energies are measured, and members at once


def run(
    name: str,
    out: Path | None,
    members: int | None = None,
    steps: int | None = None,
    devices: int | None = None,
    resume: bool = False,
) -> None:
    """Integrate a scenario and write the results; for an .npz, also print the report and draw pictures."""
    scenario = scenarios.load(name, members=members, steps=steps)
    kind = scenarios.kind(scenario)
    if out is None:
        file = Path(Path(name).stem).with_suffix(".zarr" if resume else ".npz")
        out = file if resume else files.unused(file, kind.PICTURES)
    out = files.free(out, kind.PICTURES, resume)
    leader = jax.process_index() == 0
    mesh = ensemble.first_devices(devices)
    step, states = kind.build(scenario)
    if leader:
        print(_headline(scenario, step), flush=True)
    integrate = partial(
        ensemble.run, step, states, scenario.dt, scenario.steps, scenario.save_every, mesh=mesh, resume=resume
    )
    if out.suffix == ".zarr":
        description = {"title": scenario.title, "seed": scenario.seed, "scenario": scenario.model_dump()}
        try:
            integrate(store=ensemble.StoreOptions(out, description, scenario.time_unit))
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(f"{stop}: the same command with --resume" if stop.args else "") from None
        if leader:
            print(f"{_contents(out)}\n\nwritten: {out} ({files.megabytes(out)}); lieint plot {out} reports and draws")
        return
    run = integrate()
    if not leader:
        return
    files.save(out, run, {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__})
    print(f"  results in {out}; drawing and certifying …", flush=True)
    drawn = _draw(kind, out, scenario, step, run)
    print(kind.report(scenario, step, run))
    watched = min(scenario.steps, 10_000)
    print(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
    print(certify(step, nominal(run), scenario.dt, watched))
    well = int(np.asarray(run.info.converged).all(axis=0).sum())
    print(f"  {well} of {scenario.members} members converged at every step")
    print(f"\nwritten: {out} (t, q, p, residual, converged, metadata; {files.megabytes(out)}){drawn}")


def info(path: Path) -> None:
    """Describe a file of results."""
    print(_contents(path))


def plot(path: Path) -> None:
    """Report on a file of results, and draw the pictures of its scenario beside it, from its first members."""
    run, metadata = files.load(path)
    if "scenario" not in metadata or not isinstance(run, Trajectory):
        raise ValueError(f"{path} holds no trajectories of a scenario: there is no picture for it")
    if len(run.t) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to draw yet")
    scenario = scenarios.parse(metadata["scenario"], str(path))
    kind = scenarios.kind(scenario)
    for picture in files.pictures(path, kind.PICTURES):
        if picture.exists():
            raise ValueError(f"{picture} exists and is not overwritten; move it away")
    step, _ = kind.build(scenario.model_copy(update={"members": 1}))
    each = sum(x[:, 0].nbytes for x in run.state)
    shown = max(1, min(_SHOWN // each, run.state.p.shape[1]))
    run = Trajectory(run.t, *jax.tree.map(lambda x: x[:, :shown], (run.state, run.info)))
    scenario = scenario.model_copy(update={"steps": (len(run.t) - 1) * scenario.save_every, "members": shown})
    print(_headline(scenario, step))
    if shown < metadata["scenario"]["members"]:
        print(f"  the first {shown} of {metadata['scenario']['members']} members")
    drawn = _draw(kind, path, scenario, step, run)
    print(f"{kind.report(scenario, step, run)}\n\nwritten: {drawn.removeprefix(', ')}")


def _draw(kind: Any, path: Path, scenario: Common, step: Step, run: Trajectory) -> str:
    """Write the pictures; return their names, each after a comma."""
    drawn = files.pictures(path, kind.PICTURES)
    for file, draw in zip(drawn, kind.PICTURES.values(), strict=True):
        draw(scenario, step, run).savefig(file, dpi=160)
    return "".join(f", {file}" for file in drawn)


def _contents(path: Path) -> str:
    """A description of a file of results, in lines."""
    run, metadata = files.load(path)
    scenario = scenarios.parse(metadata["scenario"], str(path)) if "scenario" in metadata else None
    series = not isinstance(run, Trajectory)
    t = run["time"] if series else run.t
    lines = [str(metadata.get("title") or (scenario.title if scenario else path))]
    progress = metadata.get("progress")
    if progress:
        members, planned = metadata["members"], metadata["num_steps"]
        lines.append(
            f"  {metadata['scheme']} · {metadata['system']}, {members} member(s), {planned} steps of "
            f"{metadata['dt']:.6g}"
        )
        state = "complete" if progress["complete"] else f"{progress['steps']} of {planned} steps; --resume goes on"
        lines.append(f"  {state}: {len(t)} of {planned // metadata['save_every'] + 1} entries")
        versions = ", ".join(f"{name} {version}" for name, version in metadata["run"]["versions"].items())
        lines.append(f"  written by {versions} on {metadata['run']['device']}, {metadata['run']['compiler_options']}")
    else:
        lines.append(f"  {run.state.p.shape[1]} member(s), {len(t)} entries; lieint_jax {metadata['lieint_jax']}")
    if len(t):
        lines.append(f"  t = {t[0]:.6g} … {t[-1]:.6g}")
    if series:
        if len(t):
            kinds = ("least", "greatest", "mean")
            lines += [
                f"  {name} change: {getattr(np, f'nan{pick}')(run[name]):.3g}"
                for name, pick in zip(kinds, ("min", "max", "mean"), strict=True)
            ]
            lines.append(
                f"  largest residual {run['residual'].max():.2g}; unconverged members {run['unconverged'].max()}"
            )
        return "\n".join(lines)
    if scenario and len(t) > 1:
        lines.append(_kept(scenarios.kind(scenario).build(scenario.model_copy(update={"members": 1}))[0], run))
    return "\n".join(lines)


def _kept(step: Step, run: Trajectory) -> str:
    """Two lines: the largest change of energy at `_TIMES` saved times, and how many members converged."""
    count, energies = run.state.p.shape[1], jax.jit(jax.vmap(jax.vmap(step.system.energy)))
    times = np.unique(np.linspace(0, len(run.t) - 1, _TIMES).astype(int))
    worst = size = failed = 0.0
    for first in range(0, count, _BLOCK):
        part = slice(first, first + _BLOCK)
        states = State(*(jnp.asarray(np.stack([x[k, part] for k in times])) for x in run.state))
        H = np.asarray(energies(states))
        worst, size = max(worst, float(abs(H - H[0]).max())), max(size, float(abs(H[0]).max()))
        failed += int((~np.asarray(run.info.converged[:, part])).any(axis=0).sum())
    relative = f" ({worst / size:.2g} of the largest energy)" if size else ""
    return (
        f"  largest change of energy, all members, {len(times)} times: {worst:.2g}{relative}\n"
        f"  {int(count - failed)} of {count} members converged at every step"
    )


def check(system: str, scheme: str, num_steps: int | None) -> None:
    """Print the certificate of every example of every system with every scheme that takes it, or those of a group."""
    if system == "groups":
        for line in by_group.table():
            print(line, flush=True)
        return
    group = by_group.named(system)
    if group is not None:
        print(by_group.certificates(group, scheme, num_steps))
        return
    found = False
    num_steps = num_steps or 1000
    for module_name, module in _discover.modules(systems).items():
        for name, (body, state, dt) in module.examples().items():
            if system not in ("", module_name, name, f"{module_name}.{name}"):
                continue
            for scheme_module in _discover.modules(schemes).values():
                for step_name, step in scheme_module.examples(body).items():
                    if scheme in step_name:
                        found = True
                        print(f"{module_name}.{name}\n{certify(step, state, dt, num_steps)}\n")
    if not found:
        known = [f"{n} ({', '.join(m.examples())})" for n, m in _discover.modules(systems).items()]
        raise ValueError(
            f"nothing to check for system {system!r} and scheme {scheme!r}; systems: {'; '.join(known)}; groups: "
            f"{', '.join(by_group.catalogue())}"
        )


def _headline(scenario: Common, step: Step) -> str:
    unit, span = scenario.time_unit, scenario.dt * scenario.steps
    lines = [
        scenario.title,
        f"  {scenario.members} member(s), {scenario.steps} steps of {scenario.dt:.6g} {unit} = {span:.6g} {unit}, "
        f"{step.name}",
    ]
    if scenario.members > 1 and scenario.assumption():
        lines.append(f"  {scenario.assumption()}")
    return "\n".join(lines)
