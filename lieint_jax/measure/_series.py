"""Angles as continuous series, their mean rates, and the times at which a series stays below a limit."""

from __future__ import annotations

import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._checks import host_array, plain

__all__ = ["captured_since", "first_below", "is_librating", "mean_rate", "unwrapped"]


def unwrapped(t: ArrayLike, angle: ArrayLike, rate: ArrayLike = 0.0) -> np.ndarray:
    """An angle continued over ±π, so that it grows with the number of revolutions.

    Args:
        t: times, (times,).
        angle: in radians, (times, …).
        rate: the expected rate, in radians per unit of time, (…) or a scalar: between two times the angle must deviate
            from that rate by less than π. With it, a spin that is saved less than twice a revolution is continued too.
    """
    t, angle = host_array("t", t), host_array("angle", angle)
    expected = plain("rate", rate) * (t - t[0]).reshape(-1, *[1] * (angle.ndim - 1))
    return expected + np.unwrap(angle - expected, axis=0)


def mean_rate(t: ArrayLike | Array, angle: ArrayLike | Array) -> np.ndarray | Array:
    """The mean rate of an angle: the slope of its least-squares line.

    Of a mean motion with periodic terms it converges like the inverse square of the duration, where the difference
    of both ends converges like its inverse.

    Args:
        t: times, (times,). With arrays of JAX the result can be differentiated.
        angle: a continuous angle in radians, (times, …).

    Returns:
        Radians per unit of time, (…); NaN if there is one time only.
    """
    t, angle = (x if isinstance(x, Array) else host_array(name, x) for name, x in (("t", t), ("angle", angle)))
    centered = t - t.mean()
    with np.errstate(invalid="ignore"):
        return (centered @ angle.reshape(len(t), -1)).reshape(angle.shape[1:]) / (centered @ centered)


def is_librating(angle: ArrayLike, bound: float = np.pi / 2) -> np.ndarray:
    """Whether an angle librates: whether it stays within `bound` of a center, and never crosses into the next cell.

    The centers are the multiples of twice the bound, and the center is the one nearest to the first angle. With the
    bound π/2 either end of an axis may point to the fixed direction; with π only one.

    Args:
        angle: in radians, continuous in time (see `unwrapped`), or in [0, π], (times, …).
        bound: in radians, > 0.

    Returns:
        Truth values (…); False where the angle is NaN.
    """
    angle, bound = host_array("angle", angle), plain("bound", bound)
    center = 2 * bound * np.round(angle[0] / (2 * bound))
    return np.max(np.abs(angle - center), axis=0) < bound


def captured_since(t: ArrayLike, angle: ArrayLike, limit: float) -> np.ndarray:
    """The first of the times from which on an angle, or any series, stays at `limit` or below it.

    Args:
        t: times, (times,).
        angle: (times, …).
        limit: in the unit of `angle`.

    Returns:
        Times (…); NaN where the angle is above the limit at the end.
    """
    t, far = host_array("t", t), ~(host_array("angle", angle) <= plain("limit", limit))
    since = np.where(far.any(axis=0), len(t) - far[::-1].argmax(axis=0), 0)
    return np.where(since < len(t), t[np.minimum(since, len(t) - 1)], np.nan)[()]


def first_below(t: ArrayLike, x: ArrayLike, limit: float, *, interpolate: bool = False) -> np.ndarray:
    """The first of the times at which a series is below `limit`.

    Args:
        t: times, (times,).
        x: (times, …).
        limit: in the unit of `x`.
        interpolate: return the time at which the line from the value before crosses the limit, if both are finite.

    Returns:
        Times (…); NaN where the series is never below the limit.
    """
    t, x, limit = host_array("t", t), host_array("x", x), plain("limit", limit)
    below = x < limit
    k = below.argmax(axis=0)
    found = np.where(below.any(axis=0), t[k], np.nan)
    if interpolate:
        before = np.maximum(k - 1, 0)
        high, low = (np.take_along_axis(x, at[None], 0)[0] for at in (before, k))
        falls = np.isfinite(high) & np.isfinite(low) & (high > low)
        high, low = np.where(falls, high, 1), np.where(falls, low, 0)
        part = np.clip((high - limit) / (high - low), 0, 1)
        found = np.where(falls, t[before] + part * (t[k] - t[before]), found)
    return found[()]
