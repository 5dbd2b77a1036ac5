"""The ellipse that precesses through a series of ellipses: means over revolutions, and the line of their arguments."""

from __future__ import annotations

import numpy as np

from lieint_jax.measure._series import mean_rate

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
    mean = vectors.mean() if len(vectors) else np.zeros(())
    size, scatter = abs(mean), abs(vectors - mean)
    if len(times) < _FEWEST or not size > max(np.sqrt(np.mean(scatter**2)), _ROUNDINGS * eps * np.sqrt(len(t))):
        return (motion, size, *_NOTHING[2:])
    centered = times - times.mean()
    relative = vectors / mean - 1  # along the mean vector and across it
    errors = size * _deviation(relative.real) / len(times), _deviation(centered * relative.imag) / (centered @ centered)
    return (float(mean_rate(times, along)), size, rate, *errors)


def _means(t: np.ndarray, longitude: np.ndarray, e: np.ndarray, rate: float) -> tuple[np.ndarray, ...]:
    """Times, longitudes and vectors, in axes that rotate at `rate`, averaged about every whole revolution in these axes.

    By Hann's windows two revolutions wide; those that the run does not fill are left out.
    """
    anomaly = (longitude - longitude[0] - rate * t) * np.sign(longitude[-1] - longitude[0])
    turns = np.maximum(anomaly / (2 * np.pi), 0)
    before = turns.astype(int)
    after = np.sin(np.pi / 2 * (turns - before)) ** 2  # the share of the window about the next revolution
    duration = abs(np.gradient(t))

    def sums(x: np.ndarray) -> np.ndarray:
        parts = ((before, 1 - after), (before + 1, after))
        return sum(np.bincount(k, share * duration * x, int(turns.max()) + 2) for k, share in parts)[1 : int(turns[-1])]

    rotated = e * np.exp(-1j * rate * t)
    weight = sums(np.ones(len(t)))
    seen = weight > 0
    times, along, x, y = (sums(x)[seen] / weight[seen] for x in (t, longitude, rotated.real, rotated.imag))
    return times, along, x + 1j * y


def _deviation(x: np.ndarray) -> float:
    """The standard deviation of the sum of n residuals of a line, which are correlated with up to √n neighbors."""
    n = len(x)
    reach = int(np.sqrt(n))
    variance = x @ x + 2 * sum((1 - k / (reach + 1)) * (x[k:] @ x[:-k]) for k in range(1, reach + 1))
    return float(np.sqrt(max(variance, 0) * n / (n - 2)))
