"""What the commands print and write: a scenario's results, certificates."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import jax
import numpy as np

from lieint_jax import __version__, discover, ensemble, scenarios, schemes, store, systems
from lieint_jax.diagnostics import by_group, certify
from lieint_jax.scenarios._common import Common, nominal
from lieint_jax.types import Step


def run(name: str, out: Path | None, members: int | None = None, steps: int | None = None) -> None:
    """Integrate a scenario, print the report, write results and pictures."""
    scenario = scenarios.load(name, members=members, steps=steps)
    kind = scenarios.kind(scenario)
    out = store.free(out or _unused(Path(Path(name).stem).with_suffix(".npz"), kind.PICTURES), kind.PICTURES)
    step, states = kind.build(scenario)
    print(_headline(scenario, step))
    run = ensemble.run(step, states, scenario.dt, scenario.steps, scenario.save_every)
    store.save(out, run, {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__})
    print(f"  results in {out}; drawing and certifying …", flush=True)
    pictures = store.pictures(out, kind.PICTURES)
    for picture, draw in zip(pictures, kind.PICTURES.values(), strict=True):
        draw(scenario, step, run).savefig(picture, dpi=160)
    print(kind.report(scenario, step, run))
    watched = min(scenario.steps, 10_000)
    print(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
    print(certify(step, nominal(run), scenario.dt, watched))
    well = int(np.asarray(run.info.converged).all(axis=0).sum())
    print(f"  {well} of {scenario.members} members converged at every step")
    drawn = "".join(f", {picture}" for picture in pictures)
    print(f"\nwritten: {out} (t, q, p, residual, converged, metadata; {_megabytes(out)}){drawn}")


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
    for module_name, module in discover.modules(systems).items():
        for name, (body, state, dt) in module.examples().items():
            if system not in ("", module_name, name, f"{module_name}.{name}"):
                continue
            for scheme_module in discover.modules(schemes).values():
                for step_name, step in scheme_module.examples(body).items():
                    if scheme in step_name:
                        found = True
                        print(f"{module_name}.{name}\n{certify(step, state, dt, num_steps)}\n")
    if not found:
        known = [f"{n} ({', '.join(m.examples())})" for n, m in discover.modules(systems).items()]
        raise ValueError(
            f"nothing to check for system {system!r} and scheme {scheme!r}; systems: {'; '.join(known)}; groups: "
            f"{', '.join(by_group.catalogue())}"
        )


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.3g} MB"


def _unused(path: Path, pictures: Iterable[str]) -> Path:
    """`path`, or the first of path-2, path-3, … that does not exist."""
    candidate, k = path, 1
    while any(file.exists() for file in (candidate, *store.pictures(candidate, pictures))):
        k += 1
        candidate = path.with_stem(f"{path.stem}-{k}")
    return candidate


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
