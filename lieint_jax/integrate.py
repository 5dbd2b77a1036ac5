"""The scan driver."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from lieint_jax.types import State, Step, StepInfo, Trajectory


def integrate(step: Step, state: State, dt: ArrayLike, num_steps: int, save_every: int = 1) -> Trajectory:
    """Take `num_steps` steps of size `dt` and keep every `save_every`-th state.

    A plain `lax.scan`: vmap it over states, differentiate it forward or reverse. It is not jitted: in a loop of your
    own, call `jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))`, which compiles once.

    Args:
        step: a scheme's step.
        state: the initial state; one body (use jax.vmap or `ensemble.run` for many).
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states.

    Returns:
        A `Trajectory` of num_steps/save_every + 1 entries, the initial state first.

    Raises:
        ValueError: a bad count, a concrete state that is not one of the system, or a concrete dt past the scheme's
            limit at the first step. Later failures, and all of them inside jit, show in `info.converged`.
    """
    num_saves = saves(num_steps, save_every)
    step.check(state, dt)
    step = step.prepare(state, dt)
    dtype = jnp.result_type(*state)
    dt = jnp.asarray(dt, dtype)
    started = StepInfo.fresh(state.p)

    def one(carry: tuple[State, StepInfo], _: None) -> tuple[tuple[State, StepInfo], None]:
        state, so_far = carry
        state, info = step(state, dt)
        return (state, so_far.worse(info)), None

    def interval(state: State, _: None) -> tuple[State, tuple[State, StepInfo]]:
        (state, info), _ = lax.scan(one, (state, started), None, length=save_every)
        return state, (state, info)

    _, (states, infos) = lax.scan(interval, state, None, length=num_saves)
    first = jnp.asarray
    joined = [jnp.concatenate([first(a)[None], b]) for a, b in zip((*state, *started), (*states, *infos), strict=True)]
    t = dt * save_every * jnp.arange(num_saves + 1, dtype=dtype)
    return Trajectory(t, State(*joined[:2]), StepInfo(*joined[2:]))


def saves(num_steps: int, save_every: int) -> int:
    """How many states a run of `num_steps` keeps after the initial one; ValueError if the counts do not fit."""
    for name, value, least in (("num_steps", num_steps, 0), ("save_every", save_every, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name} must be an integer ≥ {least}, got {value!r}")
    if num_steps % save_every:
        below = num_steps - num_steps % save_every
        raise ValueError(
            f"num_steps = {num_steps} is not a multiple of save_every = {save_every}; "
            f"take {below} or {below + save_every} steps"
        )
    return num_steps // save_every
