"""`Plan`: a run before it is computed, made and checked once from the arguments of `li.run`."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._xla import reads, rereading_jit
from lieint_jax.core import PhaseSpace, State, Step, callable_pytree, checked_step, leaves_by_name, promoted
from lieint_jax.dates import DateLike, text_of
from lieint_jax.native import make_once
from lieint_jax.runs import _devices as devices
from lieint_jax.runs._arguments import check_inertias
from lieint_jax.runs._clock import Clock, GridClock, UniformClock, clock_of, intervals, outputs, refuse_times
from lieint_jax.runs._devices import Numbers
from lieint_jax.runs._loop import Change, Reduction, energy
from lieint_jax.runs._made_states import MadeStates, MakeStates, made_states
from lieint_jax.runs._part_of_task import checked_part, part_of_task
from lieint_jax.runs._split import Split
from lieint_jax.runs._storage.leaves import shared_time
from lieint_jax.runs._storage.storage import StoreOptions, Url, address
from lieint_jax.runs._summary import SERIES, with_member_axis
from lieint_jax.runs.members import check_own_step

_CHUNK_BYTES, _BUFFER_BYTES = 2**22, 2**28  # the most bytes in a chunk on disk, and in the buffer of all members' saves
_CHUNK_WORK = 2e8  # the most body-steps between two writes, unless one save interval has more
_OBJECT_BYTES, _OBJECT_WORK = 2**26, 2e10  # the same in object storage: q has up to 37 MB, minutes of a core
CHUNK_MEMBERS = 8192  # the most members in a chunk on disk
MAX_NAMED = 5  # members in a message
_CHUNKS_OF_BUFFER = _BUFFER_BYTES // _OBJECT_BYTES  # so many such chunks fill the buffer
_ENTRY, _SERIES = 2 * 8, 5 * 8  # bytes of an entry's time and node, and of its numbers in the series of `reduce`
_SCALARS = ("t", "work")  # the leaves of states that are scalars for each member, or one scalar for all


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a run integrates, what it saves, where to and how.

    Attributes:
        step: the step; with the member axis on its leaves if `own_step`.
        states: the initial states, with the member axis on every leaf; a time or work that all members share is a view.
        own_step: whether each member has a step of its own.
        batch: False for a run of one body, which is a batch of one member.
        shared_time: whether all members have the same time, so that what depends on it alone, such as the position on
            an orbit, is computed once per step.
        make_states: the function that makes the states of each part; `states` of the whole run are those of its first
            member, repeated. None if `states` are those of all members.
        clock: the times of the steps; since the start if the states have no time or members start at different times.
        dt: the step size given by the caller; None if times were given.
        planned_steps: the number of steps that the caller asked for; the run ends at its last entry.
        times: the times of all entries on this clock, that of the start first.
        nodes: the number of whole steps before each entry.
        rests: the size of the shorter step from its node to each entry, 0 for the start; None if all entries are at
            nodes.
        save_every: the number of steps between saves; None with `rests`.
        reduction: the quantity to reduce, or None.
        per_member: whether the reduction is of each member over all steps.
        condition: the condition (step, state) ↦ flag whose first time is recorded for each member, or None.
        epoch: the date of t = 0, as text, or "".
        store: the store to which the run is written; None if it is kept in memory.
        part: (k, n), if this process integrates part k of n; None if it integrates all members.
        resume: whether a run in the store is continued.
        same_bits: whether it may only be continued on a machine of the same kind.
        mesh: the devices.
        threads: the number of threads of machine code.
        progress: whether to show a progress bar.
        part_members: the members of the run to which this plan is restricted, those of its part; None if it is of all.
    """

    step: Step
    states: State
    own_step: bool
    batch: bool
    shared_time: bool
    make_states: MadeStates | None
    clock: Clock
    dt: float | None
    planned_steps: int
    times: np.ndarray
    nodes: np.ndarray
    rests: np.ndarray | None
    save_every: int | None
    reduction: Reduction | None
    per_member: bool
    condition: Reduction | None
    epoch: str
    store: StoreOptions | None
    part: tuple[int, int] | None
    resume: bool
    same_bits: bool
    mesh: Mesh
    threads: int
    progress: bool
    part_members: range | None = None

    @property
    def members(self) -> int:
        """The number of members."""
        return self.states.p.shape[0]

    @property
    def first_member(self) -> int:
        """The number in the run of the first member of this plan."""
        return 0 if self.part_members is None else self.part_members.start

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the states."""
        return np.dtype(self.states.p.dtype)

    @property
    def num_steps(self) -> int:
        """The total number of steps."""
        return int(self.nodes[-1])

    @property
    def num_saves(self) -> int:
        """The number of entries after the start."""
        return len(self.nodes) - 1

    @property
    def first_dt(self) -> float:
        """The size of the first step."""
        return self.dt or (float(self.clock.size(0)) if self.planned_steps else 0.0)

    @property
    def own_times(self) -> bool:
        """Whether members start at different times; False if the step advances the time of each itself."""
        return self.states.t is not None and not self.shared_time and not self.step.own_time

    @property
    def members_clock(self) -> Clock:
        """The clock of each member, which begins at the time of its state: t₀ has a member axis where these differ.

        It has no t₀ if the step advances the time itself. Without a time of the states it counts from the start.
        """
        if isinstance(self.clock, GridClock):
            return self.clock
        if self.step.own_time:
            return UniformClock(None, self.clock.dt)
        if self.states.t is None:
            return self.clock._replace(coarse=None)
        return self.clock._replace(t0=self.states.t) if self.own_times else self.clock

    def as_saved(self, states: State) -> State:
        """States as the loop saves them: without a time that follows from the number of steps."""
        return states if self.step.own_time else states._replace(t=None)

    def with_times(self, states: State, entries: slice | int = slice(None)) -> State:
        """States as the loop saved them at these entries, with their times."""
        if self.states.t is None or self.step.own_time:
            return states
        return states._replace(t=self.times_of(entries))  # pyright: ignore[reportArgumentType]

    def times_of(self, entries: slice | int = slice(None), members: slice = slice(None)) -> np.ndarray:
        """The times of members at entries, (entries, members), or at one, (members,): they follow from its steps."""
        times = self.times[entries]
        if self.own_times:
            return np.asarray(self.states.t)[members] + times[..., None]
        return shared_time(times, self.members)[..., members]

    def member(self, m: int) -> tuple[Step, State]:
        """The step and the initial state of one member."""
        step = jax.tree.map(lambda leaf: leaf[m], self.step) if self.own_step else self.step
        return step, jax.tree.map(lambda leaf: np.asarray(leaf)[m], self.states)

    def select(self, which: slice | np.ndarray) -> Plan:
        """The plan for some of the members."""

        def rows_of_members(x: Numbers) -> Numbers:
            return devices.on_host(x)[which]

        step = jax.tree.map(rows_of_members, self.step) if self.own_step else self.step
        return dataclasses.replace(self, step=step, states=jax.tree.map(rows_of_members, self.states))

    def split(self) -> Split:
        """The members of the parts of the run, in whole chunks of its store."""
        count = 1 if self.part is None else self.part[1]
        most = chunk_members(self.members, count, self.row_bytes, self.num_saves + 1, self.is_remote)
        return Split.into_parts(self.members, count, most)

    def of_part(self) -> Plan:
        """The plan of this process: of the members of its part, whose states are made now if a function makes them."""
        if self.part is None or self.part_members is not None:
            return self
        members = self.split().part(self.part[0])
        plan = self.select(slice(members.start, members.stop))
        if self.make_states is not None:
            states = promoted(self.step, self.make_states.make(members))[1]
            states, shared = _checked_states(self.step, states, members)
            plan = dataclasses.replace(plan, states=states, shared_time=shared)
            _check_members(plan, members.start)
        return dataclasses.replace(plan, part_members=members)

    @property
    def is_remote(self) -> bool:
        """Whether the store is in object storage."""
        return self.store is not None and isinstance(address(self.store.path), Url)

    @property
    def row_bytes(self) -> int:
        """The bytes of a member in a saved row: its states, a residual and a flag."""
        return max(sum(leaf.nbytes for leaf in jax.tree.leaves(self.as_saved(self.states))) // self.members + 9, 24)

    def buffer_rows(self, across: int) -> int:
        """The number of saves per call of the loop and per chunk of a store with `across` members to a chunk."""
        interval = max(self.num_steps // max(self.num_saves, 1), 1)
        return rows_of_call(across, self.members, self.row_bytes, interval, self.num_saves + 1, self.is_remote)

    def first_change(self, value: Any, reached: Any) -> Change | None:
        """What is known of the reduced quantity at the start, of this value; the condition is `reached` or not."""
        if value is None:
            return None
        if not self.per_member:
            return Change(*(np.full(len(value), x, self.dtype) for x in (np.inf, -np.inf, 0, 0)))
        first = None
        if self.condition is not None:
            t = np.asarray(self.states.t) if self.own_times else self.times[0]
            never = np.full(len(value), np.nan, self.dtype)
            first = never if reached is None else np.where(np.asarray(reached), t, never).astype(self.dtype)
        return Change(value, value, value, np.zeros_like(value), value, first)

    @property
    def series_names(self) -> tuple[str, ...]:
        """The names of the series of a reduction, but for those of parts."""
        return () if self.reduction is None else SERIES[3:] if self.per_member else SERIES

    @property
    def change_names(self) -> tuple[str, ...]:
        """The names of the arrays of what is known of it."""
        if self.reduction is None:
            return ()
        return Change._fields[: 4 + self.per_member + (self.condition is not None)]


def make_plan(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    *,
    save_every: int | None = 1,
    own_step: bool = False,
    reduce: Reduction | Literal["energy"] | None = None,
    per: Literal["member"] | None = None,
    first: Reduction | None = None,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
    threads: int | None = None,
    same_bits: bool = True,
    epoch: DateLike | None = None,
) -> Plan:
    """The checked plan of a run; arguments and errors as in `li.run`."""
    if own_step:
        check_own_steps(step, members if callable(states) else len(states.p))
    if not callable(states):
        with _checks.on_host():
            step, states, _ = promoted(checked_step(step), states)
    batch = callable(states) or is_batch(step, states, own_step)
    if own_step and not batch:
        raise ValueError("own_step=True is for a batch, and these states are of one body")
    if save_every == 1 and (save_at is not None or per is not None):
        save_every = None  # that is, not given
    _check_reduction(reduce, per, first, over_saves=save_every is not None or save_at is not None)
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")
    k, count = (0, 1) if part is None else part_of_task() if part == "auto" else checked_part(part)
    maker = made_states(states, members)
    threads = None if threads is None else _checks.count("threads", threads, 1)
    chosen_devices = devices.checked_mesh(mesh)
    threads = threads or (devices.count_cores() if mesh is None else chosen_devices.size)
    with _checks.on_host():
        # in parts the states of one member stand for those of all, which each part makes for itself
        chosen = range(0) if maker is None else range(1 if count > 1 else maker.members)
        chosen_step, chosen_states = step, cast("State", states)
        if maker is not None:
            chosen_step = jax.tree.map(lambda x: x[: len(chosen)], step) if own_step else step
            chosen_step, chosen_states, _ = promoted(checked_step(chosen_step), maker.make(chosen))
        chosen_states = chosen_states if batch else with_member_axis(chosen_states)
        dtype = np.dtype(chosen_states.p.dtype)
        check_inertias(chosen_step, own_step)
        initial, is_shared = _checked_states(chosen_step, chosen_states, None if maker is None else chosen)
        clock, planned_steps = _make_clock(chosen_step, initial, is_shared, dtype, dt, num_steps, times)
        if save_at is None:
            interval, num_saves = intervals(planned_steps, save_every)
            _check_size(initial, num_saves + 1, reduce is not None, store)
            nodes, rests = interval * np.arange(num_saves + 1), None
            entries = np.asarray(clock.time(nodes if isinstance(clock, GridClock) else nodes.astype(dtype)))
        else:
            refuse_times(chosen_step, "save_at")
            if save_every is not None or reduce is not None:
                raise ValueError(f"pass save_at or {'save_every' if reduce is None else 'reduce'}, not both")
            interval = None
            entries = np.concatenate([[clock.time(0)], outputs(save_at, clock, planned_steps, dtype)])
            nodes = np.asarray(jax.vmap(lambda t: clock.node(t, planned_steps))(entries))
            rests = entries - np.asarray(clock.time(nodes)).astype(dtype)
            _check_size(initial, len(entries), False, store)
        plan = Plan(
            step=chosen_step,
            states=initial,
            own_step=own_step,
            batch=batch,
            shared_time=is_shared,
            make_states=maker,
            clock=clock,
            dt=None if dt is None else float(dt),
            planned_steps=planned_steps,
            times=entries,
            nodes=nodes,
            rests=rests,
            save_every=interval,
            reduction=_function(energy if reduce == "energy" else reduce),
            per_member=per is not None,
            condition=_function(first),
            epoch="" if epoch is None else text_of(epoch),
            store=None if store is None else StoreOptions.of(store),
            part=(k, count) if count > 1 else None,
            resume=resume or part is not None,
            same_bits=same_bits,
            mesh=chosen_devices,
            threads=threads,
            progress=progress,
        )
        _check_members(plan, 0)
        _check_functions(plan)
        _checks.time_resolution(None if chosen_step.own_time else initial.t, plan.first_dt, planned_steps)
        if maker is None or count == 1:
            return plan
        whole = promoted(checked_step(step), chosen_states)[0]
        repeated = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x)[:1], (maker.members, *x.shape[1:])), initial)
        return dataclasses.replace(plan, step=whole, states=repeated)


def is_batch(step: Step, states: State, own_step: bool) -> bool:
    """Whether states have one axis more than the phase space of the step's system needs."""
    if own_step:
        step = jax.tree.map(lambda x: x[0], step)
    leaves, structure = jax.tree.flatten(step.system.phase_space)
    needed = _shapes_of_origin(structure, tuple(np.shape(x) for x in leaves))
    q, p = np.shape(states.q), np.shape(states.p)
    more = len(q) - len(needed[0])
    if more != len(p) - len(needed[1]) or more not in (0, 1):
        raise ValueError(
            f"states of {type(step.system).__name__} have q of shape {needed[0]} and p of shape {needed[1]}, those of "
            f"a batch one leading axis more; got q {q} and p {p}"
        )
    return more == 1


@functools.cache
def _shapes_of_origin(structure: Any, shapes: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
    """The shapes of q and of p of one body, in a phase space of this structure with arrays of these shapes."""
    arrays = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
    origin = jax.eval_shape(lambda *x: jax.tree.unflatten(structure, x).origin, *arrays)
    return origin.q.shape, origin.p.shape


def check_own_steps(step: Step, members: int | None) -> None:
    """Raise ValueError unless all leaves of a step have a leading axis of so many members."""
    shapes = [np.shape(x) for x in jax.tree.leaves(checked_step(step))]
    if any(shape[:1] != (members,) for shape in shapes):
        got = ", ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(
            f"own_step=True needs a step for each of {members} members, made by jax.vmap, so that every leaf has a "
            f"leading member axis; got leaves of shapes {got}"
        )


def _check_reduction(reduce: object, per: object, first: object, over_saves: bool) -> None:
    """Raise ValueError unless these arguments fit; `over_saves` if save_every or save_at was given."""
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if per is None and first is None:
        return
    if per != "member":
        raise ValueError(f'per must be None or "member", which `first` needs; got {per!r}')
    if reduce is None:
        raise ValueError('per="member" is of a quantity: give reduce="energy" or a function (step, state) ↦ scalar')
    if first is not None and not callable(first):
        raise ValueError(f"first must be a function (step, state) ↦ True or False, got {first!r}")
    if over_saves:
        raise ValueError('per="member" is over all steps: give no save_every and no save_at')


def _function(function: Reduction | None) -> Reduction | None:
    """A function of the user's, as a pytree if it has numbers."""
    return function if function is None or jax.tree_util.all_leaves([function]) else callable_pytree(function)


def _check_size(states: State, entries: int, reduced: bool, store: object) -> None:
    """Raise ValueError if the results of a run exceed this machine's memory: its states or series, and its times."""
    size, advice = _ENTRY, "use a larger save_every"
    if reduced:
        size += _SERIES
    elif store is None:
        size += _checks.entry_size(states, len(states.p))
        advice += " or store=PATH.zarr, which needs memory for one chunk only"
    _checks.fits_memory(entries, size, advice)


def _make_clock(
    step: Step,
    states: State,
    is_shared: bool,
    dtype: np.dtype,
    dt: jax.typing.ArrayLike | None,
    num_steps: int | None,
    times: ArrayLike | None,
) -> tuple[Clock, int]:
    """The clock of the steps, as host arrays, and their number; since the start if members start at different times."""
    if states.t is not None and not is_shared and not step.own_time and times is not None:
        raise ValueError("times hold for all members: give all members the same states.t, or none")
    t: Any = np.asarray(states.t)[0] if is_shared else None
    clock, planned_steps = clock_of(step, states._replace(t=t), dtype, dt, num_steps, times)
    if isinstance(clock, UniformClock) and clock.t0 is None:
        clock = UniformClock(jnp.zeros((), dtype), clock.dt)
    return jax.tree.map(np.asarray, clock), planned_steps


def _checked_states(step: Step, states: State, made: range | None) -> tuple[State, bool]:
    """The checked states with the member axis on every leaf, and whether they share a time that the step does not set.

    Equal times of members that a function has `made` are not a shared one: those of a part do not show whether all are
    equal.
    """
    first = 0 if made is None else made.start
    for name, x in leaves_by_name(states).items():
        _checks.plain(f"states.{_python_name(name)}", x)
    shapes = {name: np.shape(x) for name, x in leaves_by_name(states).items()}
    for key in states.extra or {}:
        if not str(key).isidentifier():
            raise ValueError(f'a key of states.extra must be an identifier, such as "rotor", got {key!r}')
    counts = {shape[:1] for name, shape in shapes.items() if shape or name not in _SCALARS}
    short = [name for name in ("q", "p") if len(shapes[name]) < 2]
    if len(counts) != 1 or (0,) in counts or short or any(len(shapes.get(name, ())) > 1 for name in _SCALARS):
        got = ", ".join(f"{_python_name(name)} {shape}" for name, shape in shapes.items())
        raise ValueError(f"states need a leading member axis on every leaf, but t and work may be scalars; got {got}")
    [(members,)] = counts
    for name, x in leaves_by_name(states).items():
        bad = np.flatnonzero(~np.isfinite(np.asarray(x)).reshape(len(x) if x.ndim else 1, -1).all(axis=1))
        if bad.size:
            where = f", and is not finite for {list_members(bad + first)}" if x.ndim else f", got {x}"
            raise ValueError(f"states.{_python_name(name)} must be finite{where}")
    states = jax.tree.map(np.asarray, states)
    t = states.t
    is_shared = t is not None and not step.own_time and (not t.ndim or (made is None and bool(np.all(t == t[0]))))

    def of_each(x: Any) -> Any:
        return x if x is None else np.broadcast_to(x, (members,))

    return states._replace(t=of_each(t), work=of_each(states.work)), is_shared


def _check_members(plan: Plan, first: int) -> None:
    """Raise ValueError unless all states are those of the step's system."""
    step, state = plan.member(0)
    check_own_step(plan.step.system, state, plan.members, plan.own_step)
    defect = np.abs(np.asarray(_defects(plan.step.system.phase_space, plan.states)))
    bad = np.flatnonzero(defect > 2 * _checks.UNIT_TOLERANCE)  # |q|² − 1 is twice the error of |q|
    if bad.size:
        raise ValueError(
            f"states.q is off the configuration space by more than {_checks.UNIT_TOLERANCE:g}: "
            f"{list_members(bad + first)} (worst defect {defect.max():.3g}); make states with system.state(...)"
        )
    step.system.check(state)  # the shapes, and the time of a driven system, are the same for all members


def _check_functions(plan: Plan) -> None:
    """Raise ValueError unless the reduced quantity and the condition return what they should."""
    if plan.reduction is not None:
        _check_once(_check_result, plan.reduction, *plan.member(0))
    if plan.condition is not None:
        _check_once(_check_condition, plan.condition, *plan.member(0))


def _check_once(check: Callable[..., None], function: Reduction, *arguments: Any) -> None:
    """Check what a function returns, unless it is known from an earlier run."""
    make_once(check, function, (), arguments, reads(function, jax.tree.structure(arguments)))


@rereading_jit
def _defects(phase_space: PhaseSpace, states: State) -> Array:
    return jax.vmap(phase_space.defect)(states)


def _value(name: str, function: Reduction, arguments: tuple[Step, State]) -> object:
    """What a function of the user's returns for a step and a state, in shape and type."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        raise ValueError(f"{name} must be a function of two arguments, (step, state) ↦ scalar: {error}") from None
    except ValueError:  # a function without a signature
        pass
    values: list[object] = []
    jax.eval_shape(lambda step, state: values.append(function(step, state)), *arguments)  # pyright: ignore
    return values[0]


def _check_condition(condition: Reduction, _: tuple[()], arguments: tuple[Step, State]) -> None:
    """Raise ValueError unless the condition is a flag, a function of a step and a state."""
    value: Any = _value("first", condition, arguments)
    if np.shape(value) != () or jnp.result_type(value).kind != "b":
        raise ValueError(f"first must return True or False for a step and a state, got {value!r}")


def _check_result(reduction: Reduction, _: tuple[()], arguments: tuple[Step, State]) -> None:
    """Raise ValueError unless the reduced quantity is a real scalar function of a step and a state."""
    value: Any = _value("reduce", reduction, arguments)
    array = isinstance(value, Array | np.ndarray | np.generic)
    is_real = array and value.shape == () and jnp.issubdtype(value.dtype, jnp.floating)
    if not (is_real or isinstance(value, float)):
        got = f"{value.dtype} of shape {value.shape}" if array else repr(value)
        raise ValueError(
            f"reduce must return a real floating-point scalar, got {got}; return one component of a vector or "
            "its norm, and 1.0 * x for an integer x"
        )


def _python_name(name: str) -> str:
    """The name of an array of the states, as written in Python."""
    return f'extra["{name.removeprefix("extra.")}"]' if name.startswith("extra.") else name


def rows_of_call(across: int, members: int, row: int, interval: int, entries: int, remote: bool) -> int:
    """The number of saves per call of the loop and per chunk.

    Args:
        across: the members of a chunk.
        members: those of the process.
        row: the bytes of a member in a saved row.
        interval: the steps between two saves.
        entries: the entries of the run.
        remote: whether a chunk is an object in object storage.
    """
    most_bytes, most_work = (_OBJECT_BYTES, _OBJECT_WORK) if remote else (_CHUNK_BYTES, _CHUNK_WORK)
    enough = min(most_bytes // (across * row), _BUFFER_BYTES // (members * row))
    return int(max(1, min(enough, most_work // (members * interval), entries)))


def chunk_members(members: int, count: int, row: int, entries: int, remote: bool) -> int:
    """The most members in a chunk of a run of `count` parts, of which a saved row has `row` bytes for each member.

    Where a chunk is an object in a bucket it has members enough that it can become as large as it should: a part holds
    the rows of all of its members in memory, which limits the number of rows.
    """
    if not remote:
        return CHUNK_MEMBERS
    return max(CHUNK_MEMBERS, members // (count * _CHUNKS_OF_BUFFER), _OBJECT_BYTES // (row * entries))


def list_members(which: np.ndarray) -> str:
    """The number of some members and the numbers of the first of them, for messages."""
    more = ", …" if which.size > MAX_NAMED else ""
    return f"{which.size} member(s): {', '.join(map(str, which[:MAX_NAMED]))}{more}"
