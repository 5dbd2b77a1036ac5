"""How bodies point and rotate: tilts, poles, rates, and the two periods of a tumbling body."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax.capabilities import AbstractFreeBody, AbstractManyBodies, AbstractRotatingBody
from lieint_jax.core import State, Step
from lieint_jax.measure._series import mean_rate
from lieint_jax.measure._states import (
    Directions,
    angles,
    angular_momentum,
    directions,
    principal_axes,
    rotate,
    rotation,
    series_of,
    system_of,
    times_of,
)
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run

__all__ = ["MeasuredPeriods", "Pole", "pole", "rotation_rates", "tilt", "tumbling_periods"]

_UPRIGHT = 64  # eps: a smaller angle between Π and the axis is rounding
_COARSE = 2.5  # largest angle, at the rate |Π|/J₁, between saved states that can be unwrapped safely


def tilt(run: Run, axis: ArrayLike = (0.0, 0.0, 1.0), direction: Directions | None = None) -> np.ndarray:
    """The angle of a body axis from its own initial direction, or from a given direction in space.

    Args:
        run: of a rigid body, of several, or on SO(3) or SE(3).
        axis: in the body, (3,), of any length but 0.
        direction: in space, (3,), or one for each saved time, (times, 3), or a function of time; by default the
            initial direction of each member's axis.

    Returns:
        Radians in [0, π], (times,) or (times, members); of N bodies with a last axis (N,).

    Raises:
        ValueError: the states have no attitude; a wrong shape.
    """
    e = series_of(run, _axis_in_space, _checks.real_array("axis", axis, (3,)))
    if direction is None:
        return angles(e, e[0])
    given = np.asarray(directions("direction", direction, run))
    return angles(e, given.reshape(*given.shape[:-1], *[1] * (e.ndim - given.ndim), 3))


def _axis_in_space(axis: Array, step: Step, state: State) -> Array:
    return rotate(rotation(step, state), axis.astype(state.q.dtype))


class Pole(NamedTuple):
    """A direction in space.

    Attributes:
        longitude: from x toward y, radians in [0, 2π).
        latitude: from the x-y plane toward z, radians.
    """

    longitude: np.ndarray
    latitude: np.ndarray


def pole(run: Run) -> Pole:
    """The direction of the total angular momentum at each saved time; of several bodies, that about the origin.

    Args:
        run: of a rigid body, a top, a pendulum or several bodies.

    Returns:
        A `Pole` of arrays (times,) or (times, members); without rotation both angles are 0.

    Raises:
        ValueError: the system has no angular momentum (3,).
    """
    x, y, z = np.moveaxis(series_of(run, angular_momentum), -1, 0)
    along = np.arctan2(y, x)
    along = np.where(along < 0, along + 2 * np.pi, along)
    return Pole(np.where(along < 2 * np.pi, along, 0), np.arctan2(z, np.hypot(x, y)))  # −1e-17 + 2π is 2π


def rotation_rates(run: Run) -> np.ndarray:
    """The size of the angular velocity, in radians per unit of time.

    Args:
        run: of a rigid body, or of several.

    Returns:
        (times,) or (times, members); of N bodies with a last axis (N,).

    Raises:
        ValueError: the system has no angular velocity.
    """
    return series_of(run, _rotation_rate)


def _rotation_rate(step: Step, state: State) -> Array:
    system = step.system
    if isinstance(system, AbstractManyBodies):
        return jnp.sqrt(jnp.sum(system.angular_velocities(state) ** 2, axis=1))
    if isinstance(system, AbstractRotatingBody):
        return vectors.norm(system.angular_velocity(state))
    raise ValueError(f"the system must be of rigid bodies, which have an angular velocity; got {system!r}")


class MeasuredPeriods(NamedTuple):
    """The mean periods of a tumbling body over a run, in its unit of time.

    Attributes:
        precession: of the body's axis about the angular momentum: the axis of least moment in the long-axis mode,
            that of greatest moment in the short-axis mode.
        rotation: of Π about that axis in the body.
        long_axis: whether the body tumbles in the long-axis mode, |Π|² < 2H J₂ (Poinsot).
    """

    precession: np.ndarray
    rotation: np.ndarray
    long_axis: np.ndarray


def tumbling_periods(run: Run) -> MeasuredPeriods:
    """The two mean periods of a tumbling free body, from its motion: those of the mean rates of two angles.

    They converge like `mean_rate`, with the inverse fourth power of the duration, to those in closed form of
    `run.periods()`. There `precession` is that of the long axis in both modes: in the short-axis mode 1/P of the short
    axis is 1/P + 1/P_rotation of the long one.

    Args:
        run: of a free rigid body.

    Returns:
        `MeasuredPeriods` of scalars or arrays (members,); NaN where the body spins about the axis, or where states are
        saved too rarely to count revolutions (more than 2.5 rad at the rate |Π|/J₁).

    Raises:
        ValueError: the body is not free, or a batch whose step has its own time.
    """
    if not isinstance(system_of(run), AbstractFreeBody):
        raise ValueError(f"periods are those of a free body, such as systems.rigid_body(…); got {run.system!r}")
    (moments, axes), R = principal_axes(run), series_of(run, rotation)
    pi, t = np.asarray(run.state.p[0], float), np.asarray(times_of(run), float)
    Pi = np.einsum("t...ji,...j,...ik->t...k", R, pi, axes)
    square = np.sum(Pi[0] ** 2, axis=-1)
    long = square < np.sum(Pi[0] ** 2 / moments, axis=-1) * moments[..., 1]
    e = np.einsum("t...ij,...j->t...i", R, np.where(long[..., None], axes[..., 0], axes[..., 2]))
    up = pi / np.maximum(np.linalg.norm(pi, axis=-1, keepdims=True), np.finfo(float).tiny)
    across = np.stack(frame(jnp.asarray(np.moveaxis(up, -1, 0))))
    phi = np.unwrap(np.arctan2(*np.einsum("ki...,t...i->kt...", across, e)[::-1]), axis=0)
    x, y = (np.where(long, Pi[..., k + 1], Pi[..., k]) for k in (0, 1))
    psi = np.unwrap(np.arctan2(y, x), axis=0)
    coarse = np.sqrt(square) / moments[..., 0] * np.max(abs(np.diff(t)), initial=0) > _COARSE
    upright = np.hypot(x[0], y[0]) <= _UPRIGHT * np.finfo(np.asarray(run.state.p).dtype).eps * np.sqrt(square)

    def period(angle: np.ndarray) -> np.ndarray:
        rate = abs(mean_rate(t, angle))
        missing = coarse | upright | ~(rate > 0)
        return np.where(missing, np.nan, 2 * np.pi / np.where(missing, 1, rate))[()]

    return MeasuredPeriods(period(phi), period(psi), long)
