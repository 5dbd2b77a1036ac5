"""The description of an integration, and its results."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from lieint_jax.runs._job import devices
from lieint_jax.runs._job.devices import Numbers, Tree
from lieint_jax.runs._job.loop import Change, Reduction
from lieint_jax.runs._job.made_states import MadeStates
from lieint_jax.runs._march.clock import Clock
from lieint_jax.runs._storage.leaves import Saves, shared_time
from lieint_jax.types import State, Step, Trajectory

_CHUNK_BYTES, _BUFFER_BYTES = 2**22, 2**28  # the most bytes in a chunk on disk, and in the buffer of all members' saves
_CHUNK_WORK = 2e8  # the most body-steps between two writes, unless one save interval has more
_OBJECT_BYTES, _OBJECT_WORK = 2**26, 2e10  # the same in object storage: q has up to 37 MB, minutes of a core
CHUNK_MEMBERS = 8192  # the most members in a chunk on disk
MAX_NAMED = 5  # members in a message
Series = dict[str, np.ndarray]  # of a reduction, by name
SERIES = ("least", "greatest", "mean", "residual", "unconverged")  # their names; of single members only the last two
_CHUNKS_OF_BUFFER = _BUFFER_BYTES // _OBJECT_BYTES  # so many such chunks fill the buffer


class Summary(NamedTuple):
    """The result of a run with `reduce`. Time is the axis of all fields but the last two; entry 0 is the start.

    Attributes:
        t: times, shape (n+1,).
        least, greatest, mean: the least, greatest and mean change of the reduced quantity since the start, over all
            members and all steps since the previous entry.
        residual: the largest residual over the same members and steps.
        unconverged: the number of members with a step that did not converge since the previous entry.
        state: the states at the end, (members, …).
        failed: the first step of each member that did not converge, or −1.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    mean: np.ndarray
    residual: np.ndarray
    unconverged: np.ndarray
    state: State
    failed: np.ndarray


class MemberSummary(NamedTuple):
    """The result of a run with `reduce` and `per="member"`, over all steps of each member, the start included.

    Attributes:
        t: the times of the start and of the end, (2,).
        least, greatest, total, last: the least, the greatest, the sum and the last value of the quantity, (members,).
        first: the first time at which the condition `first` was true, NaN if never, (members,); None without one.
        residual, unconverged: of the start and of all steps, as in `Summary`, (2,).
        number: the number of values of a member.
        state: the states at the end, (members, …).
        failed: the first step of each member that did not converge, or −1.
        excess: what rounding has added to the sum, (members,), from which it is continued.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    total: np.ndarray
    last: np.ndarray
    first: np.ndarray | None
    residual: np.ndarray
    unconverged: np.ndarray
    number: int
    state: State
    failed: np.ndarray
    excess: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The mean of the quantity over the values, (members,)."""
        return self.total / self.number

    @property
    def change(self) -> Change:
        """The values of the quantity."""
        return Change(self.least, self.greatest, self.total, self.excess, self.last, self.first)


class Job(NamedTuple):
    """An integration that is to be computed.

    Attributes:
        step: the step; with the member axis on its leaves if `step_axis` is 0.
        states: the initial states without their time, with the member axis on every leaf.
        t0: the time of the initial states: shape () if the members share it, else (members,). None if they have no
            time, or if the step has a time of its own, which then is part of the states.
        dt: the step size given by the caller; None if times were given.
        clock: the times of the steps; since the start, if the states have no time or each member has its own.
        planned_steps: the number of steps that the caller asked for; the run ends at its last entry.
        times: the times of all entries on this clock, that of the start first.
        nodes: the number of whole steps before each entry.
        rests: the size of the shorter step from its node to each entry, 0 for the start; None if all entries are at
            nodes.
        save_every: the number of steps between saves; None with `rests`.
        step_axis: None or 0.
        reduction: the quantity to reduce, or None.
        per_member: whether the reduction is of each member over all steps.
        condition: the condition (step, state) ↦ flag whose first time is recorded for each member, or None.
        part: the members of the run to which this job is restricted, one of its parts; None if it is the whole run.
        batch: False for a run of one body, which is a batch of one member.
        epoch: the date of t = 0, as text, or "".
        make_states: the function that makes the states of each part; `states` of the whole run are those of its first
            member, repeated. None if `states` are those of all members.
    """

    step: Step
    states: State
    t0: Numbers | None
    dt: float | None
    clock: Clock
    planned_steps: int
    times: np.ndarray
    nodes: np.ndarray
    rests: np.ndarray | None
    save_every: int | None
    step_axis: int | None
    reduction: Reduction | None
    per_member: bool = False
    condition: Reduction | None = None
    part: range | None = None
    batch: bool = True
    epoch: str = ""
    make_states: MadeStates | None = None

    def restricted(self, members: range) -> Job:
        """The job of one of the run's parts, of these members only."""
        return self.select(slice(members.start, members.stop))._replace(part=members)

    def select(self, which: slice | np.ndarray) -> Job:
        """The job of some of the members."""

        def of(x: Numbers) -> Numbers:
            return devices.on_host(x)[which]

        step = self.step if self.step_axis is None else jax.tree.map(of, self.step)
        t0: Any = of(self.t0) if self.own_times else self.t0  # pyright: ignore
        return self._replace(step=step, states=jax.tree.map(of, self.states), t0=t0)

    @property
    def first_member(self) -> int:
        """The number in the run of the first member of this job."""
        return 0 if self.part is None else self.part.start

    @property
    def initial(self) -> State:
        """The initial states with their time."""
        return self.states if self.t0 is None else self.states._replace(t=self.t0)

    @property
    def num_steps(self) -> int:
        """The total number of steps."""
        return int(self.nodes[-1])

    @property
    def num_saves(self) -> int:
        """The number of entries after the start."""
        return len(self.nodes) - 1

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the states."""
        return np.dtype(self.states.p.dtype)

    @property
    def first_dt(self) -> float:
        """The size of the first step."""
        return self.dt or (float(self.clock.size(0)) if self.planned_steps else 0.0)

    @property
    def own_times(self) -> bool:
        """True if the members start at different times; False too if their states have a time each by their step."""
        return self.t0 is not None and np.ndim(self.t0) > 0

    def state_times(self, entries: slice = slice(None), members: slice = slice(None)) -> np.ndarray:
        """The times of these members at these entries, (entries, members), where the states have a time."""
        if self.own_times:
            return np.asarray(self.t0)[members] + self.times[entries, None]
        return shared_time(self.times[entries], self.members)[:, members]

    def first_change(self, value: Any, reached: Any) -> Change | None:
        """What is known of the reduced quantity at the start, of this value; the condition is `reached` or not."""
        if value is None:
            return None
        if not self.per_member:
            return Change(*(np.full(len(value), x, self.dtype) for x in (np.inf, -np.inf, 0, 0)))
        first = None
        if self.condition is not None:
            t = np.asarray(self.t0) if self.own_times else self.times[0]
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

    def member(self, m: int) -> tuple[Step, State]:
        """The step and the initial state of one member."""
        step = self.step if self.step_axis is None else jax.tree.map(lambda leaf: leaf[m], self.step)
        state = jax.tree.map(lambda leaf: np.asarray(leaf)[m], self.states)
        if self.t0 is not None:
            state = state._replace(t=self.t0[m] if self.own_times else self.t0)
        return step, state

    @property
    def members(self) -> int:
        """The number of members."""
        return self.states.p.shape[0]

    def buffer_rows(self, across: int, remote: bool = False) -> int:
        """The number of saves per call of the loop and per chunk of a store with `across` members to a chunk.

        If `remote`, a chunk is an object in object storage, and each of them a request.
        """
        interval = max(self.num_steps // max(self.num_saves, 1), 1)
        return rows_of_call(across, self.members, self.row_bytes, interval, self.num_saves + 1, remote)

    @property
    def row_bytes(self) -> int:
        """The bytes of a member in a saved row: its states, a residual and a flag."""
        return max(sum(leaf.nbytes for leaf in jax.tree.leaves(self.states)) // self.members + 9, 24)


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


def member_of(found: Any, k: int) -> Any:
    """The trajectory of member k, or the summary of a run of one body without its member axis."""
    if isinstance(found, Trajectory):
        state, info = jax.tree.map(lambda x: np.asarray(x[:, k]), (found.state, found.info))
        return Trajectory(found.t if state.t is None else state.t, state, info)
    return found._replace(**jax.tree.map(lambda x: x[k], _of_members(found)))


def _of_members(summary: Summary | MemberSummary) -> dict[str, Tree]:
    """The fields of a summary that have a member axis."""
    names = ("state", "failed", *(Change._fields if isinstance(summary, MemberSummary) else ()))
    return {name: x for name, x in summary._asdict().items() if name in names}


def with_member_axis(tree: Tree, axis: int = 0) -> Tree:
    """The arrays of one body with a member axis of length 1."""
    return jax.tree.map(lambda x: np.expand_dims(np.asarray(x), axis), tree)


def saves_of_batch(saves: Saves) -> Saves:
    """The saves of a run of one body with a member axis."""
    found: Any = saves.found
    if isinstance(found, Trajectory):
        found = Trajectory(found.t, *with_member_axis((found.state, found.info), 1))
    else:
        found = found._replace(**with_member_axis(_of_members(found)))
    return Saves(found, with_member_axis(saves.failed))
