"""Interpolation between saved states, for pictures, and the angles by which bodies rotate between saved states."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.runs import interpolate
from lieint_jax.systems import LinearPotential
from lieint_jax.types import Trajectory

MAX_ROTATION = 2.6  # rad between saved states: interpolation then has an error of 0.3° (tumbling bodies)


def rotation_angles(system: Any, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Estimated angles of rotation between saved states, of the fastest body and of a top's axis, (saves − 1,), rad."""
    rates = system.angular_velocities if hasattr(system, "angular_velocities") else system.angular_velocity
    Omega = np.asarray(jax.jit(jax.vmap(rates))(jax.tree.map(jnp.asarray, run.state)))
    Omega, axis = Omega.reshape(len(Omega), -1, 3), top_axis(system)
    across = Omega if axis is None else np.cross(Omega, axis)

    def largest_angles(rates: np.ndarray) -> np.ndarray:
        speed = np.linalg.norm(rates, axis=-1).max(axis=1)
        return np.maximum(speed[1:], speed[:-1]) * abs(np.diff(run.t))

    return largest_angles(Omega), largest_angles(across)


def interpolate_at(system: Any, run: Trajectory, times: np.ndarray) -> Trajectory:
    """The trajectory at times inside it, by interpolation; bodies rotate by at most `MAX_ROTATION` between saves."""
    return Trajectory(jnp.asarray(times), interpolate(system, run, times), run.info)


def top_axis(system: Any) -> np.ndarray | None:
    """The axis (3,) of a heavy top in the body, from the fixed point to the center of mass; None for other systems."""
    potential = getattr(system, "potential", None)
    weight = np.asarray(potential.weight) if isinstance(potential, LinearPotential) else np.zeros(3)
    return weight / np.linalg.norm(weight) if weight.any() else None
