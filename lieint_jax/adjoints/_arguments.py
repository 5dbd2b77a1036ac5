"""Checks of the arguments that `reversible` and `observe` share."""

from __future__ import annotations

from typing import Literal, get_args

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.types import State, Step, checked_step, promoted, start_time

Derivative = Literal["reversible", "checkpoint"]


def check_derivative(derivative: str) -> None:
    """Raise ValueError for an unknown derivative."""
    if derivative not in get_args(Derivative):
        raise ValueError(f"derivative must be one of {', '.join(get_args(Derivative))}, got {derivative!r}")


def check_symmetric(step: Step) -> None:
    """Raise ValueError if steps cannot be undone."""
    if not step.symmetric:
        raise ValueError(
            f'{step.name} is not symmetric, so its steps cannot be undone by −dt: give derivative="checkpoint" '
            "(adjoint=li.adjoints.RecursiveCheckpointAdjoint() to li.integrate), or use a symmetric scheme"
        )


def checked(step: Step, state: State, dt: ArrayLike, derivative: str) -> tuple[Step, State, Array]:
    """Check the arguments; return step, state and dt in their common dtype."""
    check_derivative(derivative)
    checked_step(step)
    if derivative == "reversible":
        check_symmetric(step)
    step, state, dtype = promoted(step, state)
    step.check(state, dt)
    _checks.time_resolution(start_time(step, state), dt, 0)
    return step, state, jnp.asarray(_checks.step_size(dt), dtype)
