"""The ellipse that precesses through a series of ellipses: means over revolutions, and the line of their arguments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lieint_jax.measure._series import mean_rate, slope_weights

__all__ = ["mean_ellipse"]

_FEWEST = 3  # means over revolutions of a fit and its errors
_ITERATIONS = 20  # of the rate of precession: each multiplies its error by about the rate per revolution
_ROUNDINGS = 8  # times eps √times: a shorter vector is round-off of the states
_NOTHING = (np.nan,) * 5


def mean_ellipse(t: np.ndarray, longitude: np.ndarray, e: np.ndarray, eps: float) -> tuple[float, ...]:
    """The mean motion, eccentricity and rate of precession of an orbit, and the standard errors of the latter two.

    Args:
        t: times, (times,).
        longitude: the mean longitude, continuous in time, (times,).
        e: Laplace's vector as a complex number, e exp(iϖ), (times,).
        eps: the rounding of its type.
    """
    if not (np.isfinite(longitude).all() and np.isfinite(e).all() and np.ptp(longitude) > 2 * np.pi):
        return _NOTHING
    t, rate = t - t[0], 0.0
    times, along, vectors = _means(t, longitude, e, rate)
    if len(times) < _FEWEST:
        return (float(mean_rate(t, longitude)), *_NOTHING[1:])
    motion = float(mean_rate(times, along))
    for _ in range(_ITERATIONS):
        change = float(mean_rate(times, np.unwrap(np.angle(vectors))))
        rate += change
        times, along, vectors = _means(t, longitude, e, rate)
        if len(times) < _FEWEST or not abs(change * t[-1]) > 4 * np.finfo(float).eps:
            break
    least = _ROUNDINGS * eps * np.sqrt(len(t))
    if len(times) < _FEWEST or not abs(vectors.mean()) > max(np.std(vectors), least):
        vectors = _means(t, longitude, e, 0.0)[2]
        return motion, abs(vectors.mean()), np.nan, float(np.std(vectors) / np.sqrt(len(vectors) - 1)), np.nan
    size, relative = abs(vectors.mean()), vectors / vectors.mean() - 1  # along the mean vector and across it
    one, centered = np.ones(len(times)), times - times.mean()
    of_size = size * _deviation(relative.real, one, [one]) / len(times)
    across = relative.imag - relative.imag.mean() - (relative.imag @ centered) / (centered @ centered) * centered
    of_rate = _deviation(across, slope_weights(times), [one, centered])
    motion = float(mean_rate(times, along))
    rounding = eps * (abs(motion) + 1 / (size * np.ptp(t)))
    return motion, size, rate, of_size, float(np.hypot(of_rate, rounding))


def _means(t: np.ndarray, longitude: np.ndarray, e: np.ndarray, rate: float) -> tuple[np.ndarray, ...]:
    """Times, longitudes and vectors in axes that rotate at `rate`, averaged about each whole revolution there.

    By Hann's windows two revolutions wide; those that the run does not fill are left out.
    """
    anomaly = (longitude - longitude[0] - rate * t) * np.sign(longitude[-1] - longitude[0])
    turns = np.maximum(anomaly / (2 * np.pi), 0)
    before = turns.astype(int)
    after = np.sin(np.pi / 2 * (turns - before)) ** 2  # the share of the window about the next revolution
    duration = abs(np.gradient(t))

    def sums(x: np.ndarray) -> np.ndarray:
        parts = ((before, 1 - after), (before + 1, after))
        first, second = (np.bincount(k, share * duration * x, int(turns.max()) + 2) for k, share in parts)
        return (first + second)[1 : int(turns[-1])]

    rotated: np.ndarray = e * np.exp(-1j * rate * t)
    weight = sums(np.ones(len(t)))
    seen = weight > 0
    times, along, x, y = (sums(x)[seen] / weight[seen] for x in (t, longitude, np.real(rotated), np.imag(rotated)))
    return times, along, x + 1j * y


def _deviation(x: np.ndarray, weight: np.ndarray, fitted: Sequence[np.ndarray]) -> float:
    """The standard deviation of weight·x of residuals x, (n,), each correlated with up to √n neighbors.

    The x are what a fit of the orthogonal series `fitted` leaves of noise, and are scaled up by what it takes from the
    result if the noise is white.
    """
    n = len(x)
    reach = int(np.sqrt(n))

    def square(y: np.ndarray) -> float:
        return float(y @ y) + 2 * sum((1 - k / (reach + 1)) * float(y[k:] @ y[:-k]) for k in range(1, reach + 1))

    left = 1 - sum(square(weight * f) / (f @ f) for f in fitted) / (weight @ weight)
    return float(np.sqrt(square(weight * x) / left))
