"""A step taken once or many times, in one program for any number of times; the states of a run."""

import jax
import jax.numpy as jnp

from lieint_jax.core import StepInfo

once = jax.jit(lambda step, state, dt: step(state, dt))


def state_after(path, n):
    """The state of a run at its n-th save."""
    return jax.tree.map(lambda x: x[n], path.state)


def last(path):
    return state_after(path, -1)


@jax.jit
def after(step, state, dt, count):
    """The state after `count` steps, which may be traced, and the worst of their reports; inside jit nothing raises."""
    dt = jnp.asarray(dt, state.p.dtype)

    def step_once(_, reached):
        end, info = step(reached[0], dt)
        return end, reached[1].merge(info)

    return jax.lax.fori_loop(0, count, step_once, (state, StepInfo.empty(state.p)))
