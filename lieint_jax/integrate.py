"""Integration over many steps in one `lax.scan`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.types import State, Step, StepInfo, Trajectory, checked_step, on_clock, promoted


def integrate(step: Step, state: State, dt: ArrayLike, num_steps: int, save_every: int = 1) -> Trajectory:
    """Take `num_steps` steps of size `dt` and keep every `save_every`-th state.

    A `lax.scan`: vmap it over states, differentiate it forward or reverse, jit what calls it. It is compiled once for
    all steps of one structure and each pair of counts: a step made again with other numbers runs at once.

    Args:
        step: a scheme's step.
        state: the initial state; one body (use jax.vmap or `ensemble.run` for many).
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states.

    Returns:
        A `Trajectory` of num_steps/save_every + 1 entries, the initial state first. Its times, and the state's where
        it has one, are t₀ + nΔt, where t₀ is the initial state's time, else 0.

    Raises:
        ValueError: a bad count, a concrete state that is not one of the system, or a concrete dt past the scheme's
            limit at the first step. Later failures, and all failures inside jit, show in `info.converged`.

    Warns:
        RuntimeWarning: a state's time is so large that the floating-point numbers there are more than dt/10⁶ apart.
    """
    num_steps, save_every = _checks.count("num_steps", num_steps, 0), _checks.count("save_every", save_every, 1)
    num_saves = saves(num_steps, save_every)
    step, state, dtype = promoted(checked_step(step), state)
    step.check(state, dt)
    _checks.time_resolution(state.t, dt, num_steps)
    return _trajectory(step, state, jnp.asarray(_checks.step_size(dt), dtype), num_saves, save_every)


@partial(jax.jit, static_argnums=(3, 4))
def _trajectory(step: Step, state: State, dt: Array, num_saves: int, save_every: int) -> Trajectory:
    step = step.prepare(state, dt)
    started = StepInfo.fresh(state.p)

    t0 = state.t

    def one(carry: tuple[State, StepInfo, Array], _: None) -> tuple[tuple[State, StepInfo, Array], None]:
        state, so_far, n = carry
        state, info = step(state, dt)
        return (on_clock(state, t0, n + 1, dt), so_far.merge(info), n + 1), None

    def interval(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, n = carry
        (state, info, n), _ = lax.scan(one, (state, started, n), None, length=save_every)
        return (state, n), (state, info)

    _, later = lax.scan(interval, (state, jnp.zeros((), int)), None, length=num_saves)
    return from_start(state, later, dt, save_every)


def from_start(state: State, later: tuple[State, StepInfo], dt: Array, save_every: int) -> Trajectory:
    """The trajectory of an initial state and the states and reports saved after it, `save_every` steps apart."""
    first = (state, StepInfo.fresh(state.p))
    joined = jax.tree.map(lambda start, rest: jnp.concatenate([start[None], rest]), first, later)
    entries = joined[1].residual.shape[0]
    t = joined[0].t
    return Trajectory(dt * save_every * jnp.arange(entries, dtype=dt.dtype) if t is None else t, *joined)


def steps(
    step: Callable[..., tuple[State, StepInfo]],
    state: State,
    dt: ArrayLike,
    count: ArrayLike,
    t0: Array | None = None,
    done: ArrayLike = 0,
) -> tuple[State, StepInfo]:
    """The state after `count` steps, which may be traced, and the merged report of the steps.

    `state` is that after `done` steps from the time t₀; by default, it is the first.
    """
    t0 = state.t if t0 is None else t0

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
