"""Runs of any length by one compiled program: what is measured of a step is measured with few compilations."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.integrate import from_start
from lieint_jax.types import State, Step, StepError, StepInfo, Trajectory, checked_step, on_clock, promoted, start_time


@partial(jax.jit, static_argnums=4)
def _run(step: Step, state: State, dt: Array, count: int, most: int) -> Trajectory:
    prepared, t0 = step.prepare(state, dt), start_time(step, state)
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (most, *x.shape)), (state, StepInfo.fresh(state.p)))

    def one(n: Array, carry: tuple[State, tuple[State, StepInfo]]) -> tuple[State, tuple[State, StepInfo]]:
        state, rows = carry
        state, info = prepared(state, dt)
        state = on_clock(state, t0, n + 1, dt)
        return state, jax.tree.map(lambda to, x: to.at[n].set(x), rows, (state, info))

    return from_start(step, state, lax.fori_loop(0, count, one, (state, rows))[1], dt, 1)


def run(step: Step, state: State, dt: Array, count: int, most: int) -> Trajectory:
    """The trajectory of `count` steps, each saved, as host arrays if they are concrete.

    What `integrate` does at each step; compiled once for all counts up to `most`.
    """
    rows = _run(step, state, dt, count, max(count, most))
    return jax.tree.map(lambda x: (np.asarray(x) if concrete(x) else x)[: count + 1], rows)


def checked(step: Step, state: State, dt: ArrayLike, most: int) -> tuple[Step, State, Array]:
    """The three in one dtype; raises what `Step.check` raises if they are concrete, by the program of `run`."""
    step, state, dtype = promoted(checked_step(step), state)
    h = jnp.asarray(_checks.step_size(dt), dtype)
    if not concrete(step, state, h):
        return step, state, h
    with jax.ensure_compile_time_eval():  # constants are concrete inside jit too
        step.system.check(state)
    converged = run(step, state, h, 1, most).info.converged[1]
    if not concrete(converged):
        step.check(state, h)
    elif not (converged or step.approximate):
        raise StepError(step.advice(state, h))
    return step, state, h


def last(run: Trajectory) -> State:
    """The last state of a run."""
    return jax.tree.map(lambda x: x[-1], run.state)
