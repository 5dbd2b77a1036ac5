"""Which part of a run a task of a job array integrates, from the variables that its scheduler sets."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from lieint_jax._checks import integer


class _Scheduler(NamedTuple):
    """The variables of a scheduler: the task's index; the number of tasks, or the last index; the first; the stride."""

    name: str
    task: str
    tasks: str | None = None
    last: str | None = None
    first: str | int = 0
    stride: str | None = None


SCHEDULERS = (
    _Scheduler(
        "SLURM",
        "SLURM_ARRAY_TASK_ID",
        tasks="SLURM_ARRAY_TASK_COUNT",
        first="SLURM_ARRAY_TASK_MIN",
        stride="SLURM_ARRAY_TASK_STEP",
    ),
    _Scheduler("AWS Batch", "AWS_BATCH_JOB_ARRAY_INDEX", tasks="AWS_BATCH_JOB_ARRAY_SIZE"),
    _Scheduler("Kubernetes", "JOB_COMPLETION_INDEX"),
    _Scheduler("Google Batch", "BATCH_TASK_INDEX", tasks="BATCH_TASK_COUNT"),
    _Scheduler("Cloud Run", "CLOUD_RUN_TASK_INDEX", tasks="CLOUD_RUN_TASK_COUNT"),
    _Scheduler("Grid Engine", "SGE_TASK_ID", last="SGE_TASK_LAST", first="SGE_TASK_FIRST", stride="SGE_TASK_STEPSIZE"),
    _Scheduler("LSF", "LSB_JOBINDEX", last="LSB_JOBINDEX_END", first=1),
    _Scheduler("PBS", "PBS_ARRAY_INDEX"),
    _Scheduler("GNU parallel", "PARALLEL_SEQ", first=1),
)


def part_of_task(count: int | None = None, environment: Mapping[str, str] = os.environ) -> tuple[int, int]:
    """The part (k, n) of this task in an array of tasks of SLURM, AWS Batch, Kubernetes and other schedulers.

    k is the task's index less the first index of the array. If only some tasks of a SLURM array are submitted again, k
    and n are those of the new array: submit all of them (those that are complete end at once), or give k and n.

    Args:
        count: n, for a scheduler that does not report the number of tasks (Kubernetes, PBS, GNU parallel).
        environment: the variables.

    Raises:
        ValueError: there is no such array, or its number of tasks is unknown.
    """
    for scheduler in SCHEDULERS:
        index = _number(environment, scheduler.task)
        if index is None:
            continue
        first = scheduler.first if isinstance(scheduler.first, int) else _number(environment, scheduler.first) or 0
        stride = (scheduler.stride and _number(environment, scheduler.stride)) or 1
        last = scheduler.last and _number(environment, scheduler.last)
        reported = (scheduler.tasks and _number(environment, scheduler.tasks)) or (
            (last - first) // stride + 1 if isinstance(last, int) else None
        )
        if count is None and reported is None:
            raise ValueError(
                f"{scheduler.name} does not report the number of tasks to a task: give part=li.part_of_task(8)"
            )
        return checked_part(((index - first) // stride, count or reported or 1))
    raise ValueError(
        f"there is no array of tasks: none of {', '.join(s.task for s in SCHEDULERS)} is set. Give the part, as in "
        "part=(3, 8)"
    )


def checked_part(part: tuple[int, int]) -> tuple[int, int]:
    """`part`, checked to be (k, n) with 0 ≤ k < n."""
    try:
        k, count = map(integer, part)
    except (TypeError, ValueError):
        k = count = None
    if k is None or count is None or not 0 <= k < count:
        raise ValueError(f"part must be (k, n), part k = 0 … n − 1 of n, got {part!r}")
    return k, count


def _number(environment: Mapping[str, str], name: str) -> int | None:
    """The number in a variable; None if there is none (Grid Engine sets "undefined")."""
    text = environment.get(name, "")
    return int(text) if text.isdigit() else None
