"""Events: the times at which a function of the state changes its sign.

A run stores the state y_k before each change of sign. With y(τ) a step of size τ from y_k, the event is the root of
g(y(τ)) = 0 between 0 and Δt, enclosed to round-off, and its derivatives are those of this equation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, stands_alone
from lieint_jax._numerics.sign_change import is_root, sign_change
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, callable_pytree, checked_step, promoted, start_time
from lieint_jax.core import clock as time_of
from lieint_jax.core.record import record
from lieint_jax.runs._clock import MOST_COUNTED, Clock, at_time, clock_of, halved, splits
from lieint_jax.runs._driver import Reached, at_start, counted, prepared, reported, scanned

_RIGHT_TO = {4: 3e-4, 8: 1e-9}  # an event's time, in Δt, by the bytes of a number
_RIGHT_TO_UNDERFLOW = 1e-5  # where the condition is so small that it underflows nearer to its root
_Condition = Callable[[State], Array]
_FEW = 8  # events whose search is machine code, of which each number of the buffer is an operation


@record
class Event(NamedTuple):
    """The time and the state at which a condition changes its sign.

    Attributes:
        t: the time, on the clock of `state.t`; since the start if the state has no time.
        state: the state at t, by a shorter step from the last node before.
        found: True if there is such an event, if t is right to 1e-9 dt (3e-4 dt in float32; 1e-5 dt where nearer to its
            root the condition underflows) or to the rounding of t, and if all steps up to it converged. If the sign
            does not change, found is False, and t and state are those at the end of the search. If the sign changes at
            a pole or a jump of the condition, or if rounding errors of the condition hide the time of its root, found
            is False, and t and state are those of the change.
    """

    t: Array
    state: State
    found: Array


def event(
    step: Step,
    state: State,
    dt: ArrayLike,
    condition: Callable[[State], ArrayLike],
    max_steps: int,
    direction: Literal[-1, 0, 1] = 0,
    count: int = 1,
) -> Event:
    """The first time after the start, or the `count`-th, at which `condition(state)` changes its sign.

    If the condition is 0 at the start, the start is no event: the sign just after it is the first one. Two changes of
    sign within one step are missed. t has the order of the step. The event is differentiable with respect to all
    arguments, in forward and reverse mode, and can be vmapped over states.

    Args:
        step, state, dt: as in `integrate`.
        condition: a smooth function of the state with a scalar value.
        max_steps: the largest number of steps to search, > 0.
        direction: 1 for changes from − to +, −1 for those from + to −, 0 for both.
        count: which of these changes, 1 for the first.

    Returns:
        An `Event`. Check `found`.

    Raises:
        ValueError: the condition is not a scalar or not finite at the start, max_steps or count is < 1, direction is
            none of these, and the errors of `integrate`.
    """
    found = events(step, state, dt, condition, max_steps=max_steps, count=count, direction=direction)
    return jax.tree.map(lambda x: x[count - 1], found)


def events(
    step: Step,
    state: State,
    dt: ArrayLike,
    condition: Callable[[State], ArrayLike],
    *,
    max_steps: int,
    count: int,
    direction: Literal[-1, 0, 1] = 0,
) -> Event:
    """The first `count` events as in `event`, every leaf with a leading axis (count,)."""
    max_steps, count = _checks.count("max_steps", max_steps, 1), _checks.count("count", count, 1)
    sign = _checks.integer(direction)
    if sign not in (-1, 0, 1):
        raise ValueError(f"direction must be −1 (falling), 1 (rising) or 0 (both), got {direction!r}")
    if not callable(condition):
        raise ValueError(f"condition must be a function of the state with a scalar value, got {condition!r}")
    step, state, dtype = promoted(checked_step(step), state)
    step.check(state, dt)
    first = jnp.asarray(condition(state))
    if first.shape != () or not jnp.issubdtype(first.dtype, jnp.floating):
        raise ValueError(f"condition must have a real scalar value, got shape {first.shape} and dtype {first.dtype}")
    if concrete(first) and not bool(np.isfinite(np.asarray(first))):
        raise ValueError(f"condition must be finite at the start, got {float(first)}")
    _checks.time_resolution(start_time(step, state), dt, max_steps)
    clock, _ = clock_of(step, state, dtype, dt, max_steps, None)
    if (parts := splits(step)) > 1:
        clock, max_steps = halved(clock), parts * max_steps
    given = step, state, clock, callable_pytree(condition)
    if count <= _FEW and max_steps <= MOST_COUNTED and stands_alone(given):
        found = _of_any_length(*given, np.int32(max_steps), (count, sign))
        if concrete(found):  # else the condition closes over a tracer
            return found
    return _of_known_length(*given, max_steps, (count, sign))


class _Bracket(NamedTuple):
    """A step with a change of sign.

    Attributes:
        state: the state before it.
        n: the number of steps before it.
        values: the condition before and after it, (2,).
        nearby: a fraction of the step: roots closer than this count as one.
        found: whether there is such a step.
    """

    state: State
    n: Array
    values: Array
    nearby: Array
    found: Array


class _Search(NamedTuple):
    """The changes of sign seen so far.

    Attributes:
        value: the condition at the last node.
        sign: its last sign that was not 0.
        number: the number of changes.
        buffer: the first of them, with a leading axis.
    """

    value: Array
    sign: Array
    number: Array
    buffer: _Bracket


def _events(
    step: Step, state: State, clock: Clock, condition: _Condition, max_steps: ArrayLike, wanted: tuple[int, int]
) -> Event:
    """The events; those of a traced `max_steps` have no derivative in reverse mode."""
    brackets = _brackets(step, state, clock, condition, max_steps, wanted)

    def locate(bracket: _Bracket) -> Event:
        size = clock.size(bracket.n)
        tau, ends = _root(step, bracket, size, condition)
        tau = jnp.where(bracket.found, tau, 0)
        around = lax.stop_gradient(tau + bracket.nearby * size * jnp.array([-1, 1], tau.dtype))
        # In one call, since a step costs more to compile than to run
        states, info = jax.vmap(lambda tau: step(bracket.state, tau))(jnp.append(tau, around))
        end, converged = jax.tree.map(lambda x: x[0], (states, info.converged))
        crosses = is_root(ends, jax.vmap(condition)(states)[1:], bracket.values[1])
        node = clock.time(bracket.n)
        t = time_of(end) if node is None else node + tau
        return Event(t, at_time(end, t), bracket.found & crosses & converged)

    return jax.vmap(locate)(brackets)


_of_known_length = compiled(_events, static_argnums=(4, 5))
_of_any_length = compiled(_events, static_argnums=5)


def _brackets(
    step: Step, state: State, clock: Clock, condition: _Condition, max_steps: ArrayLike, wanted: tuple[int, int]
) -> _Bracket:
    """The first changes of sign; missing ones are filled with the last state.

    `wanted` is (number of changes, their direction).
    """
    count, direction = wanted
    step_once = reported(prepared(step, state, clock), clock)
    start = condition(state)
    none = _Bracket(state, jnp.zeros((), int), jnp.stack([start, start]), jnp.zeros_like(start), jnp.zeros((), bool))
    buffer = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), none)

    def step_and_look(n: Array, carry: tuple[Reached, _Search]) -> tuple[Reached, _Search]:
        before, (value, sign, number, buffer) = carry
        after, info = step_once(n, before)
        new = condition(after)
        side = jnp.sign(new)
        changes = (sign * side < 0) & ((direction == 0) | (side == direction))
        slot = jnp.where(changes, number, count)
        nearby = jnp.maximum(_nearby(before[0].t, after.t, value), _above_underflow(new - value))
        here = _Bracket(before[0], n, jnp.stack([value, new]), nearby, info.converged)
        buffer = jax.tree.map(lambda to, x: to.at[slot].set(x, mode="drop"), buffer, here)
        sign = jnp.where(side * side > 0, side, sign)  # a zero or NaN changes nothing
        return (after, info), _Search(new, sign, jnp.where(changes, number + 1, number), buffer)

    search = at_start(state), _Search(start, jnp.sign(start), none.n, buffer)
    if count <= _FEW:
        (end, _), search = counted(step_and_look, 0, max_steps, search)
    else:
        assert isinstance(max_steps, int)
        (end, _), search = scanned(step_and_look, 0, max_steps, search)
    there = jnp.arange(count) < search.number
    last = none._replace(state=end, n=jnp.asarray(max_steps, none.n.dtype))
    return jax.tree.map(lambda x, y: jnp.where(there.reshape(-1, *[1] * y.ndim), x, y), search.buffer, last)


def _nearby(t0: Array | None, t1: Array | None, like: Array) -> Array:
    """The distance from a root at which its two sides are evaluated, as a fraction of the step from t₀ to t₁."""
    least = jnp.asarray(_RIGHT_TO[like.dtype.itemsize], like.dtype)
    if t0 is None or t1 is None:
        return least
    rounding = 8 * jnp.finfo(like.dtype).eps * jnp.abs(t1)
    return jnp.maximum(least, rounding / jnp.abs(t1 - t0))


def _above_underflow(change: Array) -> Array:
    """The fraction of a step from a root at which a condition that changes so much in it does not underflow."""
    change = lax.stop_gradient(change)
    return jnp.minimum(8 * jnp.finfo(change.dtype).tiny / jnp.abs(change), _RIGHT_TO_UNDERFLOW)


def _root(step: Step, bracket: _Bracket, dt: Array, condition: _Condition) -> tuple[Array, Array]:
    """The τ between 0 and Δt at which the condition changes its sign, and the condition just before and after it."""

    def g(tau: Array) -> Array:
        return condition(step(bracket.state, tau)[0])

    before, after = lax.stop_gradient((bracket.values[0], bracket.values[1]))

    def solve(g: Callable[[Array], Array], whole: Array) -> tuple[Array, Array]:
        u, ends = sign_change(lambda u: g(u * whole), before, after)
        return u * whole, ends

    def tangent_solve(slope: Callable[[Array], Array], y: Array) -> Array:
        return y / jnp.where(bracket.found, slope(jnp.ones_like(y)), 1)

    return lax.custom_root(g, lax.stop_gradient(dt), solve, tangent_solve, has_aux=True)
