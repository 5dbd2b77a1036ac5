"""Computing a run on the host: its engine, calls of compiled code, rows for an output, and progress."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from functools import partial
from types import FrameType
from typing import Self

import numpy as np

from lieint_jax import _checks
from lieint_jax.core import System
from lieint_jax.runs import _devices as devices
from lieint_jax.runs._clock import GridClock, more_times
from lieint_jax.runs._devices import Numbers
from lieint_jax.runs._engine import Engine, engine_of
from lieint_jax.runs._loop import Given, energy
from lieint_jax.runs._memory_output import MemoryOutput, first_rows, reduce_rows
from lieint_jax.runs._plan import MAX_NAMED, Plan, list_members
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._store_output import StoreOutput

_CALL = 0.5  # target duration of a call of the compiled loop, s


def compute(plan: Plan, earlier: Saves | None = None) -> tuple[Plan, Saves, str]:
    """Compute a run, or the part of it that is this process'; `earlier` are saves in memory that it continues.

    Returns:
        The plan of these members, their saves, and the name of the engine.
    """
    with _checks.on_host():
        own = plan.of_part()
    engine = engine_of(own)
    if plan.store is not None:
        return own, run_into_store(plan, engine, partial(execute, engine)), engine.name
    saves = execute(engine, MemoryOutput(own, earlier))
    assert saves is not None
    return own, saves, engine.name


def execute(engine: Engine, output: MemoryOutput | StoreOutput) -> Saves | None:
    """Run a plan to its end, append its saved rows to `output`, and return the output's result."""
    plan, restored = engine.plan, output.restore()
    given, start = engine.start()
    H0 = None
    if plan.progress and Bar.is_visible():
        H0 = devices.without_padding(engine.quantity(energy, given, start.state), plan.members)
    if restored is None:
        _check_quantity(plan, given)
        if output.commits and plan.num_steps:  # before anything is written
            after, _ = engine.run_intervals(given, start, 0, 0, np.ones(1, int), output.buffer_rows)
            _check_first_step(plan, after.failed)
        output.append(first_rows(plan, start), 1)
        output.checkpoint(start, 0, 0.0, stop=False)
    carry, done, saved = restored or (start, 0, 0)
    del start, restored  # their arrays are as large as those of a carry
    most = max(1, 100_000 // plan.members)  # steps in a call
    bar = Bar(plan.progress, plan.num_steps, plan.members, done)
    with _interrupts(output.commits) as requested, bar:
        while saved < plan.num_saves:
            limit, ahead = done + min(most, engine.most_steps), plan.nodes[saved + 1 : saved + 1 + output.free_rows]
            saves = int(np.searchsorted(ahead, limit, side="right"))
            ends = ahead[:saves] if saves else np.array([limit])
            clock, steps = time.perf_counter(), int(ends[-1]) - done
            carry, rows = engine.run_intervals(given, carry, done, saved, ends, output.buffer_rows)
            if done == 0:
                _check_first_step(plan, carry.failed)
            done, saved = done + steps, saved + saves
            if saves:
                output.append(rows if plan.reduction is None else reduce_rows(rows, saves, plan), saves)
            del rows  # while the next call computes others
            bar.update(steps)
            if H0 is not None:
                H = engine.quantity(energy, given, carry.state)
                H, failed = devices.without_padding((H, carry.failed), plan.members)
                error = devices.worst_energy_error(H0, H) if plan.step.system.hamiltonian else None
                bar.show(error, int(np.sum(failed >= 0)))
            seconds, stop = time.perf_counter() - clock, bool(requested)
            if steps == most or seconds > _CALL:
                most = int(min(max(1, most * min(4.0, _CALL / max(seconds, 1e-6))), 2**30))
            output.checkpoint(carry, done, seconds, stop)
            if stop and output.can_stop():
                raise KeyboardInterrupt(output.interrupt_message(done, plan.num_steps))
        result = output.result(carry)
    warn_of_failures(devices.without_padding(carry.failed, plan.members), plan.first_member, plan.step.system)
    return result


def _check_quantity(plan: Plan, given: Given) -> None:
    """Raise ValueError if the reduced quantity is not finite at the start."""
    if given.quantity is not None:
        bad = np.flatnonzero(~np.isfinite(devices.without_padding(given.quantity, plan.members)))
        if bad.size:
            raise ValueError(
                f"the quantity of reduce must be finite at the start, from which its changes are measured, and is not "
                f"finite for {list_members(bad + plan.first_member)}"
            )


def _check_first_step(plan: Plan, failed: Numbers) -> None:
    """Raise ValueError if the first step that failed is the first step of the run, for any member."""
    bad, first = np.flatnonzero(devices.without_padding(failed, plan.members) == 0), plan.first_member
    if bad.size and not plan.step.approximate:
        step, state = plan.member(bad[0])
        more = more_times(step, state, plan.first_dt) if isinstance(plan.clock, GridClock) else ""
        advice = f"{step.failure(state, plan.first_dt)}{more}"
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
            with warnings.catch_warnings():  # of a notebook without ipywidgets, where the bar is text
                warnings.filterwarnings("ignore", "IProgress not found")
                from tqdm.auto import tqdm  # imported here, for a fast import of the package
            self._bar = tqdm(
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
        """True if somebody sees the bar: stderr is a terminal, or this is a notebook."""
        return sys.stderr.isatty() or _in_notebook()

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
