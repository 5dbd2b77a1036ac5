"""What a run is, in a few lines of text."""

from __future__ import annotations

from typing import Any

import numpy as np

from lieint_jax.runs._job import list_members
from lieint_jax.runs.store._store import leaves_by_name


def lines(run: Any) -> dict[str, str]:
    """What a run is, by words for a table."""
    facts, t = run.facts, run.t
    how = "at given times" if facts.save_every is None else f"every {facts.save_every} steps"
    sizes = "of given sizes" if facts.dt is None else f"of {facts.dt:g}"
    lines = {"step": f"{run.step.name} of {type(run.system).__name__}{' (one for each member)' * run.own_step}"}
    if run.members is not None:
        lines["members"] = f"{run.members}"
    lines["times"] = f"{float(t[0]):.6g} … {float(t[-1]):.6g}: {len(t)} saves {how} of {facts.num_steps}, {sizes}"
    state = run.state if run.summary is None else run.summary.state
    leading = (1 if run.summary is None else 0) + facts.batch
    shapes = {name: np.shape(x)[leading:] for name, x in leaves_by_name(state).items()}
    lines["states"] = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    if run.summary is not None:
        lines["reduced"] = "least, greatest and mean change in each save interval, over all members"
    failed = np.atleast_1d(np.asarray(run.failed))
    bad = np.flatnonzero(failed >= 0)
    lines["converged"] = "all"
    if bad.size:
        first = bad[failed[bad].argmin()]
        lines["converged"] = f"not {list_members(bad)}; member {first} first, at step {failed[first]}"
    versions = ", ".join(f"{name} {version}" for name, version in facts.versions if name != "jaxlib")
    lines["computed"] = f"by {facts.engine}, {versions}{'' if facts.complete else '; not complete'}"
    if facts.source:
        lines["store"] = facts.source
    return lines
