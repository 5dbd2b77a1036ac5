"""Computing a run on the host: its engine, calls of compiled code, rows for an output, and progress."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Literal, Self

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import _checks
from lieint_jax.runs import _layout, _loop, processes
from lieint_jax.runs._clock import GridClock, more_times
from lieint_jax.runs._dyadic_sum import block_sums, blocks, total
from lieint_jax.runs._engine import Engine, engine_of
from lieint_jax.runs._facts import Facts
from lieint_jax.runs._job import MAX_NAMED, Job, MakeStates, MemberSummary, Series, Summary, list_members
from lieint_jax.runs._layout import Layout, Tree
from lieint_jax.runs._loop import Carry, Given, energy
from lieint_jax.runs._make_job import made_states, make_jobs
from lieint_jax.runs._part_of_task import checked_part, part_of_task
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._leaves import Saves
from lieint_jax.runs.store._storage import StoreOptions, Url, address
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.types import State, Step, StepInfo, System, Trajectory, callable_pytree

_CALL = 0.5  # target duration of a call of the compiled loop, s


def compute(
    step: Step,
    states: State | MakeStates,
    dt: float | None,
    num_steps: int | None,
    *,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
    threads: int | None = None,
    same_bits: bool = True,
    earlier: Saves | None = None,
    **description: Any,
) -> tuple[Any, ...]:
    """Compute a run, and return the arguments of `run_of_saves`; states have the member axis also if it is of one body.

    Args:
        step, states, dt, num_steps, mesh, store, progress, resume, part, members, threads, same_bits: as in `li.run`.
        earlier: the saves in memory of a run that this one continues.
        description: further arguments of `checked_job`.
    """
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")
    k, count = (0, 1) if part is None else part_of_task() if part == "auto" else checked_part(part)
    threads = threads if threads is None else _checks.count("threads", threads, 1)
    given, mesh = mesh, _layout.checked_mesh(mesh)
    threads = threads or (_layout.count_cores() if given is None else len(mesh.local_devices))
    options = None if store is None else StoreOptions.of(store)
    in_parts, remote = part is not None and count > 1, options is not None and isinstance(address(options.path), Url)
    if (in_parts or remote) and _layout.count_processes(mesh) > 1:
        raise ValueError("part and stores in object storage are for independent processes, without jax.distributed")
    description |= {"dt": dt, "num_steps": num_steps, "store": store}
    made = made_states(states, members)
    with _checks.on_host():
        whole, job = make_jobs(step, states, made, (k, count) if in_parts else None, remote, description)
    engine = engine_of(job, mesh, threads)

    with processes.name_lost(mesh) if jax.process_count() > 1 else contextlib.nullcontext():
        if options is None:
            if _layout.count_processes(mesh) > 1:
                _identity.check_processes(mesh, _identity.description(job, engine.name), store=None, resume=False)
            layout = _layout.layout_of(mesh, job.members)
            saves = execute(engine, layout, MemoryOutput(job, layout, earlier), progress)
            assert saves is not None
            start = job.initial if job.reduction is not None else None
            functions = [None if f is None else callable_pytree(f) for f in (job.reduction, job.condition)]
            times = job.clock.times if isinstance(job.clock, GridClock) else None
            return job.step, saves, Facts.of_job(job, engine.name), start, *functions, times
        saves = run_into_store(
            job,
            engine.name,
            options,
            lambda layout, output: execute(engine, layout, output, progress),
            whole=whole,
            mesh=mesh,
            part=(k, count) if in_parts else (0, 1),
            in_parts=in_parts or remote,
            resume=resume or part is not None,
            same_bits=same_bits,
        )
    return job.step, saves, Facts.of_store(str(options.path), saves.attributes)


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


def gather_rows(layout: Layout, saved: Tree, number: int) -> Tree:
    """The first `number` saved rows of all members, on every process."""
    return _layout.gather(layout, jax.tree.map(lambda x: np.asarray(x)[:number], saved), 1)


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
    return rows, _loop.start(states, change)._replace(failed=failed.astype(_loop.step_dtype()))


def reduce_rows(rows: Tree, job: Job) -> Series:
    """Reduce rows (saves, members) to series (saves,), whose bits depend neither on devices nor on parts.

    For a part, "sums" (saves, blocks) are the sums from which the mean of the whole run is computed.
    """
    info, change = rows
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
        change: Any = _layout.gather(self._layout, carry.change)
        return Saves(MemberSummary(times, **change._asdict() | series | ends, number=job.num_steps + 1), failed)


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
