"""Trajectories: the states that a run saves, after equally many steps or at given times, with all derivatives."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks, native
from lieint_jax._checks import concrete
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, StepError, StepInfo, Trajectory, checked_step, promoted, start_time
from lieint_jax.runs._adjoints import Adjoint, ReversibleAdjoint, check_undoable, undoable, undoable_at
from lieint_jax.runs._arguments import check_inertias, explained
from lieint_jax.runs._clock import (
    MOST_COUNTED,
    MOST_TRACED,
    Clock,
    GridClock,
    clock_of,
    halved,
    is_inside,
    more_times,
    outputs,
    refuse_far_times,
    refuse_times,
    saves,
    splits,
    steps_to_reach,
)
from lieint_jax.runs._driver import Reached, at_start, join_start, prepared, saved_states

_LEAST_BYTES, _MOST_BYTES = 2**20, 2**26  # of the saved states that the loop of a run is compiled for
_SHORT = 256  # runs up to this length are computed before their first step is checked


@explained("li.integrate")
def integrate(
    step: Step,
    state: State,
    dt: ArrayLike | None = None,
    num_steps: int | None = None,
    save_every: int = 1,
    *,
    times: npt.ArrayLike | None = None,
    save_at: npt.ArrayLike | None = None,
    adjoint: Adjoint | None = None,
) -> Trajectory:
    """The trajectory of `num_steps` steps of size `dt`, or of steps from one of the `times` to the next.

    It can be jitted, vmapped over states, and differentiated in forward and reverse mode: by the step's numbers, the
    state, dt, `times` and `save_at`. On a CPU it is machine code, and so are its derivatives; the page "Your own loop
    in machine code" has the exceptions. A call outside of jit on a CPU is compiled once per structure of the step,
    whatever the numbers in the step, of steps and in `save_every`, for up to 4096 saved states of one body; again for
    up to 16384, and so on. `times` are compiled for up to 256, 1024, ….

    The state at an output time between two steps comes from a shorter step from the last node before. So it has every
    invariant of the step, and its error is that of the trajectory plus one of higher order, that of a single step. The
    trajectory does not continue from it. By a time that is a node's, the derivative is that from above.

    Args:
        step: a scheme's step.
        state: the initial state; one body (use jax.vmap or `li.run` for many).
        dt: step size, either sign.
        num_steps: a multiple of `save_every`. With `save_at` it may be omitted, and there are as many steps as lead to
            the last output. Traced times need it, as does a traced dt, unless the adjoint is `ReversibleAdjoint`.
        times: in place of dt and num_steps, the times (N+1,) between which steps lead, increasing or decreasing; the
            first is that of the state. If the times do not depend on the state, a symplectic step remains symplectic.
        save_at: in place of save_every, output times (m,) inside the run, in any order; they may repeat.
        adjoint: how the derivative in reverse mode is computed. None, or `li.RecursiveCheckpointAdjoint()`, stores
            about 2√N of N states, and computes the steps between them again. `li.ReversibleAdjoint()` stores the saved
            states only, and requires a symmetric step of one size; give a large save_every, or save_at.

    Returns:
        A `Trajectory`: the initial state, then the states after every `save_every` steps or at the times `save_at`, in
        their order. Its times, and those of the states if they have a time, are t₀ + nΔt, where t₀ is the time of the
        initial state or 0; or the given `times` or `save_at`; or those of the states, if the step has its `own_time`.
        Its `info` reports the steps since the saved state before, in time.

    Raises:
        ValueError: a count is not allowed, or is missing; times are not finite, not in order or outside the run; a
            concrete state is not one of the system; a concrete dt exceeds the scheme's limit at the first step; the
            trajectory is larger than this machine's memory; save_at is given with 2³¹ − 1 steps or more; or the adjoint
            cannot differentiate the step. Later failures, and all failures inside jit, such as traced output times
            outside the run, show in `info.converged`.

    Warns:
        RuntimeWarning: a state's time is so large that its floating-point spacing exceeds dt/10⁶; or, when a gradient
            is computed, `ReversibleAdjoint` has lost digits.
    """
    step, state, dtype = promoted(checked_step(step), state)
    check_inertias(step, own_step=False)
    if adjoint is not None and not isinstance(adjoint, Adjoint):
        raise ValueError(
            "adjoint must be None or li.RecursiveCheckpointAdjoint(), for any step, or li.ReversibleAdjoint(), got "
            f"{adjoint!r}"
        )
    undoing = adjoint if isinstance(adjoint, ReversibleAdjoint) else None  # checkpoints are what the loop has anyway
    if save_at is not None:
        if save_every != 1:
            raise ValueError("give save_every or save_at, not both")
        refuse_times(step, "save_at")
    is_open = False
    if save_at is not None and dt is not None and num_steps is None and times is None:
        num_steps = steps_to_reach(save_at, state.t, dt, dtype)
        is_open = num_steps is None
        if is_open and undoing is None:
            raise ValueError(
                "where save_at, dt or the time of the state is traced, their number of steps is not known: give "
                "num_steps, so many that they reach all times, or adjoint=li.ReversibleAdjoint()"
            )
    clock, num_steps = clock_of(step, state, dtype, dt, 0 if is_open else num_steps, times)
    if (parts := splits(step)) > 1:
        dt, clock, num_steps = None, halved(clock), parts * num_steps
    if undoing is not None:
        check_undoable(step, clock)
    first = dt if dt is not None else clock.size(0) if num_steps or is_open else _checks.as_array(0.0, dtype)
    _checks.time_resolution(start_time(step, state), first, num_steps)
    if save_at is None:
        save_every = parts * _checks.count("save_every", save_every, 1)
        return _after_every(save_every, step, state, clock, num_steps, first, undoing)
    num_steps = MOST_TRACED if is_open else num_steps
    wanted = outputs(save_at, clock, num_steps, dtype, ordered=False)
    refuse_far_times("save_at", num_steps, clock.time(0))
    _check_first(step, state, clock, first)
    _check_size(state, wanted.size + 1)
    if undoing is not None:
        later = undoable_at(step, state, clock, wanted, np.int32(num_steps), undoing.tolerance)
        return join_start(state, later, jnp.concatenate([clock.time(0)[None], wanted]))
    order = _time_order(wanted, clock, num_steps)
    run = _in_time_order(step, state, clock, wanted if order is None else wanted[order], num_steps)
    if order is None:
        return run
    back = jnp.concatenate([jnp.zeros(1, order.dtype), 1 + jnp.argsort(order)])
    return jax.tree.map(lambda x: x[back], run)


def _after_every(
    save_every: int,
    step: Step,
    state: State,
    clock: Clock,
    num_steps: int,
    first: ArrayLike,
    undoing: ReversibleAdjoint | None,
) -> Trajectory:
    """The trajectory saved after every `save_every` steps, the first of them of size `first`."""
    num_saves = saves(num_steps, save_every)
    _check_size(state, num_saves + 1)
    if undoing is not None:
        _check_first(step, state, clock, first)
        counts = np.full(num_saves, save_every, np.int32)
        later = undoable(step, state, clock.size(0), counts, undoing.tolerance)
        return join_start(state, later, clock.time(save_every * jnp.arange(num_saves + 1)))
    rows, is_short = rows_for(state, num_saves), num_steps <= _SHORT or isinstance(clock, GridClock)
    run = None
    if rows and num_steps and not step.approximate and _checks.stands_alone(step, state, clock):
        step.system.check(state)
        tried = (num_saves, rows, save_every) if is_short else (1, rows, 1)  # the whole run, or its first step
        run = of_any_length(step, state, clock, *tried)
    if run is None or not run.info.converged[1]:
        _check_first(step, state, clock, first)
    if run is None or not is_short:
        run = of_any_length(step, state, clock, num_saves, rows, save_every) if rows else None
    return trajectory(step, state, clock, num_saves, save_every) if run is None else jax.device_put(run)


def _check_size(state: State, entries: int) -> None:
    """ValueError if the trajectory of a concrete state has more bytes than this machine's memory."""
    if _checks.concrete(state):
        size = _checks.entry_size(state) + state.p.dtype.itemsize  # and the time
        advice = "give a larger save_every, or write to disk by li.run(…, store=PATH)"
        _checks.fits_memory(entries, size, advice, copies=2)  # the start is joined to the rest


def _check_first(step: Step, state: State, clock: Clock, size: ArrayLike) -> None:
    """`Step.check` of the first step, of this size."""
    try:
        step.check(state, size)
    except StepError as failed:
        more = more_times(step, state, size) if isinstance(clock, GridClock) else ""
        raise StepError(f"{failed}{more}") from None


def rows_for(state: State, num_saves: int) -> int:
    """For how many saved states the loop of a run is compiled, a power of 4; 0 on a GPU, and where it wastes memory."""
    if jax.default_backend() != "cpu":
        return 0
    size = _checks.entry_size(state)
    rows = 4 ** max(1, int(math.log(_LEAST_BYTES / size, 4)))
    while rows < num_saves:
        rows *= 4
    return rows if rows * size <= _MOST_BYTES else 0


def of_any_length(
    step: Step, state: State, clock: Clock, num_saves: int, most: int, save_every: int
) -> Trajectory | None:
    """The trajectory with `num_saves` saved states after the first, on the host, by one program for all up to `most`.

    None unless all is concrete, as a loop of unknown length has no derivative in reverse mode, and for more steps from
    one saved state to the next than such a loop counts.
    """
    if save_every > MOST_COUNTED or not _checks.stands_alone(step, state, clock):
        return None
    room = clock.with_room()
    return _on_host(_padded_trajectory(step, state, room, num_saves, save_every, most), num_saves)


def _on_host(found: Trajectory, num_saves: int) -> Trajectory | None:
    """The first entries of a trajectory on the host; None if a function of the step closes over a tracer."""
    if not _checks.concrete(found):
        return None
    return jax.tree.map(lambda x: np.asarray(x)[: num_saves + 1], found)


def _trajectory(
    step: Step, state: State, clock: Clock, num_saves: ArrayLike, save_every: ArrayLike, most: int | None = None
) -> Trajectory:
    """The trajectory of a state, saved `num_saves` times after the start.

    With `most` it has room for so many saves, and the entries after these are undefined; the two numbers may be traced.
    """
    later = saved_states(prepared(step, state, clock), state, clock, num_saves, save_every, most)
    return join_start(state, later, clock.time(save_every * jnp.arange((num_saves if most is None else most) + 1)))


trajectory = compiled(_trajectory, static_argnums=(3, 4))
_padded_trajectory = compiled(_trajectory, static_argnums=5)


def _time_order(save_at: Array, clock: Clock, num_steps: int) -> Array | np.ndarray | None:
    """The order of output times in the run; None for concrete ones that are in this order."""
    first, last = clock.time(0), clock.time(num_steps)
    if not concrete(save_at, first, last):
        return jnp.argsort(jnp.where(last < first, -save_at, save_at))
    ahead = np.asarray(-save_at if last < first else save_at)
    return None if np.all(np.diff(ahead) >= 0) else np.argsort(ahead, kind="stable")


def _in_time_order(step: Step, state: State, clock: Clock, save_at: Array, num_steps: int) -> Trajectory:
    """The trajectory at output times in the order of the run.

    Where all is concrete, it is computed by one program for all numbers of times and steps.
    """
    rows = rows_for(state, save_at.size)
    if rows and _checks.stands_alone(step, state, clock, save_at):
        wanted: tuple[Any, ...] = np.resize(save_at, rows), np.int32(num_steps), np.int32(save_at.size)
        found = _on_host(_at_times(step, state, clock.with_room(), *wanted), save_at.size)
        if found is not None:
            return jax.device_put(found)
    later = _at_output_times(step, state, clock, save_at, num_steps)
    return join_start(state, later, jnp.concatenate([clock.time(0)[None], save_at]))


class _Gap(NamedTuple):
    """What leads to an output: the nodes where it begins and ends, and the size of the shorter step from there."""

    first: Array
    node: Array
    rest: Array


@compiled
def _at_times(step: Step, state: State, clock: Clock, save_at: Array, num_steps: Array, count: Array) -> Trajectory:
    """The trajectory at the first `count` of these output times in order; the entries after these are undefined."""
    nodes = lax.cummax(clock.node(save_at, num_steps))
    gaps = _Gap(jnp.concatenate([jnp.zeros(1, nodes.dtype), nodes[:-1]]), nodes, save_at - clock.time(nodes))
    whole, has_time = prepared(step, state, clock), state.t is not None

    def advanced(step: Step, n: Array, size: Array, at: Reached) -> Reached:
        end, info = step(at[0]._replace(t=clock.time(n) if has_time else None), size)
        return end._replace(t=None), at[1].merge(info)

    def to_output(_: Array, here: State, gap: _Gap) -> tuple[State, Reached]:
        def step_once(n: Array, at: Reached) -> Reached:
            return advanced(whole, n, clock.size(n), at)

        node = lax.fori_loop(gap.first, gap.node, step_once, at_start(here))
        return node[0], advanced(step, gap.node, gap.rest, node)

    start = state._replace(t=None)
    later = native.march(to_output, start, gaps, rows=count, most=len(save_at))[1]
    return join_start(state, later, jnp.concatenate([clock.time(0)[None], save_at]))


class _Entry(NamedTuple):
    """An entry of a row.

    Attributes:
        whole, last: whether it is a whole step, and one to an output; or nothing.
        t, dt: the time of its node, and the size of its step.
    """

    whole: Array
    last: Array
    t: Array
    dt: Array


@partial(compiled, static_argnums=4)
def _at_output_times(step: Step, state: State, clock: Clock, save_at: Array, num_steps: int) -> Reached:
    """The states at output times, without these, and the reports of the steps since the output before.

    Before each output there are whole steps and a shorter one from the last node. They are one loop over rows of
    equally many entries, of which the last leads to an output, and all others are whole steps or nothing. So the loop
    stores few rows more than there are outputs, whatever the gaps between them.
    """
    inside = is_inside(save_at, clock, num_steps)
    nodes = lax.cummax(jnp.where(inside, clock.node(jnp.where(inside, save_at, clock.time(0)), num_steps), 0))
    rests = jnp.where(inside, save_at - clock.time(nodes), 0)  # a wild one would harm gradients by the others
    entries, rows, length = _entries(clock, rests, nodes, num_steps)
    whole, has_time = prepared(step, state, clock), state.t is not None

    def step_once(_: Array, at: Reached, x: _Entry) -> tuple[Reached, Reached]:
        here = at[0]._replace(t=x.t if has_time else None)
        dt = x.dt if isinstance(clock, GridClock) or clock.coarse is not None else clock.dt

        def advanced(step: Step, dt: Array) -> Reached:
            end, info = step(here, dt)
            return end._replace(t=None), at[1].merge(info)

        after = lax.cond(x.whole, lambda: advanced(whole, dt), lambda: at)
        output = lax.cond(x.last, lambda: advanced(step, x.dt), lambda: after)
        following = after[0], jax.tree.map(partial(jnp.where, x.last), StepInfo.empty(state.p), after[1])
        return following, output

    start, count = at_start(state._replace(t=None)), len(entries.t) // length
    found = native.march(step_once, start, entries, rows=count, every=length)[1]
    later, info = jax.tree.map(lambda x: x[rows], found)
    return later, info._replace(converged=info.converged & inside)


def _entries(clock: Clock, rests: Array, nodes: Array, num_steps: int) -> tuple[_Entry, Array, int]:
    """The entries of all rows, the row of each output, and the number of entries of a row.

    Args:
        clock, num_steps: see `_at_output_times`.
        rests: the size of the shorter step to each output.
        nodes: the last node before each output.
    """
    count = nodes.size
    length = max(1, -(-num_steps // max(count, 1))) + 1
    steps = jnp.diff(nodes, prepend=0)
    rows = jnp.cumsum(steps // length + 1) - 1
    size = length * (count + num_steps // length)
    n = jnp.arange(num_steps)
    output = jnp.cumsum(jnp.zeros(num_steps + 1, int).at[nodes].add(1))[:-1]  # to which the step from node n leads
    before = jnp.concatenate([jnp.zeros(1, rows.dtype), rows + 1])[output] * length
    place = before + n - jnp.concatenate([jnp.zeros(1, nodes.dtype), nodes])[output]
    place = jnp.where(output < count, place, size)  # beyond the end where no output follows

    def spread(nothing: ArrayLike, of_steps: ArrayLike, of_outputs: ArrayLike) -> Array:
        found = jnp.full(size, nothing).at[place].set(of_steps, mode="drop")
        return found.at[rows * length + length - 1].set(of_outputs)

    entries = _Entry(
        spread(False, True, False),
        spread(False, False, True),
        spread(clock.time(0), clock.time(n), clock.time(nodes)),
        spread(clock.size(0), clock.size(n), rests),
    )
    return entries, rows, length
