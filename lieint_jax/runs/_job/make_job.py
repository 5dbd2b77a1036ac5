"""The checked description of a run, from the arguments of `li.run`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._xla import reads, rereading_jit
from lieint_jax.native import make_once
from lieint_jax.runs._job import devices
from lieint_jax.runs._job.job import Job, chunk_members, list_members
from lieint_jax.runs._job.loop import Reduction, energy
from lieint_jax.runs._job.made_states import MadeStates, MakeStates
from lieint_jax.runs._job.split import Split
from lieint_jax.runs._march.arguments import check_inertias
from lieint_jax.runs._march.clock import Clock, GridClock, UniformClock, clock_of, intervals, outputs, refuse_times
from lieint_jax.runs._storage.storage import StoreOptions
from lieint_jax.types import PhaseSpace, State, Step, callable_pytree, checked_step, leaves_by_name, promoted
from lieint_jax.types.members import member_axis

_ENTRY, _SERIES = 2 * 8, 5 * 8  # bytes of an entry's time and node, and of its numbers in the series of `reduce`
_SCALARS = ("t", "work")  # the leaves of states that are scalars for each member, or one scalar for all


def is_batch(step: Step, states: State, own_step: bool) -> bool:
    """Whether states have one axis more than the phase space of the step's system needs."""
    step, states = checked_step(step), promoted(step, states)[1]
    if own_step:
        step = jax.tree.map(lambda x: x[0], step)
    own = step.system.phase_space.origin
    more = np.ndim(states.q) - np.ndim(own.q)
    if more != np.ndim(states.p) - np.ndim(own.p) or more not in (0, 1):
        q, p, needed = np.shape(states.q), np.shape(states.p), (np.shape(own.q), np.shape(own.p))
        raise ValueError(
            f"states of {type(step.system).__name__} have q of shape {needed[0]} and p of shape {needed[1]}, those of "
            f"a batch one leading axis more; got q {q} and p {p}"
        )
    return more == 1


def check_own_steps(step: Step, members: int | None) -> None:
    """Raise ValueError unless all leaves of a step have a leading axis of so many members."""
    shapes = [np.shape(x) for x in jax.tree.leaves(checked_step(step))]
    if any(shape[:1] != (members,) for shape in shapes):
        given = ", ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(
            f"own_step=True needs a step for each of {members} members, made by jax.vmap, so that every leaf has a "
            f"leading member axis; got leaves of shapes {given}"
        )


def make_jobs(
    step: Step,
    states: State | MakeStates,
    made: MadeStates | None,
    part: tuple[int, int] | None,
    remote: bool,
    options: dict[str, Any],
) -> tuple[Job, Job]:
    """The job of all members, and that of this process: of one of the parts, if it has any.

    `options` are further arguments of `checked_job`.
    """
    _check_options(options)
    if made is None:
        whole = checked_job(step, cast("State", states), **options)
    elif part is not None:  # the states of one member describe the arrays of all
        first = _make_members(step, made, range(1), options)
        own_step = promoted(checked_step(step), first.initial)[0]

        def repeat(x: devices.Numbers) -> np.ndarray:
            return np.broadcast_to(np.asarray(x)[:1], (made.members, *x.shape[1:]))  # a view that needs no memory

        t0: Any = repeat(first.t0) if first.own_times else first.t0  # pyright: ignore
        states = jax.tree.map(repeat, first.states)
        whole = first._replace(step=own_step, states=states, t0=t0, make_states=made)
    else:
        whole = _make_members(step, made, range(made.members), options)
    if part is None:
        return whole, whole
    own = split_into_parts(whole, part[1], remote).part(part[0])
    job = whole.restricted(own) if made is None else _make_members(step, made, own, options)._replace(part=own)
    return whole, job


def _check_options(options: dict[str, Any]) -> None:
    """Raise ValueError unless these arguments of `checked_job` fit."""
    reduce, per, first = (options.get(name) for name in ("reduce", "per", "first"))
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
    if options["save_every"] is not None or options.get("save_at") is not None:
        raise ValueError('per="member" is over all steps: give no save_every and no save_at')


def split_into_parts(job: Job, count: int, remote: bool) -> Split:
    """The split of a run into `count` parts, and its chunks."""
    return Split.into_parts(
        job.members, count, chunk_members(job.members, count, job.row_bytes, job.num_saves + 1, remote)
    )


def _make_members(step: Step, made: MadeStates, members: range, options: dict[str, Any]) -> Job:
    """The job of members whose states a function makes."""
    own = slice(members.start, members.stop)
    if options["step_axis"] is not None:
        step = jax.tree.map(lambda leaf: leaf[own], step)
    return checked_job(step, made.make(members), made=members, **options)


def checked_job(
    step: Step,
    states: State,
    dt: float | None,
    num_steps: int | None,
    save_every: int | None,
    step_axis: int | None,
    reduce: Reduction | Literal["energy"] | None = None,
    store: str | Path | StoreOptions | None = None,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
    made: range | None = None,
    batch: bool = True,
    per: Literal["member"] | None = None,
    first: Reduction | None = None,
    epoch: str = "",
) -> Job:
    """The checked description of a run from arguments of `li.run`.

    Args:
        step, states: those of the members; each has its own step if `step_axis` is 0, not None.
        dt, num_steps, save_every, reduce, store, times, save_at, per, first: as in `li.run`.
        made: the members, if a function has made them.
        batch: whether it is a run of a batch, not of one body.
        epoch: the text of an epoch, or "".
    """
    first_member = 0 if made is None else made.start
    step, states, dtype = promoted(checked_step(step), states)
    check_inertias(step, step_axis is not None)
    states, t0 = _split_time(step, states, made)
    reduction, condition = _function(energy if reduce == "energy" else reduce), _function(first)
    clock, planned_steps = _make_clock(step, states, t0, dtype, dt, num_steps, times)
    if save_at is None:
        interval, num_saves = intervals(planned_steps, save_every)
        _check_size(states, num_saves + 1, reduction, store)
        nodes = interval * np.arange(num_saves + 1)
        times = clock.time(nodes if isinstance(clock, GridClock) else nodes.astype(dtype))
        entries = np.asarray(times), nodes, None, interval
    else:
        refuse_times(step, "save_at")
        if save_every is not None or reduce is not None:
            raise ValueError(f"pass save_at or {'save_every' if reduce is None else 'reduce'}, not both")
        entries = _entries_at_times(save_at, clock, planned_steps, dtype)
        _check_size(states, len(entries[0]), reduction, store)
    size = None if dt is None else float(dt)
    job = Job(step, states, t0, size, clock, planned_steps, *entries, step_axis, reduction)
    job = job._replace(per_member=per is not None, condition=condition, batch=batch, epoch=epoch)
    _check_job(job, first_member)
    _checks.time_resolution(t0, job.first_dt, planned_steps)
    return job


def _function(given: Reduction | None) -> Reduction | None:
    """A function of the user's, as a pytree if it has numbers."""
    return given if given is None or jax.tree_util.all_leaves([given]) else callable_pytree(given)


def _check_size(states: State, entries: int, reduction: Reduction | None, store: object) -> None:
    """Raise ValueError if the results of a run exceed this machine's memory: its states or series, and its times."""
    size, advice = _ENTRY, "use a larger save_every"
    if reduction is not None:
        size += _SERIES
    elif store is None:
        size += _checks.entry_size(states, len(states.p))
        advice += " or store=PATH.zarr, which needs memory for one chunk only"
    _checks.fits_memory(entries, size, advice)


def _make_clock(
    step: Step,
    states: State,
    t0: devices.Numbers | None,
    dtype: np.dtype,
    dt: jax.typing.ArrayLike | None,
    num_steps: int | None,
    times: ArrayLike | None,
) -> tuple[Clock, int]:
    """The clock of the steps, as host arrays, and their number; since the start if members start at different times."""
    if t0 is not None and t0.ndim:
        if times is not None:
            raise ValueError("times hold for all members: give all members the same states.t, or none")
        t0 = None
    clock, planned_steps = clock_of(step, states._replace(t=t0), dtype, dt, num_steps, times)
    if isinstance(clock, UniformClock) and clock.t0 is None:
        clock = UniformClock(jnp.zeros((), dtype), clock.dt)
    return jax.tree.map(np.asarray, clock), planned_steps


def _entries_at_times(
    save_at: ArrayLike, clock: Clock, planned_steps: int, dtype: np.dtype
) -> tuple[np.ndarray, np.ndarray, np.ndarray, None]:
    """The entries at given times, that of the start first: times, nodes, rests and save_every of a `Job`."""
    wanted = outputs(save_at, clock, planned_steps, dtype)
    times = np.concatenate([[clock.time(0)], wanted])
    nodes = np.asarray(jax.vmap(lambda t: clock.node(t, planned_steps))(times))
    return times, nodes, times - np.asarray(clock.time(nodes)).astype(dtype), None


def _split_time(step: Step, states: State, made: range | None) -> tuple[State, devices.Numbers | None]:
    """The checked states without their time, with the member axis on every leaf, and their time: a scalar if shared.

    If the step has a time of its own, it stays in the states, one for each member. Equal times of members that a
    function has `made` are not a shared one: those of a part do not show whether all are equal.
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
        given = ", ".join(f"{_python_name(name)} {shape}" for name, shape in shapes.items())
        raise ValueError(f"states need a leading member axis on every leaf, but t and work may be scalars; got {given}")
    [(members,)] = counts
    for name, x in leaves_by_name(states).items():
        bad = np.flatnonzero(~np.isfinite(np.asarray(x)).reshape(len(x) if x.ndim else 1, -1).all(axis=1))
        if bad.size:
            where = f", and is not finite for {list_members(bad + first)}" if x.ndim else f", got {x}"
            raise ValueError(f"states.{_python_name(name)} must be finite{where}")
    states = jax.tree.map(np.asarray, states)
    t, work = states.t, states.work
    if work is not None:
        work = np.broadcast_to(work, (members,))
    if step.own_time and t is not None:
        return states._replace(t=np.broadcast_to(t, (members,)), work=work), None  # pyright: ignore
    if made is None and t is not None and t.ndim and np.all(t == t[0]):
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
            f"{list_members(bad + first)} (worst defect {defect.max():.3g}); make states with system.state(...)"
        )
    step.system.check(state)  # the shapes, and the time of a driven system, are the same for all members
    if job.reduction is not None:
        _check_once(_check_result, job.reduction, step, state)
    if job.condition is not None:
        _check_once(_check_condition, job.condition, step, state)


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
    found: list[object] = []
    jax.eval_shape(lambda step, state: found.append(function(step, state)), *arguments)  # pyright: ignore
    return found[0]


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
        shown = f"{value.dtype} of shape {value.shape}" if array else repr(value)
        raise ValueError(
            f"reduce must return a real floating-point scalar, got {shown}; return one component of a vector or "
            "its norm, and 1.0 * x for an integer x"
        )


def _python_name(name: str) -> str:
    """The name of an array of the states, as written in Python."""
    return f'extra["{name.removeprefix("extra.")}"]' if name.startswith("extra.") else name
