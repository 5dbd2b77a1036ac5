"""The older names of `li.run` and `li.open`, and what runs of many processes and machines need.

`run` and `open` return the arrays of a run, a `Trajectory` or a `Summary`, without its step; `li.run` and `li.open`
return a `li.Run`, which answers questions. `archives` reads files of results one array at a time. `over_members`
applies any function of one member to all members, over all devices; `count_cores` returns the number of cores that this
process may use, `part_of_task` the part of this task in a job array, `part_of_text` that of an option K/N or auto;
`peak_memory` the memory of a run, beforehand.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from jax.sharding import Mesh
from numpy.typing import ArrayLike

from lieint_jax.runs import (
    MakeStates,
    Reduction,
    Summary,
    compiler_options,
    compute,
    count_cores,
    energy,
    first_devices,
    over_members,
    part_of_task,
    part_of_text,
    peak_memory,
    processes,
    untransformed,
    want_devices,
)
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import StoreOptions
from lieint_jax.runs.store import open_run as open  # noqa: A004
from lieint_jax.types import State, Step

__all__ = [
    "StoreOptions",
    "Summary",
    "archives",
    "compiler_options",
    "count_cores",
    "energy",
    "first_devices",
    "open",
    "over_members",
    "part_of_task",
    "part_of_text",
    "peak_memory",
    "processes",
    "run",
    "want_devices",
]


@untransformed("ensemble.run")
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    save_every: int | None = None,
    step_axis: int | None = None,
    *,
    reduce: Reduction | Literal["energy"] | None = None,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
) -> Any:
    """The results of `li.run` for a batch, a `Trajectory` or a `Summary`; by default its last states only.

    Arguments, errors and warnings are those of `li.run`, with `step_axis=0` for its `own_step=True`. States always have
    the member axis.

    Returns:
        A `Trajectory` of numpy arrays, axes (time, member, …), the initial states first; with `store`, of Zarr arrays,
        which are read from disk when they are indexed. With `reduce`, a `Summary`. With `part`, the results of the
        members of that part; `ensemble.open` returns those of all. Its t is t₀ + nΔt, where t₀ is the
        shared time of the members. If they have no time or start at different times, t is the time since the start. If
        the step has its `own_time`, t is nΔt, and state.t the time of each member.
    """
    _, saves, *_ = compute(
        step,
        states,
        dt,
        num_steps,
        save_every=save_every,
        step_axis=step_axis,
        reduce=reduce,
        mesh=mesh,
        store=store,
        progress=progress,
        resume=resume,
        times=times,
        save_at=save_at,
        part=part,
        members=members,
    )
    return saves.found
