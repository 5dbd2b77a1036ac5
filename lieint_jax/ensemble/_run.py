"""`ensemble.run`: the loop on the host, results in memory, and the report of members that failed."""

from __future__ import annotations

import inspect
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._deprecated import old_calls
from lieint_jax._integrate import (
    GridClock,
    RoundedClock,
    StateClock,
    UniformClock,
    clock_of,
    intervals,
    more_times,
    outputs,
    refuse_times,
)
from lieint_jax.ensemble import _identity, _layout, _loop, processes
from lieint_jax.ensemble._engine import Engine, engine_of
from lieint_jax.ensemble._job import Job, Output, Summary, first_entry, gather_rows, reduce_rows
from lieint_jax.ensemble._layout import Layout
from lieint_jax.ensemble._loop import Carry, Reduction, Saved, energy
from lieint_jax.ensemble._made_states import MadeStates, MakeStates, made_states
from lieint_jax.ensemble._part_of_task import checked_part, part_of_task
from lieint_jax.ensemble._parts import Split
from lieint_jax.ensemble._progress import Bar, CallLength, Interrupts
from lieint_jax.ensemble._storage import Url, address
from lieint_jax.ensemble._store import leaves_by_name
from lieint_jax.ensemble._store_output import StoreOptions, run_into_store, run_part_into_store, split_into_parts
from lieint_jax.native import make_once
from lieint_jax.types import PhaseSpace, State, Step, Trajectory, checked_step, promoted
from lieint_jax.types.members import member_axis

Result = Trajectory | Summary
_MAX_NAMED = 5  # failed members in a report
_ENTRY, _SERIES = 2 * 8, 5 * 8  # bytes of an entry's time and node, and of its numbers in the series of `reduce`
_SCALARS = ("t", "work")  # the leaves of states that are scalars for each member, or one scalar for all


@old_calls()
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    *,
    save_every: int | None = None,
    step_axis: int | None = None,
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
    """Integrate a batch of initial states in one compiled loop, in memory or into a store that can be resumed.

    The bits of the results depend neither on the number of devices and processes nor on whether the run was resumed.
    With `jax.distributed`, every process calls this with the same arguments and gets the same results.

    On a CPU the loop is machine code for vectors of members, in one thread per core (`lieint_jax.native`). Steps that
    cannot be compiled this way (a LAPACK call that depends on the state, very many bodies) and other devices use XLA.

    Args:
        step: a scheme's step; with `step_axis=0` its leaves carry the member axis too (one inertia per member).
        states: initial states with a leading member axis. A time t of shape () is shared by all members, and so is one
            of shape (members,) whose values are equal: then what depends on it alone, such as the position on an orbit,
            is computed once per step. `work` of shape () is that of every member. Or a function of member numbers (m,),
            which returns the states of these members: then a part makes only its own. It is called for consecutive
            numbers, up to 65 536 at once, must return the same for the same numbers in every process, and shares a time
            only by one of shape ().
        dt: step size, the same for all members.
        num_steps: number of steps, a multiple of `save_every`.
        save_every: number of steps between saved states; None saves the last state only.
        step_axis: None or 0.
        reduce: a quantity, "energy" (minus the work, where states have it) or a function (step, state) ↦ scalar.
            Intermediate states are not saved; the result has instead, for each save interval, the least, greatest and
            mean change of the quantity over all steps and members. All three are NaN where the quantity was NaN.
        mesh: devices, a `jax.sharding.Mesh` of the one axis "members"; None uses all. Machine code uses as many threads
            as the mesh has devices of this process, by default one per core.
        store: a folder NAME.zarr, a URL (s3://, gs://, az:// or memory://BUCKET/NAME.zarr), or `StoreOptions`, to which
            results are written during the run; memory then holds two rows of chunks of them: see `peak_memory`.
            Credentials for a URL are those in the environment.
        progress: show a progress bar on stderr, if that is a terminal.
        resume: continue the run in `store` from its last checkpoint; start it if there is no store.
        times: in place of dt and num_steps, the times (N+1,) of the boundaries of all members' steps, as in
            `integrate`.
        save_at: in place of save_every, output times (m,) as in `integrate`; since the start, if the members start at
            different times. The run ends at the last of them.
        part: (k, n) integrates part k = 0 … n − 1 of the members only, as one of n processes that need not run at the
            same time or communicate. Each writes its own part of `store`; it continues this part, if the store
            has it, and starts it otherwise. "auto" is the number of this task in an array of tasks: see
            `part_of_task`. All parts have the bits of one process.
        members: the number of members, where `states` is a function.

    Returns:
        A `Trajectory` of numpy arrays, axes (time, member, …), the initial states first; with `store`, of Zarr arrays,
        which are read from disk when they are indexed. With `reduce`, a `Summary`. With `part`, the results of the
        members of that part; `ensemble.open` returns those of all. Its t is t₀ + nΔt, where t₀ is the
        shared time of the members. If they have no time or start at different times, t is the time since the start. If
        the step has its `own_time`, t is nΔt, and state.t the time of each member.

    Raises:
        ValueError: invalid counts or times; states off the group, not finite, or without the time that a driven system
            needs; members whose first step fails; results larger than this machine's memory; a store that exists
            (without `resume`), or that is damaged, holds another run or cannot be compared with this one (with
            `resume`); attributes that a store cannot hold; `reduce` does not return a real scalar, or not a finite one
            at the start; processes that were given different runs.
        KeyboardInterrupt: interrupted; with `store`, after the chunk has been written.
        processes.LostProcess: another process of this run is gone.

    Warns:
        RuntimeWarning: a store that cannot be resumed, since the step refers to something that cannot be compared;
            members that fail to converge later, with the first such step of each; a time of the states
            so large that neighboring floating-point numbers differ by more than dt/10⁶.
    """
    _check_options(step_axis, reduce, resume, store)
    k, count = part_of_task() if part == "auto" else checked_part(part)
    threads = None if mesh is None else len(mesh.local_devices)
    mesh = _layout.checked_mesh(mesh)
    options = store if isinstance(store, StoreOptions) or store is None else StoreOptions(store)
    in_parts, remote = part is not None and count > 1, options is not None and isinstance(address(options.path), Url)
    if (in_parts or remote) and _layout.count_processes(mesh) > 1:
        raise ValueError("part and stores in object storage are for independent processes, without jax.distributed")
    made = made_states(states, members)
    make_job = partial(
        _make_job,
        dt=dt,
        num_steps=num_steps,
        save_every=save_every,
        step_axis=step_axis,
        reduce=reduce,
        store=store,
        times=times,
        save_at=save_at,
    )
    with _checks.on_host():
        whole, job, split = _make_jobs(make_job, step, states, made, (k, count) if in_parts else None, remote)
    engine = engine_of(job, mesh)
    place = _layout.Place(mesh, threads or _layout.count_cores(), engine.whole)

    def integrate(layout: Layout, output: Output) -> object:
        return _integrate(engine, layout, output, progress)

    with processes.name_lost(mesh):
        if options is None:
            if _layout.count_processes(mesh) > 1:
                _identity.check_processes(mesh, _identity.description(job, engine.name), store=None, resume=False)
            layout = _layout.layout_of(place, job.members, alone=whole.members == 1)
            return _integrate(engine, layout, MemoryOutput(job, layout), progress)
        if in_parts or remote:
            resume = resume or part is not None
            return run_part_into_store(engine, whole, place, options, split, k, resume, integrate)
        return run_into_store(engine, place, options, resume or part is not None, integrate)


def _check_options(step_axis: int | None, reduce: object, resume: bool, store: object) -> None:
    if step_axis not in (None, 0):
        raise ValueError(f"step_axis must be None (one step for all) or 0 (one per member), got {step_axis!r}")
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")


def _make_jobs(
    make_job: partial[Job],
    step: Step,
    states: State | MakeStates,
    made: MadeStates | None,
    part: tuple[int, int] | None,
    remote: bool,
) -> tuple[Job, Job, Split]:
    """The job of all members, that of this process, and how members are split into parts."""
    if made is None:
        whole = make_job(step, states)
    elif part is not None:
        whole = _describe_whole(make_job, step, made)
    else:
        whole = _make_members(make_job, step, made, range(made.members))
    split = split_into_parts(whole, 1 if part is None else part[1], remote)
    if part is None:
        return whole, whole, split
    own = split.part(part[0])
    job = whole.restricted(own) if made is None else _make_members(make_job, step, made, own)._replace(part=own)
    return whole, job, split


def _make_members(make_job: partial[Job], step: Step, made: MadeStates, members: range) -> Job:
    """The job of members whose states a function makes."""
    own = slice(members.start, members.stop)
    if make_job.keywords["step_axis"] is not None:
        step = jax.tree.map(lambda leaf: leaf[own], step)
    return make_job(step, made.make(members), made=members)


def _describe_whole(make_job: partial[Job], step: Step, made: MadeStates) -> Job:
    """The description of a run in parts whose states a function makes; only the first member's are made."""
    first = _make_members(make_job, step, made, range(1))
    step, _, _ = promoted(checked_step(step), first.initial)
    return first.with_members(made.members, made.function)._replace(step=step)


def _make_job(
    step: Step,
    states: State,
    dt: float | None,
    num_steps: int | None,
    save_every: int | None,
    step_axis: int | None,
    reduce: Reduction | Literal["energy"] | None,
    store: str | Path | StoreOptions | None,
    times: ArrayLike | None,
    save_at: ArrayLike | None,
    made: range | None = None,
) -> Job:
    """The checked description of a run from the arguments of `run`; `made` are the members that a function has made."""
    first = 0 if made is None else made.start
    step, states, dtype = promoted(checked_step(step), states)
    states, t0 = _split_time(step, states, first, merge=made is None)
    reduction = energy if reduce == "energy" else reduce
    clock, planned_steps = _make_clock(step, states, t0, dtype, dt, num_steps, times)
    if save_at is None:
        _check_size(states, intervals(planned_steps, save_every)[1] + 1, reduction, store)
        entries = _entries_by_count(clock, planned_steps, save_every, dtype)
    else:
        refuse_times(step, "save_at")
        if save_every is not None or reduce is not None:
            raise ValueError(f"pass save_at or {'save_every' if reduce is None else 'reduce'}, not both")
        entries = _entries_at_times(save_at, clock, planned_steps, dtype)
        _check_size(states, len(entries[0]), reduction, store)
    job = Job(step, states, t0, None if dt is None else float(dt), clock, planned_steps, *entries, step_axis, reduction)
    _check_job(job, first)
    _check_reduction(job)
    _checks.time_resolution(t0, job.first_dt, planned_steps)
    return job


def _check_size(states: State, entries: int, reduction: Reduction | None, store: object) -> None:
    """Raise ValueError if the results of a run exceed this machine's memory: its states or series, and its times."""
    size, advice = _ENTRY, "use a larger save_every"
    if reduction is not None:
        size += _SERIES
    elif store is None:
        size += _checks.entry_size(states, len(states.p))
        advice += " or store=PATH.zarr, which needs memory for one chunk only"
    _checks.fits_memory(entries, size, advice)


def _integrate(engine: Engine, layout: Layout, output: Output, progress: bool) -> Result | None:
    """Run a job to its end, append its saved rows to `output`, and return the output's result."""
    job, loop = engine.job, CompiledLoop(engine, layout, output.buffer_rows, progress)
    carry, done, saved = output.restore() or (None, 0, 0)
    if carry is None:
        carry = loop.start
        loop.check_first_step()
        output.begin(carry)
    length = CallLength(layout)
    with Interrupts(output.defers_interrupts) as interrupts, Bar(progress, job.num_steps, job.members, done) as bar:
        while saved < job.num_saves:
            ends, saves = _next_call(job, done, saved, min(length.steps, engine.most_steps), output.free_rows)
            clock, steps = time.perf_counter(), int(ends[-1]) - done
            carry, rows = loop.advance(carry, done, saved, ends)
            done, saved = done + steps, saved + saves
            if saves:
                output.append(rows, saves)
            del rows  # while the next call computes others
            bar.update(steps)
            loop.show_progress(carry, done, bar)
            stop = length.measure(steps, time.perf_counter() - clock, interrupts.requested)
            output.checkpoint(carry, done, length.seconds, stop)
            if stop and output.can_stop():
                raise KeyboardInterrupt(output.interrupt_message(done, job.num_steps))
        if not job.num_saves:
            output.checkpoint(carry, 0, 0.0, stop=False)
        result = output.result(carry)
    _warn_of_failures(_layout.gather(layout, [c.failed for c in carry]), job.first_member)
    return result


def _next_call(job: Job, done: int, saved: int, most: int, free_rows: int) -> tuple[np.ndarray, int]:
    """The nodes at the ends of the next call's intervals, `most` steps or fewer, and how many of them are saved."""
    ahead = job.nodes[saved + 1 : saved + 1 + free_rows]
    saves = int(np.searchsorted(ahead, done + most, side="right"))
    return (ahead[:saves], saves) if saves else (np.array([done + most]), 0)


def _make_clock(
    step: Step,
    states: State,
    t0: _layout.Numbers | None,
    dtype: np.dtype,
    dt: ArrayLike | None,
    num_steps: int | None,
    times: ArrayLike | None,
) -> tuple[UniformClock | RoundedClock | GridClock, int]:
    """The clock of the steps, as host arrays, and their number; since the start if members start at different times."""
    if t0 is not None and t0.ndim:
        if times is not None:
            raise ValueError("times hold for all members: give all members the same states.t, or none")
        t0 = None
    clock, planned_steps = clock_of(step, states._replace(t=t0), dtype, dt, num_steps, times)
    if isinstance(clock, StateClock):
        clock = UniformClock(jnp.zeros((), dtype), clock.dt)
    return jax.tree.map(np.asarray, clock), planned_steps


_Entries = tuple[np.ndarray, np.ndarray, np.ndarray | None, int | None]  # times, nodes, rests, save_every of a `Job`


def _entries_by_count(
    clock: UniformClock | RoundedClock | GridClock, planned_steps: int, save_every: int | None, dtype: np.dtype
) -> _Entries:
    """The entries after every `save_every` steps."""
    interval, num_saves = intervals(planned_steps, save_every)
    nodes = interval * np.arange(num_saves + 1)
    times = clock.time(nodes if isinstance(clock, GridClock) else nodes.astype(dtype))
    return np.asarray(times), nodes, None, interval


def _entries_at_times(
    save_at: ArrayLike, clock: UniformClock | RoundedClock | GridClock, planned_steps: int, dtype: np.dtype
) -> _Entries:
    """The entries at given times, that of the start first."""
    wanted = outputs(save_at, clock, planned_steps, dtype)
    times = np.concatenate([[clock.time(0)], wanted])
    nodes = np.asarray(jax.vmap(lambda t: clock.node(t, planned_steps))(times))
    return times, nodes, times - np.asarray(clock.time(nodes)).astype(dtype), None


class CompiledLoop:
    """The loop of a run over the blocks of a layout."""

    def __init__(self, engine: Engine, layout: Layout, buffer_rows: int, progress: bool) -> None:
        self._engine, self._job, self._layout, self._rows = engine, engine.job, layout, buffer_rows
        self._start = engine.start(layout)
        self.start = self._start.carry
        self._shown = bool(_layout.all_reduce_max(layout.mesh, progress and Bar.is_visible())[0])
        if self._shown:
            self._H0 = self._energies(self.start, 0)

    def advance(self, carry: list[Carry], done: int, saved: int, ends: np.ndarray) -> tuple[list[Carry], list[Saved]]:
        """The carries and the saved rows, a list item per block, of the save intervals that end at the nodes `ends`.

        Before them there were `done` steps, and `saved` entries after the start.
        """
        dtype, rests = _loop.step_dtype(), self._job.rests
        first = np.concatenate([[done], ends[:-1]]).astype(dtype)
        begins = (np.arange(len(ends)) > 0) | (done == self._job.nodes[saved])
        if rests is not None:
            rests = np.resize(rests[saved + 1 :], len(ends)).astype(self._job.dtype)
        spans = _loop.Span(first, ends.astype(dtype), rests, begins)
        return self._engine.advance(self._layout, self._start, carry, spans, self._rows)

    def check_first_step(self) -> None:
        """Raise ValueError if the first step of a member fails, or the reduced quantity is not finite at the start."""
        if self._job.reduction is not None:
            _check_start(
                _layout.gather(self._layout, [origin.quantity for origin in self._start.origin]), self._job.first_member
            )
        if self._job.num_steps:
            after, _ = self.advance(self.start, 0, 0, np.ones(1, int))
            _check_first(_layout.gather(self._layout, [c.failed for c in after]), self._job)

    def _energies(self, carry: list[Carry], done: int) -> list[_layout.Numbers]:
        """The energies minus work after `done` steps."""
        return self._engine.quantity(self._layout, _loop.energy, self._start, [c.state for c in carry], done)

    def show_progress(self, carry: list[Carry], done: int, bar: Bar) -> None:
        """Show the energy error and the failures so far on the progress bar, if it is visible."""
        if self._shown:
            H = self._energies(carry, done)
            bar.show(*_layout.worst_energy_error(self._layout, self._H0, H, [c.failed for c in carry]))


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

    def begin(self, carry: list[Carry]) -> None:
        if self._job.reduction is not None:
            self._series.append(first_entry(self._job))
            return
        first = _layout.gather(self._layout, [(c.info, c.state) for c in carry])
        self._out = jax.tree.map(lambda x: np.empty((self._job.num_saves + 1, *x.shape), x.dtype), first)
        self._put(jax.tree.map(lambda x: x[None], first))

    def append(self, saved: list[Saved], number: int) -> None:
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

    def checkpoint(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        pass

    def can_stop(self) -> bool:
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def result(self, carry: list[Carry]) -> Result:
        if self._job.reduction is None and self._out is not None:
            info, state = self._out
            return Trajectory(self._job.times, self._job.with_times(state), info)  # pyright: ignore[reportArgumentType]
        names = set(Summary._fields) & set(self._series[0])
        series = {name: np.concatenate([part[name] for part in self._series]) for name in names}
        state, failed = _layout.gather(self._layout, [(c.state, c.failed) for c in carry])
        return Summary(self._job.times, **series, state=self._job.with_last_time(state), failed=failed)


def _split_time(step: Step, states: State, first: int = 0, merge: bool = True) -> tuple[State, _layout.Numbers | None]:
    """The checked states without their time, with the member axis on every leaf, and their time: a scalar if shared.

    If the step has a time of its own, it stays in the states, one for each member.

    Args:
        step: the step.
        states: the states.
        first: the number of the first of these members, for messages.
        merge: whether equal times of all members are a shared one. Those of a part do not show whether all are equal.
    """
    shapes = {name: np.shape(x) for name, x in leaves_by_name(states).items()}
    for key in states.extra or {}:
        if not str(key).isidentifier():
            raise ValueError(f'a key of states.extra must be an identifier, such as "rotor", got {key!r}')
    counts = {shape[:1] for name, shape in shapes.items() if shape or name not in _SCALARS}
    short = [name for name in ("q", "p") if len(shapes[name]) < 2]
    if len(counts) != 1 or (0,) in counts or short or any(len(shapes.get(name, ())) > 1 for name in _SCALARS):
        given = ", ".join(f"{_python_name(name)} {shape}" for name, shape in shapes.items())
        raise ValueError(f"states need a leading member axis on every leaf, but t and work may be scalars; got {given}")
    [(members,)] = counts
    for name, x in leaves_by_name(states).items():
        bad = np.flatnonzero(~np.isfinite(np.asarray(x)).reshape(len(x) if x.ndim else 1, -1).all(axis=1))
        if bad.size:
            where = f", and is not finite for {_list_members(bad + first)}" if x.ndim else f", got {x}"
            raise ValueError(f"states.{_python_name(name)} must be finite{where}")
    states = jax.tree.map(np.asarray, states)
    t, work = states.t, states.work
    if work is not None:
        work = np.broadcast_to(work, (members,))
    if step.own_time and t is not None:
        return states._replace(t=np.broadcast_to(t, (members,)), work=work), None  # pyright: ignore
    if merge and t is not None and t.ndim and np.all(t == t[0]):
        t = t[0]
    return states._replace(t=None, work=work), t


def _check_job(job: Job, first: int) -> None:
    step, state = job.member(0)
    member_axis(job.step.system, state, job.members, job.step_axis, "step_axis")
    defect = np.abs(np.asarray(_defects(job.step.system.phase_space, job.states)))
    bad = np.flatnonzero(defect > 2 * _checks.UNIT_TOLERANCE)  # |q|² − 1 is twice the error of |q|
    if bad.size:
        raise ValueError(
            f"states.q is off the configuration space by more than {_checks.UNIT_TOLERANCE:g}: "
            f"{_list_members(bad + first)} (worst defect {defect.max():.3g}); make states with system.state(...)"
        )
    step.system.check(state)  # the shapes, and the time of a driven system, are the same for all members


def _check_reduction(job: Job) -> None:
    """Raise ValueError unless the reduced quantity is a real scalar function of a step and a state."""
    if job.reduction is not None:
        make_once(_check_result, job.reduction, (), job.member(0))


def _check_result(reduction: Reduction, _: tuple[()], arguments: tuple[Step, State]) -> None:
    try:
        inspect.signature(reduction).bind(*arguments)
    except TypeError as error:
        raise ValueError(f"reduce must be a function of two arguments, (step, state) ↦ scalar: {error}") from None
    except ValueError:  # a function without a signature
        pass
    found: list[object] = []
    jax.eval_shape(lambda step, state: found.append(reduction(step, state)), *arguments)  # pyright: ignore
    [value] = found
    array = isinstance(value, Array | np.ndarray | np.generic)
    if not ((array or isinstance(value, float)) and _is_real_scalar(value)):
        shown = f"{value.dtype} of shape {value.shape}" if array else repr(value)
        raise ValueError(
            f"reduce must return a real floating-point scalar, got {shown}; return one component of a vector or "
            "its norm, and 1.0 * x for an integer x"
        )


def _is_real_scalar(value: _layout.Numbers | np.generic | float) -> bool:
    return np.shape(value) == () and jnp.issubdtype(jnp.result_type(value), jnp.floating)


def _check_start(quantity: np.ndarray, first: int) -> None:
    bad = np.flatnonzero(~np.isfinite(quantity))
    if bad.size:
        raise ValueError(
            f"the quantity of reduce must be finite at the start, from which its changes are measured, and is not "
            f"finite for {_list_members(bad + first)}"
        )


@jax.jit
def _defects(phase_space: PhaseSpace, states: State) -> Array:
    return jax.vmap(phase_space.defect)(states)


def _check_first(failed: np.ndarray, job: Job) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size and not job.step.approximate:
        step, state = job.member(bad[0])
        more = more_times(step, state, job.first_dt) if isinstance(job.clock, GridClock) else ""
        advice = f"{step.advice(state, job.first_dt)}{more}"
        first = job.first_member
        raise ValueError(f"the first step fails for {_list_members(bad + first)}. Member {bad[0] + first}: {advice}")


def _warn_of_failures(failed: np.ndarray, first: int) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        bad = bad[np.argsort(failed[bad], kind="stable")]
        named = ", ".join(f"member {first + m} at step {failed[m]}" for m in bad[:_MAX_NAMED])
        more = f" and {bad.size - _MAX_NAMED} more" if bad.size > _MAX_NAMED else ""
        warnings.warn(
            f"{bad.size} of {failed.size} members did not converge at every step: {named}{more}; "
            "do not trust their results after these steps (use a smaller dt)",
            RuntimeWarning,
            stacklevel=5,
        )


def _python_name(name: str) -> str:
    """The name of an array of the states, as written in Python."""
    return f'extra["{name.removeprefix("extra.")}"]' if name.startswith("extra.") else name


def _list_members(which: np.ndarray) -> str:
    more = ", …" if which.size > _MAX_NAMED else ""
    return f"{which.size} member(s): {', '.join(map(str, which[:_MAX_NAMED]))}{more}"
