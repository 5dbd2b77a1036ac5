"""`li.run` makes a run, and `li.open` reads one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any, Literal, TypedDict, TypeVar, Unpack, overload

from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jax.sharding import Mesh
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.core import State, Step, Trajectory
from lieint_jax.dates import DateLike
from lieint_jax.runs._arguments import explained
from lieint_jax.runs._loop import Reduction
from lieint_jax.runs._made_states import MakeStates
from lieint_jax.runs._plan import make_plan
from lieint_jax.runs._run import Run, run_of_plan, stored_run
from lieint_jax.runs._storage.storage import StoreOptions, address
from lieint_jax.runs._summary import MemberSummary, Summary
from lieint_jax.runs.store._reading import open_with_step

_F = TypeVar("_F", bound=Callable[..., Any])


def untransformed(name: str) -> Callable[[_F], _F]:
    """Raise TypeError where a function is called with tracers, or meets those of a function that closes over them."""
    advice = (
        f"{name} computes with numbers, outside of jax.jit, jax.vmap, jax.grad and jax.jvp: "
        "inside of them use li.integrate, for a batch jax.vmap(lambda z: li.integrate(step, z, dt, num_steps))(states)"
    )

    def decorate(function: _F) -> _F:
        @wraps(function)
        def call(*args: object, **kwargs: object) -> object:
            numbers = {name: x for name, x in kwargs.items() if name != "store"}  # whose attributes may hold anything
            if _checks.staged() or not _checks.concrete(args, numbers):
                raise TypeError(advice)
            try:
                return function(*args, **kwargs)
            except (ConcretizationTypeError, TracerArrayConversionError) as error:
                if _checks.outermost():
                    raise
                raise TypeError(advice) from error

        return call  # pyright: ignore[reportReturnType]

    return decorate


class RunOptions(TypedDict, total=False):
    """The arguments of `run` on which the type of its result does not depend."""

    save_every: int | None
    own_step: bool
    mesh: Mesh | None
    store: str | Path | StoreOptions | None
    progress: bool
    resume: bool
    times: ArrayLike | None
    save_at: ArrayLike | None
    part: tuple[int, int] | Literal["auto"] | None
    members: int | None
    threads: int | None
    same_bits: bool
    epoch: DateLike | None


@overload
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    reduce: None = ...,
    **options: Unpack[RunOptions],
) -> Run[Trajectory, None]: ...
@overload
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    reduce: Reduction | Literal["energy"],
    per: None = ...,
    **options: Unpack[RunOptions],
) -> Run[None, Summary]: ...
@overload
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    reduce: Reduction | Literal["energy"],
    per: Literal["member"],
    first: Reduction | None = ...,
    **options: Unpack[RunOptions],
) -> Run[None, MemberSummary]: ...
@explained("li.run")
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
) -> Run:
    """Run a step from initial states, of one body or of many, in memory or into a store that can be resumed.

    On a CPU the loop is machine code for vectors of members, in one thread per core (`lieint_jax.native`). Steps that
    cannot be compiled this way (a LAPACK call that depends on the state, very many bodies) and other devices use XLA.

    The bits of machine code depend neither on threads, processes and parts nor on whether the run was resumed; those of
    XLA may depend on the numbers of members and devices.

    Args:
        step: a scheme's step; with `own_step=True` its leaves carry the member axis too (one inertia per member).
        states: the initial state of one body; or those of a batch, whose arrays have a leading member axis, so one axis
            more. A time t of shape () is shared by all members, and so is one of shape (members,) whose values are
            equal: what depends on it alone, such as the position on an orbit, is computed once per step. `work` of
            shape () is that of every member. Or a function of member numbers (m,), which returns their states: then a
            part makes only its own. It is called for up to 65 536 consecutive numbers, must return the same for the
            same numbers in every process, and shares a time only by one of shape ().
        dt: step size, the same for all members.
        num_steps: number of steps, a multiple of `save_every`.
        save_every: number of steps between saved states; None saves the last state only.
        own_step: each member has a step of its own, made by `jax.vmap`.
        reduce: a quantity, "energy" (minus the work, where states have it) or a function (step, state) ↦ scalar.
            No states are saved but, for each save interval (all steps with save_every=None), the least, greatest and
            mean change of the quantity over all steps and members; NaN where the quantity was NaN.
        per: "member" reduces each member over all steps, the start included: `run.summary` has the least, greatest,
            mean and last value (not change) of the quantity for each.
        first: with `per="member"`, a condition (step, state) ↦ flag: `run.summary.first` is the first time at which it
            is true, NaN if never.
        mesh: devices, a `jax.sharding.Mesh` of the one axis "members"; None uses all.
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
            has it, and starts it otherwise. "auto" is the number of this task in an array: see `part_of_task`. In
            machine code all parts have the bits of one process.
        members: the number of members, where `states` is a function.
        threads: the number of threads of machine code; by default that of devices in `mesh`, or `li.count_cores`.
        same_bits: refuse to continue a store on another kind of processor or with another JAX, whose last bits may
            differ; False accepts it. Each part records those that have computed it.
        epoch: the date of t = 0 as in `li.dates.epoch`, such as "2026-03-01T12:00:00 UTC"; it changes no number.

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
            at the start.
        KeyboardInterrupt: interrupted; with `store`, after the chunk has been written.

    Warns:
        RuntimeWarning: a step or a function that calls back into Python, so that the store cannot be resumed; members
            that fail to converge later; times so large that their floating-point numbers are dt/10⁶ apart.
    """
    plan = make_plan(
        step,
        states,
        dt,
        num_steps,
        save_every=save_every,
        own_step=own_step,
        reduce=reduce,
        per=per,
        first=first,
        mesh=mesh,
        store=store,
        progress=progress,
        resume=resume,
        times=times,
        save_at=save_at,
        part=part,
        members=members,
        threads=threads,
        same_bits=same_bits,
        epoch=epoch,
    )
    return run_of_plan(plan)


def open_run(
    path: str | Path, own: Mapping[str, object] | None = None
) -> Run[Trajectory | None, Summary | MemberSummary | None]:
    """The run in a store, as `run` has written it or is writing it. Its arrays are read when they are indexed.

    Args:
        path: a folder NAME.zarr, a file NAME.zip of `run.save`, or a URL such as s3://bucket/NAME.zarr.
        own: classes and functions of the step and its system from outside this package, such as a custom potential, by
            their names in the store. If one is missing, the error message contains its name.

    Returns:
        The run as far as it is in the store. In a store in parts, members of a missing or damaged part, and entries
        that a part has not reached, are NaN.

    Raises:
        ValueError: no store, a damaged one (the message lists the files), one of another format, or a name missing in
            `own`; a reduced run that is not complete.

    Warns:
        RuntimeWarning: parts that are missing, damaged or incomplete, by number.
    """
    place = address(path)
    return stored_run(str(place), *open_with_step(place, own))
