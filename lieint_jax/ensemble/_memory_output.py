"""Results in memory."""

from __future__ import annotations

import jax
import numpy as np

from lieint_jax.ensemble import _layout
from lieint_jax.ensemble._job import Job, Summary, first_entry, gather_rows, reduce_rows
from lieint_jax.ensemble._layout import Layout
from lieint_jax.ensemble._loop import Carry, Saved
from lieint_jax.types import Trajectory

Result = Trajectory | Summary


class MemoryOutput:
    """Results as numpy arrays."""

    defers_interrupts = False

    def __init__(self, job: Job, layout: Layout) -> None:
        self._job, self._layout, self._entries = job, layout, 0
        self.buffer_rows = self.free_rows = job.buffer_rows(job.members)
        self._series: list[dict[str, np.ndarray]] = []
        self._out: Saved | None = None

    def restore(self) -> None:
        return None

    def begin(self, carry: Carry) -> None:
        if self._job.reduction is not None:
            self._series.append(first_entry(self._job))
            return
        first = _layout.gather(self._layout, (carry.info, carry.state))
        self._out = jax.tree.map(lambda x: np.empty((self._job.num_saves + 1, *x.shape), x.dtype), first)
        self._put(jax.tree.map(lambda x: x[None], first))

    def append(self, saved: Saved, number: int) -> None:
        rows = gather_rows(self._layout, saved, number)
        if self._job.reduction is None:
            self._put(rows)
        else:
            self._series.append(reduce_rows(rows, self._job))

    def _put(self, rows: Saved) -> None:
        number = len(jax.tree.leaves(rows)[0])
        for target, x in zip(jax.tree.leaves(self._out), jax.tree.leaves(rows), strict=True):
            target[self._entries : self._entries + number] = x
        self._entries += number

    def checkpoint(self, carry: Carry, done: int, seconds: float, stop: bool) -> None:
        pass

    def can_stop(self) -> bool:
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def result(self, carry: Carry) -> Result:
        if self._job.reduction is None and self._out is not None:
            info, state = self._out
            return Trajectory(self._job.times, self._job.with_times(state), info)  # pyright: ignore[reportArgumentType]
        names = set(Summary._fields) & set(self._series[0])
        series = {name: np.concatenate([part[name] for part in self._series]) for name in names}
        state, failed = _layout.gather(self._layout, (carry.state, carry.failed))
        return Summary(self._job.times, **series, state=self._job.with_last_time(state), failed=failed)
