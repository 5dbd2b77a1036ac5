"""Runs of any length by one compiled program, so that measurements of a step need few compilations."""

from __future__ import annotations

import jax
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import at_once, concrete
from lieint_jax.core import State, Step, StepError, Trajectory, checked_step, promoted
from lieint_jax.runs import clock_of, of_any_length, rows_for, trajectory


def run(step: Step, state: State, dt: Array, count: int, most: int, save_every: int = 1) -> Trajectory:
    """The trajectory with `count` saved states after the first, as host arrays if they are concrete.

    It is the trajectory of `integrate`, by one program for all counts up to `most` and all `save_every`.
    """
    clock, _ = clock_of(step, state, dt.dtype, dt, count * save_every, None)
    most = max(count, most)
    found = of_any_length(step, state, clock, count, rows_for(state, most) or most, save_every)
    return trajectory(step, state, clock, count, save_every) if found is None else found


def checked(step: Step, state: State, dt: ArrayLike, most: int) -> tuple[Step, State, Array]:
    """Step, state and dt in one dtype, checked as by `Step.check` if they are concrete, by the program of `run`."""
    step, state, dtype = promoted(checked_step(step), state)
    h = _checks.as_array(_checks.step_size(dt), dtype)
    if not concrete(step, state, h):
        return step, state, h
    with at_once():  # constants are concrete inside jit too
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
