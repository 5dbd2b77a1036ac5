"""Integration over many steps in one `lax.scan`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.replay import replayed
from lieint_jax.integrate._clock import Clock, Given, Own, Uniform, at_time, clock_of, more_times, outputs, refuse_times
from lieint_jax.types import State, Step, StepError, StepInfo, Trajectory, checked_step, on_clock, promoted, start_time


def integrate(
    step: Step,
    state: State,
    dt: ArrayLike | None = None,
    num_steps: int | None = None,
    save_every: int = 1,
    *,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
) -> Trajectory:
    """Take `num_steps` steps of size `dt`, or steps from one of the `times` to the next, and keep states on the way.

    A `lax.scan`: vmap it over states, differentiate it forward or reverse, jit what calls it. It is compiled once for
    all steps of one structure and each pair of counts: a step made again with other numbers runs at once.

    The state at an output time between two steps is that of a shorter step from the last one before: it has every
    invariant of the step, and an error of one order above the scheme's beside that of the trajectory. The trajectory
    does not continue from it.

    Args:
        step: a scheme's step.
        state: the initial state; one body (use jax.vmap or `ensemble.run` for many).
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states.
        times: in place of dt and num_steps, the times (N+1,) between which steps lead, increasing or decreasing; the
            first is that of the state. Steps that do not depend on the state keep the symplectic form.
        save_at: in place of save_every, output times (m,) in the order of the run, inside it; they may repeat.

    Returns:
        A `Trajectory`, the initial state first, then those after every `save_every` steps or at the times `save_at`.
        Its times, and the state's where it has one, are t₀ + nΔt, where t₀ is the initial state's time, else 0; or as
        given; or those of the states, if the step has its `own_time`.

    Raises:
        ValueError: a bad count, times that are not finite, not in order or outside the run, a concrete state that is
            not one of the system, or a concrete dt past the scheme's limit at the first step. Later failures, and all
            failures inside jit, show in `info.converged`.

    Warns:
        RuntimeWarning: a state's time is so large that the floating-point numbers there are more than dt/10⁶ apart.
    """
    step, state, dtype = promoted(checked_step(step), state)
    clock, num_steps = clock_of(step, state.t, dtype, dt, num_steps, times)
    first = clock.size(0) if num_steps else jnp.zeros((), dtype)
    _check_first(step, state, first if dt is None else dt, isinstance(clock, Given))
    _checks.time_resolution(start_time(step, state), first if dt is None else dt, num_steps)
    if save_at is None:
        save_every = _checks.count("save_every", save_every, 1)
        return _trajectory(step, state, clock, saves(num_steps, save_every), save_every)
    if save_every != 1:
        raise ValueError("give save_every or save_at, not both")
    refuse_times(step, "save_at")
    assert not isinstance(clock, Own)
    return _seen(step, state, clock, outputs(save_at, clock, num_steps, dtype), num_steps)


def _check_first(step: Step, state: State, size: ArrayLike, given: bool) -> None:
    """`Step.check` of the first step, whose size comes from `times` if `given`."""
    try:
        step.check(state, size)
    except StepError as failed:
        raise StepError(f"{failed}{more_times(step, state, size) if given else ''}") from None


@partial(jax.jit, static_argnums=(3, 4))
def _trajectory(step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> Trajectory:
    step = prepared(step, state, clock)
    started = StepInfo.fresh(state.p)

    @replayed
    def one(carry: tuple[State, StepInfo, Array], _: None) -> tuple[tuple[State, StepInfo, Array], None]:
        state, so_far, n = carry
        state, info = step(state, clock.size(n))
        return (at_time(state, clock.time(n + 1)), so_far.merge(info), n + 1), None

    def interval(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, n = carry
        (state, info, n), _ = _times(save_every, one, (state, started, n))
        return (state, n), (state, info)

    _, later = _times(num_saves, interval, (state, jnp.zeros((), int)))
    return _joined(state, later, clock.time(save_every * jnp.arange(num_saves + 1)))


def _times(length: int, function: Callable[[Any, None], tuple[Any, Any]], carry: Any) -> tuple[Any, Any]:
    """`lax.scan`, without the loop where its length is 1: that is a third of the time of tracing."""
    if length != 1:
        return lax.scan(function, carry, None, length=length)
    carry, result = function(carry, None)
    return carry, jax.tree.map(lambda x: x[None], result)


@partial(jax.jit, static_argnums=4)
def _seen(step: Step, state: State, clock: Uniform | Given, save_at: Array, num_steps: int) -> Trajectory:
    """The trajectory at output times: whole steps, and before each a shorter one from its node to every output."""
    count = save_at.size
    span = clock.time(num_steps) - clock.time(0)
    inside = jnp.abs(save_at - clock.time(0) - span / 2) <= jnp.abs(span) / 2 * (1 + 1e-12)  # False for NaN
    own = clock.node(jnp.where(inside, save_at, clock.time(0)), num_steps)
    nodes = lax.cummax(own)
    rests = save_at - clock.time(nodes)
    whole, fresh = prepared(step, state, clock), StepInfo.fresh(state.p)
    outputs = jnp.zeros(num_steps + count, bool).at[nodes + jnp.arange(count)].set(True)
    buffer = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), (state, fresh))

    def one(carry: Any, is_output: Array) -> tuple[Any, None]:
        (state, so_far), n, k, buffer = carry
        rest = rests[jnp.minimum(k, count - 1)]
        end, info = lax.cond(is_output, lambda: step(state, rest), lambda: whole(state, clock.size(n)))
        reached = at_time(end, clock.time(n + 1)), so_far.merge(info)
        slot = jnp.where(is_output, k, count)
        buffer = jax.tree.map(lambda to, x: to.at[slot].set(x, mode="drop"), buffer, (end, so_far.merge(info)))
        following = jax.tree.map(lambda a, b: jnp.where(is_output, a, b), (state, fresh), reached)
        return (following, n + ~is_output, k + is_output, buffer), None

    zero = jnp.zeros((), int)
    if count:
        buffer = lax.scan(one, ((state, fresh), zero, zero, buffer), outputs)[0][-1]
    later, info = buffer
    info = info._replace(converged=info.converged & inside & (own == nodes))  # else a traced time is out of order
    return _joined(state, (at_time(later, save_at), info), jnp.concatenate([clock.time(0)[None], save_at]))


def prepared(step: Step, state: State, clock: Clock) -> Step:
    """The step with its constants, which hold for one step size."""
    return step if isinstance(clock, Given) else step.prepare(state, clock.dt)


def _joined(state: State, later: tuple[State, StepInfo], t: Array | None) -> Trajectory:
    """The trajectory of an initial state, the states and reports after it, and the times of all; None: the states'."""
    first = (state, StepInfo.fresh(state.p))
    states, info = jax.tree.map(lambda start, rest: jnp.concatenate([start[None], rest]), first, later)
    return Trajectory(states.t if t is None else t, states, info)


def from_start(step: Step, state: State, later: tuple[State, StepInfo], dt: Array, save_every: int) -> Trajectory:
    """The trajectory of an initial state and the states and reports saved after it, `save_every` steps apart."""
    entries = 1 + later[1].residual.shape[0]
    clock, _ = clock_of(step, state.t, dt.dtype, dt, entries - 1, None)
    return _joined(state, later, clock.time(save_every * jnp.arange(entries)))


def steps(
    step: Callable[..., tuple[State, StepInfo]],
    state: State,
    dt: ArrayLike,
    count: ArrayLike,
    t0: Array | None = None,
    done: ArrayLike = 0,
) -> tuple[State, StepInfo]:
    """The state after `count` steps, which may be traced, and the merged report of the steps.

    `state` is that after `done` steps from the time t₀, None if the state has no time or the step advances it.
    """

    def one(n: Array, carry: tuple[State, StepInfo]) -> tuple[State, StepInfo]:
        state, so_far = carry
        state, info = step(state, dt)
        return on_clock(state, t0, done + n + 1, dt), so_far.merge(info)

    return lax.fori_loop(0, count, one, (state, StepInfo.fresh(state.p)))


def intervals(num_steps: int, save_every: int | None) -> tuple[int, int]:
    """The number of steps between saved states (None: all steps) and of saved states after the initial one."""
    num_steps = _checks.count("num_steps", num_steps, 0)
    save_every = max(num_steps, 1) if save_every is None else _checks.count("save_every", save_every, 1)
    return save_every, saves(num_steps, save_every)


def saves(num_steps: int, save_every: int) -> int:
    """The number of saved states after the initial one; ValueError if `save_every` does not divide `num_steps`."""
    if num_steps % save_every:
        below = num_steps - num_steps % save_every
        raise ValueError(
            f"num_steps = {num_steps} is not a multiple of save_every = {save_every}; "
            f"take {below} or {below + save_every} steps"
        )
    return num_steps // save_every
