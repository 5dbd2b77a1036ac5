"""A run: what a step and states make, of one body or many, in memory or on disk, and what can be asked of it."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.runs._interpolate import interpolate, interpolate_members
from lieint_jax.runs._job import Saves, list_members
from lieint_jax.runs._loop import Reduction
from lieint_jax.runs._made_states import MakeStates
from lieint_jax.runs._results import Results, compute, untransformed
from lieint_jax.runs.store._identity import package_versions
from lieint_jax.runs.store._reading import Stored, open_with_step
from lieint_jax.runs.store._storage import address
from lieint_jax.runs.store._store import leaves_by_name
from lieint_jax.runs.store._store_options import StoreOptions
from lieint_jax.types import (
    State,
    Step,
    StepInfo,
    System,
    Trajectory,
    callable_pytree,
    checked_step,
    energy_less_work,
    labeled,
    promoted,
    pytree,
    static,
)

Tree = Any  # a tree of arrays
_BLOCK = 2**26  # bytes of states that `map` reads from disk at once


class Facts(NamedTuple):
    """What is known of a run beside its numbers.

    Attributes:
        batch: whether it has a member axis.
        own_step: whether each member has a step of its own; then the step's leaves have the member axis, too.
        dt: the step size; None if times were given.
        num_steps: the number of steps that were asked for.
        save_every: the number of steps between saves; None if output times were given.
        engine: what computed it, "native" (machine code), "flat" or "xla".
        versions: the versions of packages that computed it, by name.
        complete: whether it has reached its last step.
        source: the path or URL of the store from which its arrays are read; "" if they are in memory.
    """

    batch: bool
    own_step: bool
    dt: float | None
    num_steps: int
    save_every: int | None
    engine: str
    versions: tuple[tuple[str, str], ...]
    complete: bool = True
    source: str = ""


@pytree
class Run:
    """The states, or a summary of them, that a step made of initial states.

    In memory a run is a pytree, which can be passed to a function under jit or grad. The arrays of a run on disk are
    read where they are indexed: `load` brings it to memory.

    Attributes:
        step: the step; with the member axis on its leaves if `own_step`.
        start: the initial states of a reduced run, to continue it; None if there is an entry of them, or no memory.
        trajectory: the saved states: a `Trajectory` with the axes (time, …), or (time, member, …); None if the run was
            reduced.
        summary: a `Summary` of a reduced run, else None.
        failed: the first step that did not converge, or −1, for each member.
        reduction: the quantity that was reduced, or None.
        facts: see `Facts`.
    """

    step: Step
    start: State | None
    trajectory: Any
    summary: Any
    failed: Array
    reduction: Any
    facts: Facts = static()

    @property
    def t(self) -> Array:
        """The times (times,) of the saves."""
        return (self.summary if self.trajectory is None else self.trajectory).t

    @property
    def state(self) -> State:
        """The saved states, (times, …) or (times, members, …)."""
        return self._saved.state

    @property
    def info(self) -> StepInfo:
        """The report of the steps since the save before."""
        return self._saved.info

    @property
    def system(self) -> System:
        """The system of the step; with the member axis on its leaves if `own_step`."""
        return self.step.system

    @property
    def dt(self) -> float | None:
        """The step size; None if the run had given times."""
        return self.facts.dt

    @property
    def members(self) -> int | None:
        """The number of members; None for one body."""
        return len(self.failed) if self.facts.batch else None

    @property
    def own_step(self) -> bool:
        """Whether each member has a step of its own."""
        return self.facts.own_step

    @property
    def engine(self) -> str:
        """What computed the run: "native" (machine code), "flat" or "xla"."""
        return self.facts.engine

    @property
    def versions(self) -> dict[str, str]:
        """The versions of the packages that computed it."""
        return dict(self.facts.versions)

    @property
    def converged(self) -> Array:
        """Whether all steps converged, for each member."""
        return self.failed < 0

    @property
    def _saved(self) -> Trajectory:
        if self.trajectory is None:
            raise ValueError("the run was reduced and has no states but the last ones: see run.summary")
        return self.trajectory

    def member(self, k: int) -> Run:
        """The run of member k, as one of one body."""
        if self.members is None:
            raise ValueError("the run is of one body and has no members")
        if not -self.members <= k < self.members:
            raise ValueError(f"the run has {self.members} members, numbered from 0, got {k}")
        found = _member_of(self._saved, k)
        step = jax.tree.map(lambda x: x[k], self.step) if self.own_step else self.step
        facts = self.facts._replace(batch=False, own_step=False, source="")
        return Run(step, None, found, None, self.failed[k], None, facts)

    def load(self) -> Run:
        """The run with its arrays in memory, so that it can be passed to functions under jit."""
        found: Run = jax.tree.map(np.asarray, self)
        return Run(**vars(found) | {"facts": self.facts._replace(source="")})

    def map(self, function: Callable[[Step, State], Tree]) -> Tree:
        """The values of function(step, state) for one saved state of one member, along the run.

        Of a run on disk as much is read at once as fits into 64 MiB.

        Args:
            function: of the step, with its `step.system`, and a state ↦ any tree of arrays.

        Returns:
            The tree with the axes (times, …), or (times, members, …).
        """
        if not callable(function):
            raise ValueError(f"run.map needs a function (step, state) ↦ tree of arrays, got {function!r}")
        saved = self._saved.state
        whole = callable_pytree(function)
        numbers, structure = jax.tree.flatten(whole)
        along = _along(structure, self.facts.batch, self.own_step)
        if not self.facts.source:
            return along(numbers, self.step, saved)
        size = sum(x.dtype.itemsize * math.prod(x.shape[1:]) for x in jax.tree.leaves(saved))
        rows = max(1, _BLOCK // max(size, 1))

        def block(k: int) -> Tree:
            return along(numbers, self.step, jax.tree.map(lambda x: np.asarray(x[k : k + rows]), saved))

        return jax.tree.map(lambda *x: np.concatenate(x), *map(block, range(0, len(self.t), rows)))

    def at(self, times: ArrayLike) -> State:
        """The states between the saved ones, by `interpolate`: for pictures, not to round-off.

        Args:
            times: times (m,) inside the run, in any order; of members that start at different times, since the start.

        Returns:
            The states, with the axes (m, …), or (m, members, …).

        Raises:
            ValueError: times outside the run; too few saved states; a batch whose step has its own time.
        """
        run = self.load()
        if not self.facts.batch:
            return interpolate(run.system, run.trajectory, times)
        if self.step.own_time:
            raise ValueError("each member has its own times: give run.member(k).at(times)")
        return interpolate_members(run.system, run.trajectory, times, 0 if self.own_step else None)

    def energy_error(self) -> Array:
        """H − W less its first value, (times,) or (times, members); W is the work, where the states count it."""
        return _from_start(self.map(_energy))

    def momentum_error(self) -> Array:
        """The momentum map less its first value, (times, k) or (times, members, k)."""
        return _from_start(self.map(_momentum))

    def constraint_error(self) -> Array:
        """The distance of q from the configuration space, (times,) or (times, members)."""
        return self.map(_defect)

    def periods(self) -> Any:
        """The mean periods of precession and rotation of a tumbling body at each save: `body.periods`.

        Raises:
            ValueError: the system has no periods.
        """
        if not hasattr(self.system, "periods"):
            raise ValueError(f"the system of the run must have periods, as bodies on T*SO(3) do; got {self.system!r}")
        return self.map(_periods)

    def rotations(self) -> Any:
        """The attitudes, body to space, as `scipy.spatial.transform.Rotation`: see `Trajectory.rotations`."""
        return labeled.rotations(self._saved)

    def to_xarray(self, units: Mapping[str, str] | None = None) -> Any:
        """The run as an `xarray.Dataset` with energy, momentum map and angular velocity: see `Trajectory.to_xarray`."""
        return labeled.dataset(self.load().trajectory, self.system, units or {}, 0 if self.own_step else None)

    def to_dataframe(self) -> Any:
        """The run as a `pandas.DataFrame`: a row for each time and member, a column for each component.

        The columns are time, member (of a batch), q_w, …, p_x, …, residual, converged, energy, momentum_map_0, …

        Raises:
            ImportError: pandas is not installed.
        """
        return labeled.frame(self.load().trajectory, self.system, 0 if self.own_step else None)

    def extend(self, num_steps: int, progress: bool = True) -> Run:
        """The run with `num_steps` further steps, bit for bit the run of all these steps.

        Raises:
            ValueError: the run has given times or output times, is not complete, or is on disk.
        """
        facts = self.facts
        if facts.source:
            raise ValueError(f"the run is in {facts.source}: bring it to memory first, run.load().extend({num_steps})")
        if facts.dt is None or facts.save_every is None:
            raise ValueError("a run at given times cannot be extended: start another one from its last state")
        start = self.start if self.trajectory is None else jax.tree.map(lambda x: x[0], self.state)
        if start is None or not facts.complete:
            raise ValueError("the run is not complete, or was reduced and read from disk: it cannot be extended")
        found = self.trajectory if self.summary is None else self.summary
        total = facts.num_steps + _checks.count("num_steps", num_steps, 0)
        earlier, step = Saves(*jax.tree.map(np.asarray, (found, self.failed))), self.step
        if not facts.batch:
            start, earlier = _with_member_axis(start), _saves_of_batch(earlier)
        computed = compute(
            step,
            start,
            facts.dt,
            total,
            save_every=facts.save_every,
            step_axis=0 if facts.own_step else None,
            reduce=self.reduction,
            progress=progress,
            earlier=earlier,
        )
        return _run_of(computed, facts.batch)

    def __repr__(self) -> str:
        return "\n".join(f"{name:<10} {text}" for name, text in _lines(self).items())

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{html.escape(k)}</th><td>{html.escape(x)}</td></tr>" for k, x in _lines(self).items())
        return f"<table>{''.join(rows)}</table>"


@lru_cache(16)
def _along(structure: Any, batch: bool, own_step: bool) -> Callable[..., Tree]:
    """A function of step and state of this structure, compiled for all states of a run."""

    def along(numbers: list[Array], step: Step, states: State) -> Tree:
        function: Any = jax.tree.unflatten(structure, numbers)
        if batch:
            function = jax.vmap(function, (0 if own_step else None, 0))
        return jax.vmap(function, (None, 0))(step, states)

    return jax.jit(along)


def _energy(step: Step, state: State) -> Array:
    return energy_less_work(step.system, state)


def _momentum(step: Step, state: State) -> Array:
    return step.system.momentum(state)


def _defect(step: Step, state: State) -> Array:
    return step.system.phase_space.defect(state)


def _periods(step: Any, state: State) -> Any:
    return step.system.periods(state)


def _from_start(series: Array) -> Array:
    return series - series[:1]


@untransformed("li.run")
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    *,
    save_every: int | None = 1,
    own_step: bool = False,
    reduce: Reduction | Literal["energy"] | None = None,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
    threads: int | None = None,
) -> Run:
    """Run a step from initial states, of one body or of many, in memory or into a store that can be resumed.

    On a CPU the loop is machine code for vectors of members, in one thread per core (`lieint_jax.native`). Steps that
    cannot be compiled this way (a LAPACK call that depends on the state, very many bodies) and other devices use XLA.

    The bits of machine code depend neither on threads, processes and parts nor on whether the run was resumed; those of
    XLA may depend on the numbers of members and devices. With `jax.distributed`, every process calls this with the same
    arguments and gets the same results.

    Args:
        step: a scheme's step; with `own_step=True` its leaves carry the member axis too (one inertia per member).
        states: the initial state of one body; or those of a batch, whose arrays have a leading member axis, so one axis
            more. A time t of shape () is shared by all members, and so is one of shape (members,) whose values are
            equal: then what depends on it alone, such as the position on an orbit, is computed once per step. `work` of
            shape () is that of every member. Or a function of member numbers (m,), which returns the states of these
            members: then a part makes only its own. It is called for consecutive numbers, up to 65 536 at once, must
            return the same for the same numbers in every process, and shares a time only by one of shape ().
        dt: step size, the same for all members.
        num_steps: number of steps, a multiple of `save_every`.
        save_every: number of steps between saved states; None saves the last state only.
        own_step: each member has a step of its own, made by `jax.vmap`.
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
            `part_of_task`. In machine code all parts have the bits of one process.
        members: the number of members, where `states` is a function.
        threads: the number of threads of machine code.

    Returns:
        A `Run`. Its t is t₀ + nΔt, where t₀ is the shared time of the members, or 0; times since the start, if members
        start at different times; nΔt, if the step has its `own_time` and the run is a batch, whose members have their
        own times in `run.state.t`. With `store`, its arrays are read from disk when they are indexed. With `part`, it
        is that of the members of the part; `li.open` returns that of all.

    Raises:
        TypeError: the call is inside of jit, vmap, grad or jvp: use `integrate` there.
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
    batch = callable(states) or _is_batch(step, states, own_step)
    if own_step and not batch:
        raise ValueError("own_step=True is for a batch, and these states are of one body")
    computed = compute(
        step,
        states if batch else _with_member_axis(states),
        dt,
        num_steps,
        save_every=None if save_at is not None and save_every == 1 else save_every,
        step_axis=0 if own_step else None,
        reduce=reduce,
        mesh=mesh,
        store=store,
        progress=progress,
        resume=resume,
        times=times,
        save_at=save_at,
        part=part,
        members=members,
        threads=threads,
        batch=batch,
    )
    return _run_of(computed, batch)


def open_run(path: str | Path, own: Mapping[str, object] | None = None) -> Run:
    """The run in a store, as `run` has written it or is writing it. Its arrays are read when they are indexed.

    Args:
        path: a folder NAME.zarr, or a URL such as s3://bucket/NAME.zarr.
        own: classes and functions of the step and its system from outside this package, such as a custom potential, by
            their names in the store. If one is missing, the error message contains its name.

    Returns:
        The run as far as it is in the store. In a store in parts, members of a missing or damaged part, and entries
        that a part has not reached, are NaN.

    Raises:
        ValueError: no store, a damaged one (the message lists the files), one of version 0.1, or a name missing in
            `own`; a reduced run that is not complete.

    Warns:
        RuntimeWarning: parts that are missing, damaged or incomplete, by number.
    """
    place = address(path)
    return _stored_run(str(place), *open_with_step(place, own))


def _run_of(computed: Results, batch: bool) -> Run:
    """The run of these results."""
    job = computed.job
    if computed.stored is not None:
        return _stored_run(computed.path, computed.stored, job.step)
    at_times = job.dt is None or job.rests is not None
    facts = Facts(
        batch=batch,
        own_step=job.step_axis == 0,
        dt=job.dt,
        num_steps=job.planned_steps,
        save_every=None if at_times else job.save_every,
        engine=computed.engine,
        versions=tuple(package_versions().items()),
    )
    start = job.initial if job.reduction is not None else None
    return _made(job.step, start, computed.saves, job.reduction, facts)


def _stored_run(path: str, stored: Stored, step: Step) -> Run:
    """The run in a store; that of one body is read at once."""
    found, failed, attributes = stored
    described = attributes["run"]
    batch = attributes.get("batch", True)
    facts = Facts(
        batch=batch,
        own_step=described["step_axis"] == 0,
        dt=attributes["dt"],
        num_steps=attributes["num_steps"],
        save_every=attributes["save_every"],
        engine=described.get("engine", "xla"),
        versions=tuple(described["versions"].items()),
        complete=attributes["progress"]["complete"],
        source=path,
    )
    return _made(step, None, Saves(found, failed), None, facts)


def _made(step: Step, start: State | None, saves: Saves, reduction: Any, facts: Facts) -> Run:
    """The run of these saves, which have a member axis also if it is of one body."""
    found, failed = saves
    if not facts.batch:
        found, failed = _member_of(found, 0), failed[0]
        start = None if start is None else jax.tree.map(lambda x: x[0] if np.ndim(x) else x, start)
    states = isinstance(found, Trajectory)
    if reduction is not None:
        reduction = callable_pytree(reduction)
    return Run(step, start, found if states else None, None if states else found, failed, reduction, facts)


def _member_of(found: Any, k: int) -> Any:
    """The trajectory of member k, or the summary of a run of one body without its member axis."""
    if isinstance(found, Trajectory):
        state, info = jax.tree.map(lambda x: np.asarray(x[:, k]), (found.state, found.info))
        return Trajectory(found.t if state.t is None else state.t, state, info)
    return found._replace(state=jax.tree.map(lambda x: x[k], found.state), failed=found.failed[k])


def _with_member_axis(tree: Tree, axis: int = 0) -> Tree:
    return jax.tree.map(lambda x: np.expand_dims(np.asarray(x), axis), tree)


def _saves_of_batch(saves: Saves) -> Saves:
    """The saves of a run of one body with a member axis."""
    found: Any = saves.found
    if isinstance(found, Trajectory):
        found = Trajectory(found.t, *_with_member_axis((found.state, found.info), 1))
    else:
        found = found._replace(**_with_member_axis({"state": found.state, "failed": found.failed}))
    return Saves(found, _with_member_axis(saves.failed))


def _is_batch(step: Step, states: State, own_step: bool) -> bool:
    """Whether states have one axis more than the phase space of the step's system needs."""
    step, states = checked_step(step), promoted(step, states)[1]
    if own_step:
        step = jax.tree.map(lambda x: x[0], step)
    own = step.system.phase_space.origin
    axes = {name: np.ndim(getattr(states, name)) - np.ndim(getattr(own, name)) for name in ("q", "p")}
    if axes["q"] != axes["p"] or axes["q"] not in (0, 1):
        q, p, needed = np.shape(states.q), np.shape(states.p), (np.shape(own.q), np.shape(own.p))
        raise ValueError(
            f"states of {type(step.system).__name__} have q of shape {needed[0]} and p of shape {needed[1]}, those of "
            f"a batch one leading axis more; got q {q} and p {p}"
        )
    return axes["q"] == 1


def _lines(run: Run) -> dict[str, str]:
    """What a run is, by words for a table."""
    facts, t = run.facts, run.t
    how = "at given times" if facts.save_every is None else f"every {facts.save_every} steps"
    sizes = "of given sizes" if facts.dt is None else f"of {facts.dt:g}"
    lines = {"step": f"{run.step.name} of {type(run.system).__name__}{' (one for each member)' * run.own_step}"}
    if run.members is not None:
        lines["members"] = f"{run.members}"
    lines["times"] = f"{float(t[0]):.6g} … {float(t[-1]):.6g}: {len(t)} saves {how} of {facts.num_steps}, {sizes}"
    state = run.state if run.summary is None else run.summary.state
    leading = (1 if run.summary is None else 0) + facts.batch
    shapes = {name: np.shape(x)[leading:] for name, x in leaves_by_name(state).items()}
    lines["states"] = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    if run.summary is not None:
        lines["reduced"] = "least, greatest and mean change in each save interval, over all members"
    failed = np.atleast_1d(np.asarray(run.failed))
    bad = np.flatnonzero(failed >= 0)
    lines["converged"] = "all"
    if bad.size:
        first = bad[failed[bad].argmin()]
        lines["converged"] = f"not {list_members(bad)}; member {first} first, at step {failed[first]}"
    versions = ", ".join(f"{name} {version}" for name, version in facts.versions if name != "jaxlib")
    lines["computed"] = f"by {facts.engine}, {versions}{'' if facts.complete else '; not complete'}"
    if facts.source:
        lines["store"] = facts.source
    return lines
