"""Machine code compared with XLA's program for a first step of a few members, before it computes a run.

Machine code is this package's own reading of a jaxpr. A misread primitive would be a wrong number without a sign of it,
so each compiled function is compared once, on the data of its first run.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lieint_jax.runs._job import Job
from lieint_jax.runs._layout import on_host

_FEW = 3  # members that are compared
_CHANGE = 8  # round-offs by which a copy of each of them differs
_LEEWAY = 1000  # times that the results of a copy may differ: machine code rounds in another order
_ROUNDING = ("residual",)  # results that are nothing but rounding errors


def few_members(job: Job) -> Job:
    """The job of a few members and of a copy of each of them that differs by rounding."""
    chosen = np.unique(np.linspace(0, job.members - 1, _FEW).astype(int))

    def take(x: Any) -> Any:
        return on_host(x)[np.tile(chosen, 2)]

    def changed(x: Any) -> np.ndarray:
        x, n = take(x), len(chosen)
        if x.dtype.kind == "f":
            largest = np.abs(x[n:]).max(axis=tuple(range(1, x.ndim)), keepdims=True, initial=0)
            pattern = np.cos(1.0 + np.arange(x[n:].size)).reshape(x[n:].shape)
            x[n:] += (_CHANGE * np.finfo(x.dtype).eps * largest * pattern).astype(x.dtype)
        return x

    t0 = job.t0 if job.t0 is None or job.shares_time else take(job.t0)
    step = job.step if job.step_axis is None else jax.tree.map(take, job.step)
    return job._replace(step=step, states=jax.tree.map(changed, job.states), t0=t0, make_states=None, part=None)


def difference(ours: Any, theirs: Any) -> str:
    """The first result in which machine code for the members of `few_members` differs from XLA's program; or "".

    It differs if a change of the states by rounding does not explain it.
    """
    n = len(jax.tree.leaves(ours)[0]) // 2
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        name, x = jax.tree_util.keystr(path), np.asarray(x)
        if not name.endswith(_ROUNDING) and not _agree(x[:n], y[:n], y[n:]):
            return f"in machine code a first step differs in {name}"
    return ""


def _agree(ours: np.ndarray, theirs: np.ndarray, changed: np.ndarray) -> bool:
    """Whether results (members, …) agree, given XLA's for the states of `theirs` changed by rounding."""
    if theirs.dtype.kind != "f":
        return bool(np.all((ours == theirs) | (theirs != changed)))
    axes = tuple(range(1, theirs.ndim))
    with np.errstate(invalid="ignore"):
        differs, spread = np.abs(ours - theirs), np.abs(changed - theirs)
        undecided = ~np.isfinite(spread) & (theirs != changed) & ~(np.isnan(theirs) & np.isnan(changed))
        same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs)) | undecided
    size, rounding = (np.max(np.where(np.isfinite(x), x, 0), axis=axes, initial=0) for x in (np.abs(theirs), spread))
    allowed = np.sqrt(np.finfo(theirs.dtype).eps) * size + _LEEWAY * rounding
    return bool(np.all(same | (allowed >= differs.T).T))
