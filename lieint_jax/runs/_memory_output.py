"""Results in memory."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lieint_jax.runs import _layout
from lieint_jax.runs._job import Job, MemberSummary, Series, Summary, first_rows, gather_rows, rows_and_carry
from lieint_jax.runs._layout import Layout, Tree
from lieint_jax.runs._loop import Carry
from lieint_jax.runs.store._leaves import Saves
from lieint_jax.types import StepInfo, Trajectory


class MemoryOutput:
    """Results as numpy arrays; `earlier` are those of a run of which this one is the continuation.

    `StoreOutput` has the same methods.

    Attributes:
        defers_interrupts: whether an interrupt waits until the run `can_stop`.
        buffer_rows: the largest number of saves in one call of the compiled loop: the length of its buffer.
        free_rows: the largest number of saves in the next call.
    """

    defers_interrupts = False

    def __init__(self, job: Job, layout: Layout, earlier: Saves | None = None) -> None:
        self._job, self._layout, self._entries, self._earlier = job, layout, 0, earlier
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
        return _layout.placed(self._layout, carry), done, saved

    def append(self, saved: Tree | Series, number: int) -> None:
        """Receive `number` saved rows, or those of the series of a reduction; that of the start first."""
        self._put(saved if isinstance(saved, dict) else gather_rows(self._layout, saved, number))

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
        state, failed = _layout.gather(self._layout, (carry.state, carry.failed))
        job, times = self._job, self._job.times
        if job.reduction is None:
            info, states = self._out
            return Saves(Trajectory(times, job.with_times(states), info), failed)  # pyright: ignore
        series = {name: x for name, x in self._out.items() if name != "sums"}
        ends = {"state": job.with_last_time(state), "failed": failed}
        if not job.per_member:
            return Saves(Summary(times, **series, **ends), failed)
        change: Any = _layout.gather(self._layout, carry.change)
        return Saves(MemberSummary(times, **change._asdict() | series | ends, number=job.num_steps + 1), failed)
