"""What a run is asked of one state: functions (step, state) ↦ array, which `Run.map` maps over members and saves."""

from __future__ import annotations

from typing import Any

import jax
from jax import Array

from lieint_jax.core import State, Step
from lieint_jax.groups import so3


def hamiltonian(step: Step, state: State) -> Array:
    """The energy of a state."""
    return step.system.energy(state)


def body_rates(step: Step, state: State) -> Array:
    """The angular velocity (3,) in the axes of the body, or those of several bodies, (N, 3)."""
    system: Any = step.system
    rates = getattr(system, "angular_velocities", None) or getattr(system, "angular_velocity", None)
    if rates is None:
        raise ValueError(f"{type(system).__name__} has no angular velocity: run.map(f) computes f(step, state)")
    return rates(state)


def space_rates(step: Step, state: State) -> Array:
    """The angular velocities in the axes of space."""
    return _rotated(quaternions(step, state), body_rates(step, state))


def quaternions(step: Step, state: State) -> Array:
    """The attitude (4,), body to space, or those of several bodies, (N, 4)."""
    shape = state.q.shape
    if shape != (4,) and not (len(shape) == 2 and shape[1] == 7):
        raise ValueError(f"{type(step.system).__name__} has no attitudes: its q has the shape {shape}")
    return state.q[..., -4:]


def matrices(step: Step, state: State) -> Array:
    """The rotation matrices (3, 3), body to space, or those of several bodies, (N, 3, 3)."""
    q = quaternions(step, state)
    return so3.to_matrix(q) if q.ndim == 1 else jax.vmap(so3.to_matrix)(q)


def rotated(vector: Array, step: Step, state: State) -> Array:
    """The components in space of a vector of the body, (3,), or of each body, (N, 3)."""
    q = quaternions(step, state)
    return so3.Ad(q, vector) if q.ndim == 1 else jax.vmap(so3.Ad, (0, None))(q, vector)


def _rotated(q: Array, vectors: Array) -> Array:
    return so3.Ad(q, vectors) if q.ndim == 1 else jax.vmap(so3.Ad)(q, vectors)
