"""Angles as continuous series, their mean rates, and the times at which a series stays below a limit."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks

__all__ = ["captured_since", "first_below", "is_librating", "mean_rate", "unwrapped"]


def numbers(name: str, value: ArrayLike, kinds: str = "biuf") -> np.ndarray:
    """`value` as an array of real numbers, or with `kinds` "biufc" also of complex ones, in double precision."""
    value = _checks.plain(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} must be an array of numbers, got {_checks.printable(value)}") from error
    if array.dtype.kind not in kinds:
        raise ValueError(f"{name} must hold {'numbers' if 'c' in kinds else 'real numbers'}, got dtype {array.dtype}")
    return array.astype(complex if array.dtype.kind == "c" else float)


def series(t: ArrayLike, x: ArrayLike, name: str = "x", kinds: str = "biuf") -> tuple[np.ndarray, np.ndarray]:
    """Times (times,), finite, and values (times, …) of a name, which may have a NaN, as checked double precision."""
    t, x = numbers("the times", t), numbers(name, x, kinds)
    _check_shapes(t, x)
    if not np.isfinite(t).all():
        raise ValueError(f"the times must be finite, got {np.sum(~np.isfinite(t))} of {len(t)} that are not")
    return t, x


def _check_shapes(t: Any, x: Any) -> None:
    if t.ndim != 1 or not t.size or x.shape[:1] != t.shape:
        raise ValueError(
            f"the times must be (times,), one or more, and the series (times, …), got {t.shape}, {x.shape}"
        )


def _limit(limit: ArrayLike) -> np.ndarray:
    found = numbers("limit", limit)
    if np.isnan(found).any():
        raise ValueError("limit must be a number, got NaN")
    return found


def unwrapped(t: ArrayLike, angle: ArrayLike, rate: ArrayLike = 0.0) -> np.ndarray:
    """An angle continued over ±π, so that it grows with the number of revolutions.

    Args:
        t: times, (times,).
        angle: in radians, (times, …); after a NaN all is NaN.
        rate: the expected rate, in radians per unit of time, (…) or a scalar: between two times the angle must deviate
            from that rate by less than π. With it, a spin that is saved less than twice a revolution is continued too.

    Raises:
        ValueError: not as many times as angles, times that are not finite.
    """
    t, angle = series(t, angle, "angle")
    rate = numbers("rate", rate)
    with np.errstate(invalid="ignore"):
        expected = rate * (t - t[0]).reshape(-1, *[1] * (angle.ndim - 1))
        return expected + np.unwrap(angle - expected, axis=0)


def mean_rate(t: ArrayLike | Array, angle: ArrayLike | Array) -> np.ndarray | Array:
    """The mean rate of an angle: the slope of its least-squares line under Hann's window.

    Of a mean motion with periodic terms it converges like the inverse fourth power of the duration, where without a
    window it would do so like the inverse square, and the difference of both ends like the inverse.

    Args:
        t: times, (times,). With arrays of JAX the result can be differentiated.
        angle: a continuous angle in radians, (times, …).

    Returns:
        Radians per unit of time, (…); NaN if there is one time only, and where the angle is not finite.

    Raises:
        ValueError: not as many times as angles, none, or times that are not finite.
    """
    if isinstance(t, Array) or isinstance(angle, Array):
        xp, t, angle = jnp, jnp.asarray(t), jnp.asarray(angle)
        _check_shapes(t, angle)
    else:
        xp, (t, angle) = np, series(t, angle, "angle")
    with np.errstate(invalid="ignore", divide="ignore"):
        weights, columns = slope_weights(t, xp), angle.reshape(len(t), -1)
        return (weights @ (columns - columns.mean(axis=0))).reshape(angle.shape[1:])


def slope_weights(t: Any, xp: Any = np) -> Any:
    """The factors (times,) whose product with a series is the slope of its line under Hann's window; their sum is 0."""
    n = len(t)
    reach = (t.max() - t.min()) / 2 * (n / max(n - 1, 1))  # so that the window is not 0 at both ends
    s = (t - (t.max() + t.min()) / 2) / reach
    window = 1 + xp.cos(np.pi * s)
    weight = window / window.sum()
    centered = s - weight @ s
    return weight * centered / ((weight * centered) @ centered) / reach


def is_librating(angle: ArrayLike, bound: float = np.pi / 2) -> np.ndarray:
    """Whether an angle librates: whether it stays within `bound` of a center, and never crosses into the next cell.

    The centers are the multiples of twice the bound, and the center is the one nearest to the first angle. With the
    bound π/2 either end of an axis may point to the fixed direction; with π only one.

    Args:
        angle: in radians, continuous in time (see `unwrapped`), or in [0, π], (times, …).
        bound: in radians, > 0.

    Returns:
        Truth values (…); False where the angle is NaN.

    Raises:
        ValueError: no angle, or a bound that is not positive.
    """
    angle, half = numbers("angle", angle), numbers("bound", bound)
    if not angle.ndim or not len(angle) or not np.all(half > 0):
        raise ValueError(f"angle must be (times, …) and bound > 0, got shape {angle.shape} and {bound}")
    with np.errstate(invalid="ignore"):
        center = 2 * half * np.round(angle[0] / (2 * half))
        return np.max(np.abs(angle - center), axis=0) < half


def captured_since(t: ArrayLike, angle: ArrayLike, limit: ArrayLike) -> np.ndarray:
    """The first of the times from which on an angle, or any series, stays at `limit` or below it.

    Args:
        t: times, (times,).
        angle: (times, …).
        limit: in the unit of `angle`, a scalar or (…).

    Returns:
        Times (…); NaN where the angle is above the limit, or NaN, at the end.

    Raises:
        ValueError: not as many times as angles, none, times that are not finite, or a limit that is NaN.
    """
    t, angle = series(t, angle, "angle")
    far = ~(angle <= _limit(limit))
    since = np.where(far.any(axis=0), len(t) - far[::-1].argmax(axis=0), 0)
    return np.where(since < len(t), t[np.minimum(since, len(t) - 1)], np.nan)[()]


def first_below(t: ArrayLike, x: ArrayLike, limit: ArrayLike, *, interpolate: bool = False) -> np.ndarray:
    """The first of the times at which a series is below `limit`.

    Args:
        t: times, (times,).
        x: (times, …).
        limit: in the unit of `x`, a scalar or (…).
        interpolate: return the time at which the line from the value before crosses the limit, if both are finite.

    Returns:
        Times (…); NaN where the series is never below the limit.

    Raises:
        ValueError: not as many times as values, none, times that are not finite, or a limit that is NaN.
    """
    t, x = series(t, x)
    limit = _limit(limit)
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
