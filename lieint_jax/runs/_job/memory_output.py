"""The rows of a run, and the output that keeps them in memory."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax.runs._job import devices, loop
from lieint_jax.runs._job.devices import Tree
from lieint_jax.runs._job.dyadic_sum import block_sums, blocks, total
from lieint_jax.runs._job.job import Job, MemberSummary, Series, Summary
from lieint_jax.runs._job.loop import Carry
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.types import StepInfo, Trajectory


def first_rows(job: Job, carry: Carry) -> Tree | Series:
    """The entry of the start: a row (1, members) of the report and the states, or that of the series of a reduction."""
    if job.reduction is None:
        return jax.tree.map(lambda x: np.asarray(x)[None], (carry.info, carry.state))
    found: Series = dict.fromkeys(job.series_names, np.zeros(1, job.dtype)) | {"unconverged": np.zeros(1, np.int64)}
    if job.part is not None and not job.per_member:
        found["sums"] = np.zeros((1, len(blocks(job.part.start, job.part.stop))), job.dtype)
    return found


def rows_and_carry(job: Job, saves: Saves) -> tuple[Tree | Series, Carry]:
    """The rows of a run in memory, that of the start first, and the carry at its end."""
    found, failed = saves.found, saves.failed
    states, change = found.state if job.t0 is None else found.state._replace(t=None), None
    if isinstance(found, Trajectory):
        rows: Tree = found.info, states
        states = jax.tree.map(lambda x: x[-1], states)
    else:
        rows = {name: np.asarray(found._asdict()[name]) for name in job.series_names}
        change = found.change if isinstance(found, MemberSummary) else job.first_change(failed, None)
    return rows, loop.start(states, change)._replace(failed=failed.astype(loop.step_dtype()))


def reduce_rows(rows: Tree, number: int, job: Job) -> Series:
    """Reduce the first `number` rows (saves, members) to series (saves,), of the same bits however the run is split.

    For a part, "sums" (saves, blocks) are the sums from which the mean of the whole run is computed.
    """
    info, change = _rows(rows, number, job)
    reports = {
        "residual": info.residual.max(axis=1),
        "unconverged": (~np.asarray(info.converged)).sum(axis=1),
    }
    if change.per_member:
        return reports  # pyright: ignore[reportReturnType]
    sums = block_sums(np.asarray(change.total), job.first_member)
    members = range(job.first_member, job.first_member + job.members)
    found = {
        "least": change.least.min(axis=1),
        "greatest": change.greatest.max(axis=1),
        "mean": total([(members, sums)]) / (job.members * (job.save_every or 1)),
        **reports,
    }
    return found if job.part is None else found | {"sums": sums}  # pyright: ignore[reportReturnType]


def _rows(saved: Tree, number: int, job: Job) -> Tree:
    """The first `number` saved rows of the members of a job, on the host."""
    return devices.without_padding(jax.tree.map(lambda x: np.asarray(x)[:number], saved), job.members, 1)


class MemoryOutput:
    """Results as numpy arrays; `earlier` are those of a run of which this one is the continuation.

    `StoreOutput` has the same methods.

    Attributes:
        defers_interrupts: whether an interrupt waits until the run `can_stop`.
        buffer_rows: the largest number of saves in one call of the compiled loop: the length of its buffer.
        free_rows: the largest number of saves in the next call.
    """

    defers_interrupts = False

    def __init__(self, job: Job, mesh: Mesh, earlier: Saves | None = None) -> None:
        self._job, self._mesh, self._entries, self._earlier = job, mesh, 0, earlier
        self.buffer_rows = self.free_rows = job.buffer_rows(job.members)
        self._out: Any = None  # rows of all entries, or series

    def restore(self) -> tuple[Carry, int, int] | None:
        """The carry and the numbers of steps and of saves of the unfinished run in this output, or None."""
        if self._earlier is None:
            return None
        found = self._earlier.found
        rows, carry = rows_and_carry(self._job, self._earlier)
        saved = len(found.t) - 1
        done = int(self._job.nodes[saved])
        if isinstance(found, MemberSummary):  # whose one interval goes on
            done, saved = int(found.number) - 1, 0
            rows = first_rows(self._job, carry)
            carry = carry._replace(
                info=StepInfo(np.full(carry.failed.shape, found.residual[-1]), carry.failed < 0)  # pyright: ignore
            )
        self._put(rows)
        return devices.placed(self._mesh, carry), done, saved

    def append(self, saved: Tree | Series, number: int) -> None:
        """Receive `number` saved rows, or those of the series of a reduction; that of the start first."""
        self._put(saved if isinstance(saved, dict) else _rows(saved, number, self._job))

    def _put(self, rows: Tree | Series) -> None:
        """Copy rows to the arrays of all entries, which the first of them make."""
        if self._out is None:
            entries = self._job.num_saves + 1
            self._out = jax.tree.map(lambda x: np.empty((entries, *x.shape[1:]), x.dtype), rows)
        number = len(jax.tree.leaves(rows)[0])
        for target, x in zip(jax.tree.leaves(self._out), jax.tree.leaves(rows), strict=True):
            target[self._entries : self._entries + number] = x
        self._entries += number

    def checkpoint(self, carry: Carry, done: int, seconds: float, stop: bool) -> None:
        """Receive, after each call of the loop, a carry from which the run can be resumed."""

    def can_stop(self) -> bool:
        """True if everything that a resumed run needs has been written."""
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        """The message for a user who interrupted the run."""
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def result(self, carry: Carry) -> Saves:
        """The saves, after the last step."""
        state, failed = devices.without_padding((carry.state, carry.failed), self._job.members)
        job, times, has_time = self._job, self._job.times, self._job.t0 is not None
        if job.reduction is None:
            info, states = self._out
            states = states._replace(t=job.state_times()) if has_time else states
            return Saves(Trajectory(times, states, info), failed)  # pyright: ignore
        series = {name: x for name, x in self._out.items() if name != "sums"}
        state = state._replace(t=job.state_times(slice(-1, None))[0]) if has_time else state
        ends = {"state": state, "failed": failed}
        if not job.per_member:
            return Saves(Summary(times, **series, **ends), failed)
        change: Any = devices.without_padding(carry.change, job.members)
        return Saves(MemberSummary(times, **change._asdict() | series | ends, number=job.num_steps + 1), failed)
