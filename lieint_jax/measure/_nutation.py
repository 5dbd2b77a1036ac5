"""Nutation and precession of the axis of a top, or of a pendulum, about the axis of its field."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Vector3
from lieint_jax.core import State, Step, System
from lieint_jax.measure._series import mean_rate, unwrapped
from lieint_jax.measure._spectrum import even_spacing
from lieint_jax.measure._states import rotate, series_of, times_of
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run
from lieint_jax.systems import LinearPotential, Pendulum, PotentialTop

__all__ = ["Nutation", "nutation"]

_MIN_SAMPLES = 6  # saved states per nutation that a measurement needs
_STENCIL = 6  # saved states through which an angle and its rate are interpolated
_ROUNDINGS = 64  # times eps √times: the cosine of a steady inclination varies by less
_HALVINGS = 50  # of the interval between two saved states that contains an extreme


class Nutation(NamedTuple):
    """The mean nutation of an axis over whole nutations; scalars or arrays (members,).

    Attributes:
        period: the mean time from lowest point to lowest point.
        precession_rate: the mean angular velocity of the axis about γ between them, in radians per unit of time; of an
            axis at a constant angle that over all times.
        least, greatest: the least and the greatest angle between the axis and γ, in radians.
    """

    period: np.ndarray
    precession_rate: np.ndarray
    least: np.ndarray
    greatest: np.ndarray


def nutation(run: Run, axis: ArrayLike | None = None) -> Nutation:
    """Nutation and precession of a top's axis about its field's axis γ, or of a pendulum's bob.

    The axis and its rates, from the equations of motion, are interpolated between saved states by polynomials of
    degree 11 through 6 of them, so that a few saves per nutation give many digits. γ points up for a `heavy_top`, down
    for a `pendulum`, as there. For the motion in closed form, see `systems.lagrange_motion`.

    Args:
        run: of a top or a pendulum, saved at even times.
        axis: of the top in the body, a unit vector (3,); by default that from the fixed point to the center of mass.

    Returns:
        A `Nutation`; period and rate are NaN where the axis is lowest fewer than twice, or states are saved fewer than
        6 times in a nutation. The angles are then those of the saved states. In a steady precession the period alone is
        NaN. The rate is NaN where the axis passes through ±γ, up to √eps: there its azimuth jumps by half a revolution,
        in no certain sense. So it is of a pendulum that swings in a plane; the plane is at rest.

    Raises:
        ValueError: the system is neither, its field has no fixed axis, or its axis is not known; uneven times; a batch
            whose step has its own time.
    """
    given = None if axis is None else _checks.unit_vector("axis", axis)
    rows, down = series_of(run, _motion, given)
    h = even_spacing(times_of(run))
    members = rows.reshape(len(rows), -1, 3, 3).astype(float)
    eps = float(np.finfo(rows.dtype).eps)
    found = np.array([_measure(h, members[:, m], eps) for m in range(members.shape[1])])
    period, rate, least, greatest = found.T.reshape(4, *rows.shape[1:-2])
    hangs = down[0]  # of a pendulum measured about −γ
    return Nutation(
        period[()],
        np.where(hangs, -rate, rate)[()],
        np.where(hangs, np.pi - greatest, least)[()],
        np.where(hangs, np.pi - least, greatest)[()],
    )


def _motion(axis: Array | None, step: Step, state: State) -> tuple[Array, Array]:
    """The axis, its velocity and its acceleration, (3, 3), each across and along "up"; and whether that is −γ."""
    system, state = step.system, State(state.q, state.p)
    direction, gamma = _axis_of(system, axis), _field_axis(system)
    hangs = jnp.zeros((), bool)
    if isinstance(system, Pendulum):
        hangs = system.potential(gamma) < system.potential(-gamma)
    up = jnp.where(hangs, -gamma, gamma)

    def velocity(z: State) -> Array:
        return jax.jvp(direction, (z,), (system.vector_field(z),))[1]

    e, v = direction(state), velocity(state)
    a = jax.jvp(velocity, (state,), (system.vector_field(state),))[1]
    across = frame(up)
    return jnp.stack([jnp.stack([vectors.dot(x, y) for y in (*across, up)]) for x in (e, v, a)]), hangs


def _axis_of(system: System, axis: Array | None) -> Callable[[State], Array]:
    """The measured axis in space as a function of the state."""
    if isinstance(system, Pendulum) and axis is None:
        return lambda z: z.q
    if not isinstance(system, PotentialTop):
        raise ValueError(
            f"nutation is that of a top, as systems.heavy_top(…), or without an axis of a pendulum; got {system!r}"
        )
    if axis is None:
        if not isinstance(system.potential, LinearPotential):
            raise ValueError("the potential has no center of mass: give the axis of the top in the body, axis=(…)")
        weight = system.potential.weight
        axis = weight / vectors.norm(weight)
    return partial(_rotated, system, axis)


def _rotated(system: PotentialTop, axis: Array, state: State) -> Array:
    return rotate(system.rotation_matrix(state), axis)


def _field_axis(system: System) -> Vector3:
    match system:
        case object(axis=axis) if axis is not None:
            return axis / vectors.norm(axis)
    raise ValueError("the potential is a function V(Λ) without an axis γ, about which there is no precession")


def _measure(h: float, rows: np.ndarray, eps: float) -> tuple[float, float, float, float]:
    """Period, mean rate, least and greatest angle from "up" of one member, from its rows (times, 3, 3)."""
    (x, y, u), (dx, dy, slope) = rows[:, 0].T, h * rows[:, 1].T  # rates per saved state, also backward
    curvature = h * h * rows[:, 2, 2]
    period = rate = np.nan
    lowest, highest = (np.flatnonzero((s * slope[:-1] < 0) & (s * slope[1:] >= 0)) for s in (1, -1))
    rounding = _ROUNDINGS * eps * math.sqrt(len(u))
    if np.ptp(u) <= rounding < np.min(x * x + y * y):
        steps, turns = np.arange(len(u)), np.mean((x * dy - y * dx) / (x * x + y * y))
        rate = float(mean_rate(h * steps, unwrapped(steps, np.arctan2(y, x), turns)))
    elif len(lowest) > 1 and np.diff(lowest).min() >= _MIN_SAMPLES:
        low, high = (_Extremes.from_slope(k, slope, curvature) for k in (lowest, highest))
        at = np.concatenate([np.arange(len(x)), high.position, low.position])
        x, y = (np.concatenate([z, high.value(z, dz), low.value(z, dz)]) for z, dz in ((x, dx), (y, dy)))
        order = np.argsort(at)
        phi = np.empty(len(at))
        phi[order] = np.unwrap(
            np.arctan2(y, x)[order]
        )  # also of an axis that nearly passes through γ between two saves
        duration = h * (at[-1] - at[-len(lowest)])
        period = abs(duration) / (len(lowest) - 1)
        if np.hypot(x, y).min() > math.sqrt(eps):
            rate = (phi[-1] - phi[-len(lowest)]) / duration
        u = np.concatenate([u, high.value(u, slope), low.value(u, slope)])
    angle = np.arctan2(np.hypot(x, y), u)
    return period, rate, angle.min(), angle.max()


class _Extremes(NamedTuple):
    """Extremes of a series with known rates, between saved states, by Hermite polynomials.

    Attributes:
        first: the index of the first saved state of each polynomial, (n,).
        offset: the index of each extreme relative to the middle of the polynomial's states, (n,).
    """

    first: np.ndarray
    offset: np.ndarray

    @classmethod
    def from_slope(cls, before: np.ndarray, slope: np.ndarray, curvature: np.ndarray) -> Self:
        """The zeros of `slope`, whose rate is `curvature`, each after the saved state `before`."""
        first = np.clip(before - _STENCIL // 2 + 1, 0, len(slope) - _STENCIL)
        low = before - first - (_STENCIL - 1) / 2
        high, sign = low + 1, np.sign(slope[before])
        polynomial = _hermite(first, slope, curvature)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            same = np.sign(_value(polynomial, middle)) == sign
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return cls(first, (low + high) / 2)

    @property
    def position(self) -> np.ndarray:
        """The indices of the extremes among the saved states."""
        return self.first + self.offset + (_STENCIL - 1) / 2

    def value(self, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """The values at the extremes of a series y with this slope."""
        return _value(_hermite(self.first, y, slope), self.offset)


def _hermite(first: np.ndarray, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The coefficients (2·_STENCIL, n) of the polynomials through y with this slope, from each `first` on."""
    nodes, powers = np.arange(_STENCIL) - (_STENCIL - 1) / 2, np.arange(2 * _STENCIL)
    conditions = np.concatenate([nodes[:, None] ** powers, powers * nodes[:, None] ** np.maximum(powers - 1, 0)])
    rows = first + np.arange(_STENCIL)[:, None]
    return np.linalg.solve(conditions, np.concatenate([y[rows], slope[rows]]))


def _value(polynomial: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.polynomial.polynomial.polyval(x, polynomial, tensor=False)
