"""Take many steps in one `lax.scan`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from lieint_jax import checks
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
    num_steps, save_every = checks.count("num_steps", num_steps, 0), checks.count("save_every", save_every, 1)
    num_saves = saves(num_steps, save_every)
    state, dtype = promoted(step, state)
    step.check(state, dt)
    step = step.prepare(state, dt)
    dt = jnp.asarray(checks.step_size(dt), dtype)
    started = StepInfo.fresh(state.p)

    def one(carry: tuple[State, StepInfo], _: None) -> tuple[tuple[State, StepInfo], None]:
        state, so_far = carry
        state, info = step(state, dt)
        return (state, so_far.worse(info)), None

    def interval(state: State, _: None) -> tuple[State, tuple[State, StepInfo]]:
        (state, info), _ = lax.scan(one, (state, started), None, length=save_every)
        return state, (state, info)

    _, later = lax.scan(interval, state, None, length=num_saves)
    joined = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), (state, started), later)
    t = dt * save_every * jnp.arange(num_saves + 1, dtype=dtype)
    return Trajectory(t, *joined)


def promoted(step: Step, state: State) -> tuple[State, jnp.dtype]:
    """The state in the floating-point type that it and the numbers of `step` have in common, and that type."""
    if not isinstance(state, State):
        raise ValueError(f"state must be a State(q, p), such as system.state(...) makes, got {type(state).__name__}")
    named = zip(State._fields, state, strict=True)
    leaves = [checks.real_array(f"state.{name}", leaf, finite=False) for name, leaf in named]
    numbers = [leaf for leaf in jax.tree.leaves(step) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    dtype = jnp.result_type(*leaves, *numbers)
    return State(*(leaf.astype(dtype) for leaf in leaves)), dtype


def saves(num_steps: int, save_every: int) -> int:
    """How many states a run of `num_steps` keeps after the initial one; ValueError if it is no whole number."""
    if num_steps % save_every:
        below = num_steps - num_steps % save_every
        raise ValueError(
            f"num_steps = {num_steps} is not a multiple of save_every = {save_every}; "
            f"take {below} or {below + save_every} steps"
        )
    return num_steps // save_every
