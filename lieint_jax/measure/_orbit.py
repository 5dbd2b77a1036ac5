"""A body on a given orbit: its principal axes in the axes of the orbit."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import plain
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Matrix3, Time, Vector3
from lieint_jax.core import State, Step, clock
from lieint_jax.measure._states import angles, principal_axes, rotation, series_of, system_of
from lieint_jax.runs import Run

__all__ = ["OrbitAngles", "orbit_angles", "orbit_axes"]

_DISTINCT = 1e-9  # least difference of two moments whose axes are determined, over the greatest


class OrbitAngles(NamedTuple):
    """How a body on an orbit points, in radians in [0, π].

    Attributes:
        vertical: the angle of the axis of least moment from the outward vertical; 0 and π are both stable.
        normal: the angle of the axis of greatest moment from the normal of the orbit.
    """

    vertical: np.ndarray
    normal: np.ndarray


def orbit_axes(orbit: Callable[[Array], tuple[Array, Array]], t: Time) -> tuple[Matrix3, Vector3]:
    """The axes of an orbit at a time, and how they rotate. (To point to the nadir, see `orbits.lvlh`.)

    Args:
        orbit: t ↦ (position, velocity), such as `orbits.kepler(…)`.
        t: the time, a scalar.

    Returns:
        The matrix with the columns outward, along the motion and along the normal, (3, 3), and its angular velocity in
        space, (3,).
    """
    position, velocity = orbit(plain("t", t))
    normal = jnp.stack(vectors.cross(position, velocity))
    r, z = (x / vectors.norm(x) for x in (position, normal))
    return jnp.stack([r, jnp.stack(vectors.cross(z, r)), z], axis=1), normal / vectors.dot(position, position)


def orbit_angles(run: Run) -> OrbitAngles:
    """The angles of the principal axes from the vertical and the normal of the orbit.

    `is_librating(orbit_angles(run).vertical)`: whether the axis of least moment never crosses the horizon.

    Args:
        run: of a body with an attribute `orbit`, such as `systems.gravity_gradient(…)`.

    Returns:
        `OrbitAngles` of arrays (times,) or (times, members); NaN where a moment is equal to its neighbor, so that its
        axis is not determined.

    Raises:
        ValueError: the body has no orbit.
    """
    if not hasattr(system_of(run), "orbit"):
        raise ValueError(f"the body must have an orbit, as systems.gravity_gradient(…) has one; got {run.system!r}")
    moments, axes = principal_axes(run)
    R, of_orbit = series_of(run, _both_axes)
    distinct = np.diff(moments, axis=-1) > _DISTINCT * moments[..., 2:]

    def angle(body: int, orbit: int, exists: np.ndarray) -> np.ndarray:
        e = np.einsum("t...ij,...j->t...i", R, axes[..., body])
        return np.where(exists, angles(e, of_orbit[..., orbit]), np.nan)

    return OrbitAngles(angle(0, 0, distinct[..., 0]), angle(2, 2, distinct[..., 1]))


def _both_axes(step: Step, state: State) -> tuple[Array, Array]:
    return rotation(step, state), orbit_axes(step.system.orbit, clock(state))[0]  # pyright: ignore[reportAttributeAccessIssue]
