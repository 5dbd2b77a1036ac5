"""The loop of a run on the host: calls of compiled code, rows for the output, progress, interrupts, and failures."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from types import FrameType
from typing import Any, Self

import jax
import numpy as np

from lieint_jax.runs import _layout
from lieint_jax.runs._clock import GridClock, more_times
from lieint_jax.runs._engine import Engine
from lieint_jax.runs._job import MAX_NAMED, first_rows, gather_rows, list_members, reduce_rows
from lieint_jax.runs._layout import Layout
from lieint_jax.runs._loop import Carry, Given, energy
from lieint_jax.runs._memory_output import MemoryOutput
from lieint_jax.runs.store._leaves import Saves
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.types import System

_CALL = 0.5  # target duration of a call of the compiled loop, s


def execute(engine: Engine, layout: Layout, output: MemoryOutput | StoreOutput, progress: bool) -> Saves | None:
    """Run a job to its end, append its saved rows to `output`, and return the output's result."""
    job, restored = engine.job, output.restore()
    given, start = engine.start(layout)
    shown = bool(_layout.all_reduce_max(layout.mesh, progress and Bar.is_visible())[0])
    H0 = engine.quantity(energy, given, start.state, 0) if shown else None
    if restored is None:
        _check_start(engine, layout, given, start, output.buffer_rows)
        output.append(first_rows(job, start), 1)
        output.checkpoint(start, 0, 0.0, stop=False)
    carry, done, saved = restored or (start, 0, 0)
    del start, restored  # their arrays are as large as those of a carry
    most = max(1, 100_000 // layout.members)  # steps in a call
    with _interrupts(output.defers_interrupts) as requested, Bar(progress, job.num_steps, job.members, done) as bar:
        while saved < job.num_saves:
            limit, ahead = done + min(most, engine.most_steps), job.nodes[saved + 1 : saved + 1 + output.free_rows]
            saves = int(np.searchsorted(ahead, limit, side="right"))
            ends = ahead[:saves] if saves else np.array([limit])
            clock, steps = time.perf_counter(), int(ends[-1]) - done
            carry, rows = engine.run_intervals(given, carry, done, saved, ends, output.buffer_rows)
            done, saved = done + steps, saved + saves
            if saves:
                output.append(
                    rows if job.reduction is None else reduce_rows(gather_rows(layout, rows, saves), job), saves
                )
            del rows  # while the next call computes others
            bar.update(steps)
            if H0 is not None:
                H = engine.quantity(energy, given, carry.state, done)
                error, failed = _layout.worst_energy_error(layout, H0, H, carry.failed)
                bar.show(error if job.step.system.hamiltonian else None, failed)
            seconds, stop = _layout.all_reduce_max(layout.mesh, time.perf_counter() - clock, bool(requested))
            if steps == most or seconds > _CALL:
                most = int(min(max(1, most * min(4.0, _CALL / max(seconds, 1e-6))), 2**30))
            output.checkpoint(carry, done, seconds, bool(stop))
            if stop and output.can_stop():
                raise KeyboardInterrupt(output.interrupt_message(done, job.num_steps))
        result = output.result(carry)
    warn_of_failures(_layout.gather(layout, carry.failed), job.first_member, job.step.system)
    return result


def _check_start(engine: Engine, layout: Layout, given: Given, start: Carry, rows: int) -> None:
    """Raise ValueError if the first step of a member fails, or the reduced quantity is not finite at the start."""
    job = engine.job
    first = job.first_member
    if given.quantity is not None:
        bad = np.flatnonzero(~np.isfinite(_layout.gather(layout, given.quantity)))
        if bad.size:
            raise ValueError(
                f"the quantity of reduce must be finite at the start, from which its changes are measured, and is not "
                f"finite for {list_members(bad + first)}"
            )
    if job.num_steps:
        after, _ = engine.run_intervals(given, start, 0, 0, np.ones(1, int), rows)
        bad = np.flatnonzero(_layout.gather(layout, after.failed) >= 0)
        if bad.size and not job.step.approximate:
            step, state = job.member(bad[0])
            more = more_times(step, state, job.first_dt) if isinstance(job.clock, GridClock) else ""
            advice = f"{step.failure(state, job.first_dt)}{more}"
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


class Bar:
    """A progress bar: body-steps per second, time left, worst energy error so far, unconverged members.

    It is on stderr, if that is a terminal, or below the cell of a notebook, where a run takes more than a second.
    """

    def __init__(self, shown: bool, num_steps: int, count: int, done: int, unit: str = " body-steps") -> None:
        self._count, self._worst = count, 0.0
        self._bar = None
        if shown and self.is_visible():
            self._delayed = _in_notebook()
            self._bar = _tqdm()(
                total=num_steps * count,
                initial=done * count,
                unit=unit,
                unit_scale=True,
                leave=False,
                dynamic_ncols=True,
                delay=1 if self._delayed else 0,
            )

    @staticmethod
    def is_visible() -> bool:
        """True if this is the first process and somebody sees its bar."""
        return jax.process_index() == 0 and (sys.stderr.isatty() or _in_notebook())

    def update(self, steps: int) -> None:
        """Advance the bar by `steps` steps of all members."""
        if self._bar is not None:
            self._bar.update(steps * self._count)

    def show(self, energy: float | None, unconverged: int) -> None:
        """Show the worst energy error so far, `energy` being the latest, and the number of members that failed."""
        shown = f"unconverged {unconverged}"
        if energy is not None:
            self._worst = energy if energy != energy else max(self._worst, energy)
            shown = f"energy {self._worst:.1e}, {shown}"
        if self._bar is not None:
            self._bar.set_postfix_str(shown, refresh=not self._delayed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _in_notebook() -> bool:
    """True in the kernel of Jupyter."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


def _tqdm() -> Any:
    """The kind of bar that fits: widgets in a notebook that has ipywidgets, else text."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "IProgress not found")
        from tqdm.auto import tqdm  # imported here, for a fast import of the package
    return tqdm


@contextlib.contextmanager
def _interrupts(deferred: bool) -> Iterator[list[int]]:
    """A context in which a first Ctrl-C or SIGTERM is only added to the list; a second one interrupts at once.

    If not `deferred`, or outside the main thread, the handlers of the signals do not change.
    """
    requested: list[int] = []

    def request(number: int, _: FrameType | None) -> None:
        if requested:
            raise KeyboardInterrupt
        requested.append(number)
        print("\nlieint: finishing the chunk; interrupt again to stop at once", file=sys.stderr)

    deferred = deferred and threading.current_thread() is threading.main_thread()
    handlers = {n: signal.signal(n, request) for n in (signal.SIGINT, signal.SIGTERM)} if deferred else {}
    try:
        yield requested
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
