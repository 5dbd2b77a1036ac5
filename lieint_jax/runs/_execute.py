"""The loop of a run on the host: calls of compiled code, rows for the output, and the report of failures."""

from __future__ import annotations

import time
import warnings

import numpy as np

from lieint_jax.runs import _layout, _loop
from lieint_jax.runs._clock import GridClock, more_times
from lieint_jax.runs._engine import Engine
from lieint_jax.runs._job import MAX_NAMED, Job, Saves, gather_rows, list_members, reduce_rows
from lieint_jax.runs._layout import Layout, Tree
from lieint_jax.runs._loop import Carry
from lieint_jax.runs._memory_output import MemoryOutput
from lieint_jax.runs._progress import Bar, CallLength, Interrupts
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.types import System


def execute(engine: Engine, layout: Layout, output: MemoryOutput | StoreOutput, progress: bool) -> Saves | None:
    """Run a job to its end, append its saved rows to `output`, and return the output's result."""
    job, loop = engine.job, CompiledLoop(engine, layout, output.buffer_rows, progress)
    carry, done, saved = output.restore() or (None, 0, 0)
    if carry is None:
        carry = loop.start
        loop.check_first_step()
        output.begin(carry)
        output.checkpoint(carry, 0, 0.0, stop=False)
    length = CallLength(layout)
    with Interrupts(output.defers_interrupts) as interrupts, Bar(progress, job.num_steps, job.members, done) as bar:
        while saved < job.num_saves:
            ends, saves = _next_call(job, done, saved, min(length.steps, engine.most_steps), output.free_rows)
            clock, steps = time.perf_counter(), int(ends[-1]) - done
            carry, rows = loop.run_intervals(carry, done, saved, ends)
            done, saved = done + steps, saved + saves
            if saves:
                output.append(
                    rows if job.reduction is None else reduce_rows(gather_rows(layout, rows, saves), job), saves
                )
            del rows  # while the next call computes others
            bar.update(steps)
            loop.show_progress(carry, done, bar)
            stop = length.measure(steps, time.perf_counter() - clock, interrupts.requested)
            output.checkpoint(carry, done, length.seconds, stop)
            if stop and output.can_stop():
                raise KeyboardInterrupt(output.interrupt_message(done, job.num_steps))
        result = output.result(carry)
    warn_of_failures(_layout.gather(layout, carry.failed), job.first_member, job.step.system)
    return result


def _next_call(job: Job, done: int, saved: int, most: int, free_rows: int) -> tuple[np.ndarray, int]:
    """The nodes at the ends of the next call's intervals, `most` steps or fewer, and how many of them are saved."""
    ahead = job.nodes[saved + 1 : saved + 1 + free_rows]
    saves = int(np.searchsorted(ahead, done + most, side="right"))
    return (ahead[:saves], saves) if saves else (np.array([done + most]), 0)


class CompiledLoop:
    """The loop of a run over the members of a layout."""

    def __init__(self, engine: Engine, layout: Layout, buffer_rows: int, progress: bool) -> None:
        self._engine, self._job, self._layout, self._rows = engine, engine.job, layout, buffer_rows
        self._given, self.start = engine.start(layout)
        self._shown = bool(_layout.all_reduce_max(layout.mesh, progress and Bar.is_visible())[0])
        if self._shown:
            self._H0 = self._energies(self.start, 0)

    def run_intervals(self, carry: Carry, done: int, saved: int, ends: np.ndarray) -> tuple[Carry, Tree]:
        """The carry and the saved rows of the save intervals that end at the nodes `ends`.

        Before them there were `done` steps, and `saved` entries after the start.
        """
        dtype, rests = _loop.step_dtype(), self._job.rests
        first = np.concatenate([[done], ends[:-1]]).astype(dtype)
        begins = (np.arange(len(ends)) > 0) | (done == self._job.nodes[saved])
        if rests is not None:
            rests = np.resize(rests[saved + 1 :], len(ends)).astype(self._job.dtype)
        spans = _loop.Span(first, ends.astype(dtype), rests, begins)
        return self._engine.run_spans(self._given, carry, spans, self._rows)

    def check_first_step(self) -> None:
        """Raise ValueError if the first step of a member fails, or the reduced quantity is not finite at the start."""
        if self._job.reduction is not None:
            _check_start(_layout.gather(self._layout, self._given.quantity), self._job.first_member)
        if self._job.num_steps:
            after, _ = self.run_intervals(self.start, 0, 0, np.ones(1, int))
            _check_first(_layout.gather(self._layout, after.failed), self._job)

    def _energies(self, carry: Carry, done: int) -> _layout.Numbers:
        """The energies minus work after `done` steps."""
        return self._engine.quantity(_loop.energy, self._given, carry.state, done)

    def show_progress(self, carry: Carry, done: int, bar: Bar) -> None:
        """Show the energy error and the failures so far on the progress bar, if it is visible."""
        if self._shown:
            H = self._energies(carry, done)
            energy, failed = _layout.worst_energy_error(self._layout, self._H0, H, carry.failed)
            bar.show(energy if self._job.step.system.hamiltonian else None, failed)


def _check_start(quantity: np.ndarray, first: int) -> None:
    bad = np.flatnonzero(~np.isfinite(quantity))
    if bad.size:
        raise ValueError(
            f"the quantity of reduce must be finite at the start, from which its changes are measured, and is not "
            f"finite for {list_members(bad + first)}"
        )


def _check_first(failed: np.ndarray, job: Job) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size and not job.step.approximate:
        step, state = job.member(bad[0])
        more = more_times(step, state, job.first_dt) if isinstance(job.clock, GridClock) else ""
        advice = f"{step.failure(state, job.first_dt)}{more}"
        first = job.first_member
        raise ValueError(f"the first step fails for {list_members(bad + first)}. Member {bad[0] + first}: {advice}")


def warn_of_failures(failed: np.ndarray, first: int, system: System) -> None:
    """Warn of members, from number `first` on, that did not converge at a step; and of where `system` is defined."""
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        bad = bad[np.argsort(failed[bad], kind="stable")]
        named = ", ".join(f"member {first + m} at step {failed[m]}" for m in bad[:MAX_NAMED])
        more = f" and {bad.size - MAX_NAMED} more" if bad.size > MAX_NAMED else ""
        sentence = (
            f"{bad.size} of {failed.size} members did not converge at every step: {named}{more}; "
            "do not trust their results after these steps (use a smaller dt)"
        )
        warnings.warn(
            ". ".join(filter(None, [sentence, system.domain])),
            RuntimeWarning,
            stacklevel=5,
        )
