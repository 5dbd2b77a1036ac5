"""A step taken many times, in one program for any number of times."""

import jax
import jax.numpy as jnp

from lieint_jax.types import StepInfo


@jax.jit
def after(step, state, dt, count):
    """The state after `count` steps, which may be traced, and the worst of their reports; inside jit nothing raises."""
    dt = jnp.asarray(dt, state.p.dtype)

    def step_once(_, reached):
        end, info = step(reached[0], dt)
        return end, reached[1].merge(info)

    return jax.lax.fori_loop(0, count, step_once, (state, StepInfo.empty(state.p)))
