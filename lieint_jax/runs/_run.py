"""A run: what a step and states make, of one body or many, in memory or on disk; how it is made, what can be asked."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, attitude, dates
from lieint_jax._free_body import Periods
from lieint_jax.core import (
    State,
    Step,
    StepInfo,
    System,
    Trajectory,
    callable_pytree,
    checked_step,
    promoted,
    pytree,
    static,
)
from lieint_jax.runs import _questions as questions
from lieint_jax.runs import labeled
from lieint_jax.runs._clock import GridClock
from lieint_jax.runs._error import RunError, estimate
from lieint_jax.runs._execute import compute
from lieint_jax.runs._facts import Facts, compile_map, dates_of, defect, from_start, lines, momentum, periods, plain
from lieint_jax.runs._interpolate import interpolate, interpolate_members
from lieint_jax.runs._loop import energy
from lieint_jax.runs._plan import Plan, is_batch, make_plan
from lieint_jax.runs._save import write
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.runs._storage.storage import StoreOptions, address
from lieint_jax.runs._summary import MemberSummary, Summary, member_of, saves_of_batch
from lieint_jax.runs.members import check_own_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from scipy.spatial.transform import Rotation
    from xarray import Dataset

Saved = TypeVar("Saved", bound=Trajectory | None, covariant=True)
Reduced = TypeVar("Reduced", bound=Summary | MemberSummary | None, covariant=True)
_T = TypeVar("_T")  # a tree of arrays
_INSTEAD = {  # where to find what people ask a run for
    **{x: f"run.state.{x}" for x in ("q", "p", "work", "extra")},
    **dict.fromkeys(("ts", "times_", "time"), "run.t"),
    **dict.fromkeys(("ys", "states", "y", "x"), "run.state"),
    **dict.fromkeys(("to_pandas", "dataframe", "df"), "run.to_dataframe()"),
    **dict.fromkeys(("xarray", "dataset"), "run.to_xarray()"),
    **dict.fromkeys(("momentum", "angular_momentum"), "run.momentum_error(), run.map(f)"),
    **dict.fromkeys(("omega", "rates"), "run.angular_velocity()"),
    **dict.fromkeys(("attitude", "attitudes", "quaternions"), "run.state.q, run.matrices(), run.euler(sequence)"),
}
_BLOCK = 2**26  # bytes of states that `map` reads from disk at once


@pytree
class Run(Generic[Saved, Reduced]):
    """The states, or a summary of them, that a step made of initial states.

    To a type checker it is `Run[Trajectory, None]`, reduced `Run[None, Summary]` or `Run[None, MemberSummary]`.

    In memory a run is a pytree, which can be passed to a function under jit. The arrays of a run on disk are read where
    they are indexed, and it is no pytree: `load` brings it to memory.

    Attributes:
        step: the step; with the member axis on its leaves if `own_step`.
        start: the initial states of a reduced run, from which it is extended; None if they are the first entry, or if
            the run was read from a store.
        trajectory: the saved states: a `Trajectory` with the axes (time, …), or (time, member, …); None if the run was
            reduced.
        summary: a `Summary` of a reduced run, else None.
        failed: the first step that did not converge, or −1, for each member; of a run made by `Run.of` the first save
            after which one did not.
        reduction, condition: the functions `reduce` and `first` of a reduced run, or None.
        times: the times of the boundaries of steps, if they were given.
        facts: see `Facts`.
    """

    step: Step
    start: State | None
    trajectory: Saved
    summary: Reduced
    failed: Array
    reduction: Any
    condition: Any
    times: Array | None
    facts: Facts = static()

    @staticmethod
    def of(
        step: Step,
        trajectory: Trajectory,
        own_step: bool = False,
        epoch: dates.DateLike | None = None,
        *,
        time_unit: str = "1",
    ) -> Run[Trajectory, None]:
        """The run of states that are known already, such as those of `integrate` inside of jit.

        It can be asked everything but to be extended or saved, as its step sizes are not known.

        Args:
            step: the step that made the states; with `own_step` its leaves have the member axis.
            trajectory: the saved states, (times, …), or (times, members, …) of a batch.
            own_step: whether each member has a step of its own.
            epoch: the date of t = 0, as in `li.run`.
            time_unit: the unit of t, such as "d".

        Raises:
            ValueError: states of another shape than the step's system needs; steps of all members without `own_step`.
        """
        first = promoted(checked_step(step), jax.tree.map(lambda x: x[0], trajectory.state))[1]
        batch = is_batch(step, first, own_step)
        one = jax.tree.map(lambda x: x[0], first) if batch else first
        check_own_step(step.system, one, len(trajectory.state.p[0]) if batch else None, own_step)
        good = jnp.asarray(trajectory.info.converged)
        failed = jnp.where(good.all(axis=0), -1, jnp.argmin(good, axis=0) - 1)
        text, steps = dates.text_of(epoch), len(trajectory.t) - 1
        facts = Facts(batch, own_step, None, steps, None, "", (), epoch=text, time_unit=time_unit)
        return Run(step, None, trajectory, None, failed, None, None, None, facts)

    if not TYPE_CHECKING:  # a type checker finds a wrong name by itself

        def __getattr__(self, name: str) -> Any:
            """Called for what a run does not have: the error names what it has instead."""
            way = _INSTEAD.get(name)
            raise AttributeError(f"a Run has no {name!r}" + (f": see {way}" if way else ""), name=name, obj=self)

    @property
    def t(self) -> Array:
        """The times (times,) of the saves."""
        found: Any = self.summary if self.trajectory is None else self.trajectory
        return found.t

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
        """What computed the run: "native" (machine code), "kernel" (of a GPU) or "xla"."""
        return self.facts.engine

    @property
    def versions(self) -> dict[str, str]:
        """The versions of the packages that computed it."""
        return dict(self.facts.versions)

    @property
    def epoch(self) -> dates.Epoch | None:
        """The date of t = 0, if it was given: `run.epoch.datetimes(run.t)` are the dates of the saves."""
        return dates.epoch(self.facts.epoch) if self.facts.epoch else None

    @property
    def converged(self) -> Array:
        """Whether all steps converged, for each member."""
        return self.failed < 0

    @property
    def _saved(self) -> Trajectory:
        if self.trajectory is None:
            raise ValueError("the run was reduced and has no states but the last ones: see run.summary.state")
        return self.trajectory

    @property
    def _in_memory(self) -> Trajectory:
        return jax.tree.map(np.asarray, self._saved)

    def member(self, k: int) -> Run[Trajectory, None]:
        """The run of member k, as one of one body."""
        if self.members is None:
            raise ValueError("the run is of one body and has no members")
        number = _checks.integer(k)
        if number is None or not -self.members <= number < self.members:
            raise ValueError(f"the run has {self.members} members, numbered from 0, got {k!r}")
        found = member_of(self._saved, number)
        step = jax.tree.map(lambda x: x[number], self.step) if self.own_step else self.step
        facts = self.facts._replace(batch=False, own_step=False, source="")
        return Run(step, None, found, None, self.failed[number], None, None, self.times, facts)

    def load(self) -> Run[Saved, Reduced]:
        """The run with its arrays in memory, so that it can be passed to functions under jit."""
        arrays = {name: jax.tree.map(np.asarray, x) for name, x in vars(self).items() if name != "facts"}
        return Run(**arrays, facts=self.facts._replace(source=""))

    def map(self, function: Callable[[Step, State], _T]) -> _T:
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
        map_states = compile_map(structure, self.facts.batch, self.own_step)
        if not self.facts.source:
            return map_states(numbers, self.step, saved)
        size = sum(x.dtype.itemsize * math.prod(x.shape[1:]) for x in jax.tree.leaves(saved))
        rows = max(1, _BLOCK // max(size, 1))

        def block(k: int) -> _T:
            return map_states(numbers, self.step, jax.tree.map(lambda x: np.asarray(x[k : k + rows]), saved))

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
        saved = self._in_memory
        if not self.facts.batch:
            return interpolate(self.system, saved, times)
        if self.step.own_time:
            raise ValueError("each member has its own times: give run.member(k).at(times)")
        return interpolate_members(self.system, saved, times, self.own_step)

    def energy(self) -> Array:
        """The energy H at each save, (times,) or (times, members); `energy_error` is its change less work."""
        return self.map(questions.hamiltonian)

    def angular_velocity(self, frame: Literal["body", "space"] = "body") -> Array:
        """The angular velocities at each save, rad per unit of time, (times, [members,] [bodies,] 3).

        Args:
            frame: whether their components are along the axes of the body or of space.

        Raises:
            ValueError: the system has no angular velocity.
        """
        if frame not in ("body", "space"):
            raise ValueError(f'frame must be "body" or "space", got {frame!r}')
        return self.map(questions.body_rates if frame == "body" else questions.space_rates)

    def matrices(self) -> Array:
        """The rotation matrices at each save, body to space, (times, [members,] [bodies,] 3, 3).

        Raises:
            ValueError: the system has no attitudes.
        """
        return self.map(questions.matrices)

    def euler(self, sequence: str) -> Array:
        """The Euler angles of the attitudes at each save, rad, (times, [members,] [bodies,] 3).

        Args:
            sequence: three letters as in `li.attitude.to_euler`, such as "ZYX" about the moving axes, or "xyz".

        Raises:
            ValueError: the system has no attitudes; another sequence.
        """
        return attitude.to_euler(sequence, self.map(questions.quaternions))

    def rotate(self, vector: ArrayLike) -> Array:
        """A vector that is fixed in the body, by its components in space at each save, (times, [members,] [bodies,] 3).

        Args:
            vector: its components along the axes of the body, (3,).

        Raises:
            ValueError: the system has no attitudes.
        """
        return self.map(partial(questions.rotated, _checks.real_array("vector", vector, (3,))))

    def plot(self, title: str = "") -> Figure:
        """Draw the motion of the first member: `li.plots.motion`; `li.plots.overview` writes all pictures of a run."""
        return import_module("lieint_jax.plots").motion(self, title)

    def animate(self, path: str | Path, shape: str | Path | Sequence[str | Path] = (), **options: Any) -> Path:
        """Write an animation of the rotating bodies, NAME.gif, .mp4 or .html: `li.plots.animate`.

        Args:
            path: the file.
            shape: files with the surfaces of the bodies.
            options: as in `li.plots.animate`: member, title, seconds, fps, span.
        """
        return import_module("lieint_jax.plots").animate(self, path, shape, **options)

    def energy_error(self) -> Array:
        """H − W less its first value, (times,) or (times, members); W is the work, where the states count it."""
        return from_start(self.map(energy))

    def momentum_error(self) -> Array:
        """The momentum map less its first value, (times, k) or (times, members, k)."""
        return from_start(self.map(momentum))

    def constraint_error(self) -> Array:
        """The distance of q from the configuration space, (times,) or (times, members)."""
        return self.map(defect)

    def error(self, members: int = 8) -> RunError:
        """How far the run is from the exact motion, measured by runs with half and a quarter of its step.

        A run whose energy is constant to round-off may be far off: the phase of an order-2 step errs by O(Δt²).

        Args:
            members: how many members of a batch are integrated again; they are spread evenly.

        Returns:
            A `RunError`, which prints the errors at the end. The two runs cost six times the run of these members.

        Raises:
            ValueError: the run has given times or output times, or no states.
        """
        facts, count = self.facts, _checks.count("members", members, 1)
        dt, every = facts.dt, facts.save_every
        if dt is None or every is None:
            raise ValueError("the error is measured by half the step size, and this run has given times")
        chosen = None
        if self.members is not None:
            chosen = np.unique(np.linspace(0, self.members - 1, min(count, self.members)).round().astype(int))
        saved = jax.tree.map(lambda x: np.asarray(x if chosen is None else x[:, chosen]), self.state)
        step = self.step if not self.own_step else jax.tree.map(lambda x: np.asarray(x)[chosen], self.step)
        start, steps = jax.tree.map(lambda x: x[0], saved), (len(self.t) - 1) * every

        def finer(parts: int) -> State:
            sizes = dt / parts, parts * steps
            plan = make_plan(step, start, *sizes, save_every=parts * every, own_step=facts.own_step, progress=False)
            return run_of_plan(plan).state

        return estimate(np.asarray(self.t), chosen, self.step.order, saved, finer(2), finer(4), steps)

    def periods(self) -> Periods:
        """The mean periods of precession and rotation of a tumbling body at each save: `body.periods`.

        They are those of each state in closed form; `li.measure.tumbling_periods(run)` measures both along the motion,
        about the axis of the body's mode.

        Raises:
            ValueError: the system has no periods.
        """
        return self.map(periods)

    def rotations(self) -> Rotation:
        """The attitudes, body to space, as `scipy.spatial.transform.Rotation` of shape (times, …).

        `.as_euler("ZXZ", degrees=True)` returns Euler angles of any sequence: capitals mean successive rotations about
        the axes of the body, small letters about those of space. scipy before 1.17 accepts one member of a batch only:
        `run.member(k).rotations()`.

        Raises:
            ValueError: q does not hold quaternions.
        """
        return labeled.rotations(self._saved)

    def to_xarray(self, units: Mapping[str, str] | None = None) -> Dataset:
        """The run as an `xarray.Dataset` with energy, momentum map and angular velocity.

        Its dimensions are `time`, and `member` for a batch; its variables are q, p, the other leaves that the states
        have (those of `extra` as extra_NAME), residual and converged. Quaternions have the dimension `quaternion` with
        labels w, x, y, z, vectors `axis` with x, y, z; several bodies have `body`, and `pose` (x, y, z, qw, qx, qy, qz)
        or `momenta` (px, py, pz, pix, piy, piz). With an epoch there is a coordinate `date` along time, for which t is
        taken in seconds.

        Args:
            units: units by name of a variable or of the coordinate time, such as {"time": "d"}; by default none.

        Raises:
            ValueError: `units` names no variable.
            ImportError: xarray is not installed.
        """
        saved, dims = self._in_memory, ("time", "member")
        found = labeled.dataset(saved, self.system, units or {}, self.own_step)
        if self.epoch is None:
            return found
        when = dates_of(self.facts, self.epoch, saved)
        about = {"long_name": "date", "scale": self.epoch.scale}
        return found.assign_coords(date=(dims[: when.ndim], when, about))

    def to_dataframe(self) -> DataFrame:
        """The run as a `pandas.DataFrame`: a row for each time and member, a column for each component.

        The columns are time, date (with an epoch, for which t is taken in seconds), member (of a batch), q_w, …,
        p_x, …, residual, converged, energy, momentum_map_0, …

        Raises:
            ImportError: pandas is not installed.
        """
        saved = self._in_memory
        found = labeled.frame(saved, self.system, self.own_step)
        if self.epoch is not None:
            when, shape = dates_of(self.facts, self.epoch, saved), np.shape(saved.info.residual)
            found.insert(1, "date", np.broadcast_to(when.reshape(len(when), -1), (*shape, 1)[:2]).ravel())
        return found

    def extend(self, num_steps: int, progress: bool = True) -> Run[Saved, Reduced]:
        """The run with `num_steps` further steps, bit for bit the run of all these steps.

        Raises:
            ValueError: the run has given times or output times, is not complete, or is on disk; the steps are no
                multiple of those between its saves.
        """
        facts, more = self.facts, _checks.count("num_steps", num_steps, 0)
        if facts.source:
            raise ValueError(f"the run is in {facts.source}: bring it to memory first, run.load().extend({num_steps})")
        if facts.dt is None or facts.save_every is None:
            raise ValueError("a run at given times cannot be extended: start another one from its last state")
        if more % facts.save_every and not isinstance(self.summary, MemberSummary):
            every, near = facts.save_every, _checks.nearest_multiples(more, facts.save_every)
            raise ValueError(f"the run has one save per {every} steps: extend it by {near} steps, got {more}")
        return run_of_plan(self._plan(facts.num_steps + more, progress=progress), self._saves)

    def save(self, path: str | Path | StoreOptions) -> Run[Saved, Reduced]:
        """Write a run in memory to a new folder NAME.zarr or one file NAME.zip, and return the run there.

        All of it is written or nothing. `li.open` reads both; a folder can be resumed, a zip file is complete.

        Raises:
            ValueError: the folder or file exists; the run is not in memory, or not complete.
        """
        if self.facts.source:
            raise ValueError(f"the run is in {self.facts.source} already: copy that, or save run.load()")
        plan = self._plan(self.facts.num_steps, store=path)
        return stored_run(str(StoreOptions.of(path).path), write(plan, self.engine, self._saves), self.step)

    @property
    def _saves(self) -> Saves:
        """The saves in memory, with a member axis."""
        found = self.trajectory if self.summary is None else self.summary
        saves = Saves(*jax.tree.map(np.asarray, (found, self.failed)))
        return saves if self.facts.batch else saves_of_batch(saves)

    def _plan(self, num_steps: int, store: str | Path | StoreOptions | None = None, progress: bool = False) -> Plan:
        """The plan that made the run, with this number of steps of one size and this store."""
        facts, of_members = self.facts, isinstance(self.summary, MemberSummary)
        start = self.start if self.trajectory is None else jax.tree.map(lambda x: x[0], self.state)
        if start is None or not facts.complete or (facts.dt is None and self.times is None):
            raise ValueError(
                "the run does not have all of its numbers: it is not complete, or was read from a store that lacks the "
                "function of `reduce` or the times of the steps"
            )
        return make_plan(
            self.step,
            start,
            facts.dt,
            None if facts.dt is None else num_steps,
            times=self.times,
            save_every=None if of_members else 1 if facts.save_every is None else facts.save_every,
            save_at=self.t[1:] if facts.save_every is None else None,
            own_step=facts.own_step,
            reduce=plain(self.reduction),
            per="member" if of_members else None,
            first=plain(self.condition),
            epoch=self.epoch,
            store=store,
            progress=progress,
        )

    def __repr__(self) -> str:
        return "\n".join(f"{name:<10} {text}" for name, text in lines(self).items())

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{html.escape(k)}</th><td>{html.escape(x)}</td></tr>" for k, x in lines(self).items())
        return f"<table>{''.join(rows)}</table>"


class StoredRun(Run):
    """A run whose arrays are read from disk. It is no pytree, so that no transformation reads them all unasked."""


def stored_run(path: str, saves: Saves, step: Step) -> Run:
    """The run in a store; that of one body is read at once."""
    return _of_saves(step, saves, Facts.of_store(path, saves.attributes))


def run_of_plan(plan: Plan, earlier: Saves | None = None) -> Run:
    """The run that a plan makes; `earlier` are the saves in memory of a run that it continues."""
    own, saves, engine = compute(plan, earlier)
    if own.store is not None:
        return stored_run(str(address(own.store.path)), saves, own.step)
    functions = [None if f is None else callable_pytree(f) for f in (own.reduction, own.condition)]
    times = own.clock.times if isinstance(own.clock, GridClock) else None
    start = None if own.reduction is None else own.states
    return _of_saves(own.step, saves, Facts.of_plan(own, engine), start, *functions, times)


def _of_saves(step: Step, saves: Saves, facts: Facts, start: State | None = None, *given: Any) -> Run:
    """The run of these saves, which have a member axis also if it is of one body; `given` are its further fields."""
    found, failed = saves.found, saves.failed
    if not facts.batch:
        found, failed = member_of(found, 0), failed[0]
        start = jax.tree.map(lambda x: x[0], start)
    shown = (found, None) if isinstance(found, Trajectory) else (None, found)
    kind: Any = StoredRun if facts.source else Run
    return kind(step, start, *shown, failed, *(given or [None] * 3), facts)
