"""Runs of any length by one compiled program: what is measured of a step is measured with few compilations."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax._checks import concrete
from lieint_jax.types import State, Step, StepError, StepInfo, on_clock, start_time


@partial(jax.jit, static_argnums=4)
def _run(step: Step, state: State, dt: Array, count: int, most: int) -> tuple[State, StepInfo]:
    step, t0 = step.prepare(state, dt), start_time(step, state)
    start = (state, StepInfo.fresh(state.p))
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (most + 1, *x.shape)), start)

    def one(n: Array, carry: tuple[State, tuple[State, StepInfo]]) -> tuple[State, tuple[State, StepInfo]]:
        state, rows = carry
        state, info = step(state, dt)
        state = on_clock(state, t0, n + 1, dt)
        return state, jax.tree.map(lambda to, x: to.at[n + 1].set(x), rows, (state, info))

    return lax.fori_loop(0, count, one, (state, rows))[1]


def run(step: Step, state: State, dt: Array, count: int, most: int) -> tuple[State, StepInfo]:
    """The states and reports of `count` steps, the initial state first, as host arrays if they are concrete.

    What `integrate` does at each step; compiled once for all counts up to `most`.
    """
    rows = _run(step, state, dt, count, max(count, most))
    return jax.tree.map(lambda x: (np.asarray(x) if concrete(x) else x)[: count + 1], rows)


def checked(step: Step, state: State, dt: Array, most: int) -> None:
    """Raise what `Step.check` raises of a concrete state, by the program of `run`; tracers pass."""
    if not concrete(step, state, dt):
        return
    with jax.ensure_compile_time_eval():  # constants are concrete inside jit too
        step.system.check(state)
    converged = run(step, state, dt, 1, most)[1].converged[1]
    if not concrete(converged):
        step.check(state, dt)
    elif not (converged or step.approximate):
        raise StepError(step.advice(state, dt))


def last(states: State) -> State:
    """The last of the states of a run."""
    return jax.tree.map(lambda x: x[-1], states)
