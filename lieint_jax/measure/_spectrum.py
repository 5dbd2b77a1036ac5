"""Frequencies and amplitudes of a series: at even times by Fourier's transform, at any times by least squares."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.measure._series import numbers, series

__all__ = ["Line", "Periodogram", "Spectrum", "complex_rates", "line", "periodogram", "spectrum"]

_REFINEMENTS = 6  # of a frequency, each by the parabola through three values of the transform
_FEWEST = 4  # times of a spectrum
_EVEN = 0.01  # largest deviation of a time from even spacing, over the spacing
_OVERSAMPLING = 10  # default frequencies per resolution, 1/duration
_AT_ONCE = 2**21  # waves times data that are summed together
ROUNDING = 4 * np.finfo(float).eps  # standard deviation of a constant, over its size; double precision
_SINGULAR = 1e-12  # mean square of a wave that the times do not see, such as a sine at the Nyquist frequency


class Spectrum(NamedTuple):
    """The spectrum of a series.

    Attributes:
        frequency: in cycles per unit of time, (frequencies,).
        amplitude: in the unit of the series, (frequencies, …).
    """

    frequency: np.ndarray
    amplitude: np.ndarray


class Line(NamedTuple):
    """The strongest line of a series in a band of frequencies.

    Attributes:
        frequency: in cycles per unit of time, (…).
        amplitude: in the unit of the series, (…).
    """

    frequency: np.ndarray
    amplitude: np.ndarray


def spectrum(t: ArrayLike, x: ArrayLike) -> Spectrum:
    """The amplitudes of a series at all frequencies that its duration resolves: Fourier's transform, Hann's window.

    A line a cos(2πft + φ), separated from others by two resolutions 1/duration, has a peak of height a, or down to
    0.85 a where f is between two of the frequencies. It interferes with its own image, of frequency −f, within a
    resolution of 0 and of the Nyquist frequency, the last one of an even number of times.

    Args:
        t: evenly spaced times, (times,).
        x: real, (times, …); its mean is subtracted. Where it has a NaN or an infinity, all amplitudes are NaN.

    Raises:
        ValueError: the times are not evenly spaced, or fewer than 4; not as many values.
    """
    spacing, windowed, weight = _windowed(t, x)
    if len(windowed) < _FEWEST:
        raise ValueError(f"a spectrum needs at least {_FEWEST} times, got {len(windowed)}")
    amplitude = 2 * abs(np.fft.rfft(windowed, axis=0)) / weight
    if len(windowed) % 2 == 0:
        amplitude[-1] /= 2  # at the Nyquist frequency a line and its image coincide
    return Spectrum(np.fft.rfftfreq(len(windowed), spacing), amplitude)


def line(t: ArrayLike, x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Line:
    """The frequency and the amplitude of the strongest line of a series between two frequencies.

    It is the highest value of the transform under Hann's window between them, refined between its two neighbors. Within
    a resolution of the Nyquist frequency it interferes with its own image, by a factor of up to 2 of the amplitude.

    Args:
        t: evenly spaced times, (times,).
        x: real, (times, …).
        low, high: in cycles per unit of time, scalars or (…).

    Returns:
        A `Line`; NaN where no frequency of the transform is between `low` and `high`, where x has a NaN or an infinity,
        and for fewer than 4 times. The frequency of an amplitude that is round-off of x is NaN.

    Raises:
        ValueError: the times are not evenly spaced; not as many values.
    """
    spacing, windowed, weight = _windowed(t, x)
    low, high = numbers("low", low), numbers("high", high)
    if len(windowed) < _FEWEST:
        nothing = np.full(windowed.shape[1:], np.nan)[()]
        return Line(nothing, nothing)
    frequencies = np.fft.rfftfreq(len(windowed), spacing)
    elapsed, column = (_column(a, windowed.ndim) for a in (spacing * np.arange(len(windowed)), frequencies))
    inside = (column > low) & (column < high)
    peak = np.argmax(np.where(inside, abs(np.fft.rfft(windowed, axis=0)), -1.0), axis=0)
    found, reach = frequencies[peak], frequencies[1] / 2

    def height(f: np.ndarray) -> np.ndarray:
        return abs(np.sum(windowed * np.exp(-2j * np.pi * elapsed * f), axis=0))

    for _ in range(_REFINEMENTS):
        left, middle, right = height(found - reach), height(found), height(found + reach)
        curvature = left - 2 * middle + right
        slope = np.where(curvature < 0, (left - right) / np.where(curvature < 0, 2 * curvature, 1), 0)
        found, reach = found + reach * np.clip(slope, -1, 1), reach / 4
    amplitude = 2 * height(found) / weight
    exists = np.any(inside, axis=0) & ~np.isnan(amplitude)
    varies = amplitude > ROUNDING * np.max(abs(series(t, x)[1]), axis=0)
    return Line(np.where(exists & varies, found, np.nan)[()], np.where(exists, amplitude, np.nan)[()])


def complex_rates(t: ArrayLike, z: ArrayLike, count: int = 2) -> np.ndarray:
    """The rates σ of a series Σ a_k exp(iσ_k t), (count,), complex, by Prony's method: Im σ < 0 grows.

    The fastest, by the real part, is first; of two of one speed the growing one.

    Args:
        t: evenly spaced times, (times,), so short a time from each other that |σ| Δt < π.
        z: real or complex, (times,), almost without noise, which the method amplifies.
        count: the number of terms, ≥ 1; a real oscillation has two.

    Returns:
        The rates in radians per unit of time; NaN for fewer than 4 × `count` times, and if z has a NaN or an infinity.
        Of a series of fewer terms the last rates are NaN, and of zeros all.

    Raises:
        ValueError: the times are not evenly spaced; not as many values; `count` is no integer ≥ 1.

    Source: Prony 1795; Marple 1987, Digital Spectral Analysis, § 11.3.

    Example:
        >>> t = np.linspace(0, 10, 100)
        >>> complex_rates(t, np.exp((0.1 + 2j) * t) + np.exp(-1j * t)).round(9).tolist()
        [(2-0.1j), (-1+0j)]
    """
    spacing, x = even_spacing(t), series(t, z, "z", "biufc")[1]
    count = _checks.count("count", count, 1)
    found = np.full(count, np.nan + 0j)
    if x.ndim != 1:
        raise ValueError(f"z must be (times,), got {x.shape}; call complex_rates for each series")
    if len(x) < 4 * count or not np.isfinite(x).all() or not x.any():
        return found
    x = x / 2.0 ** (np.frexp(abs(x).max())[1] - 1)  # of size 1, exactly
    coefficients, terms = _recurrence(x, count)
    if terms < count:
        coefficients, terms = _recurrence(x, terms)
    rates = -1j * np.log(np.roots([1, *-coefficients]).astype(complex)) / spacing
    size = np.abs(rates).max() or 1.0
    found[: len(rates)] = sorted(rates, key=lambda rate: (-round(rate.real / size, 6), rate.imag))
    return found


def _recurrence(z: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """The coefficients a of z_n = Σ a_k z_{n−k}, (count,), and how many of such terms are independent."""
    columns = np.stack([z[count - k : len(z) - k] for k in range(1, count + 1)], axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(columns, z[count:], rcond=None)
    return coefficients, int(rank)


def even_spacing(t: ArrayLike) -> float:
    """The signed spacing of evenly spaced times, up to the rounding of their type; ValueError if they are not."""
    given, t = t, series(t, t, "the times")[0]
    kind = np.asarray(given).dtype
    rounding = float(np.spacing(kind.type(np.max(abs(t))))) if kind.kind == "f" else 0.0
    spacing = (t[-1] - t[0]) / max(len(t) - 1, 1)
    if len(t) > 1 and not np.max(abs(np.diff(t) - spacing)) <= _EVEN * abs(spacing) + rounding:
        raise ValueError("the times must be evenly spaced: save every step or every n-th one, or use periodogram")
    if len(t) > 1 and not spacing:
        raise ValueError(f"the times must differ, got {len(t)} times {t[0]:g}")
    return float(spacing)


def _windowed(t: ArrayLike, x: ArrayLike) -> tuple[float, np.ndarray, float]:
    """The spacing of the times, the series less its mean under the window, and the sum of the window."""
    spacing, x = abs(even_spacing(t)), _finite_or_nan(series(t, x)[1])
    window = np.hanning(len(x))
    return spacing, _column(window, x.ndim) * (x - x.mean(axis=0)), float(window.sum())


def _finite_or_nan(x: np.ndarray) -> np.ndarray:
    """The series x (times, …), NaN at all times where it is not finite at some."""
    return np.where(np.isfinite(x).all(axis=0), x, np.nan)


def _column(a: np.ndarray, ndim: int) -> np.ndarray:
    """An array (n,) with further axes of length 1, `ndim` in all."""
    return a.reshape(-1, *[1] * (ndim - 1))


class Periodogram(NamedTuple):
    """The least-squares spectrum of a series.

    Attributes:
        frequency: in cycles per unit of time, (frequencies,).
        power: the share of the variance, weighted by the errors, that a sine of this frequency explains, from 0 to 1,
            (frequencies, …).
        false_alarm_probability: the probability that white noise of any variance has such a power, or a greater one,
            at some frequency of the band, (frequencies, …): an upper bound, which is close where it is small.
    """

    frequency: np.ndarray
    power: np.ndarray
    false_alarm_probability: np.ndarray


def periodogram(
    t: ArrayLike, x: ArrayLike, errors: ArrayLike | None = None, frequencies: ArrayLike | None = None
) -> Periodogram:
    """The generalized Lomb–Scargle periodogram: which periods an unevenly sampled series has, and if by chance.

    At each frequency a sine and a constant are fitted (a floating mean). An asteroid's light has two maxima in a
    rotation, and so a peak at twice the frequency of rotation.

    Args:
        t: times, (times,), in any order.
        x: (times, …).
        errors: standard deviations of x, of which only the ratios matter, (times,); by default equal.
        frequencies: > 0, (frequencies,); by default in steps of 1/(10 T) from 1/T, with T the duration, to the mean
            Nyquist frequency of n times, (n − 1)/2T.

    Returns:
        A `Periodogram`; NaN where x is constant up to round-off, or not finite.

    Raises:
        ValueError: fewer than 5 times, or all equal, not as many values; times or errors that are not finite, errors or
            frequencies that are not positive.

    Source: Zechmeister & Kürster 2009, Astron. Astrophys. 496, 577; the probability: Baluev 2008, Mon. Not. R. Astron.
    Soc. 385, 1279, (6) and Table 1, for z₁ and a constant as the model without a signal.
    """
    t, x = numbers("the times", t), numbers("x", x)
    n = t.size
    sigma = np.ones(n) if errors is None else numbers("errors", errors)
    if (
        n < 5
        or t.ndim != 1
        or x.shape[:1] != (n,)
        or sigma.shape != (n,)
        or not (np.isfinite([t, sigma]).all() and (sigma > 0).all())
    ):
        raise ValueError(
            "t (times,) must hold at least 5 finite times, x be (times, …), and errors positive and finite, (times,); "
            f"got shapes {t.shape}, {x.shape}, {sigma.shape}"
        )
    duration = np.ptp(t)
    if not duration > 0:
        raise ValueError(f"the times must differ, got {n} times {t[0]:g}")
    default = np.arange(_OVERSAMPLING, (n - 1) / 2 * _OVERSAMPLING) / (_OVERSAMPLING * duration)
    f = default if frequencies is None else numbers("frequencies", frequencies)
    if f.ndim != 1 or not len(f) or not (f > 0).all() or not np.isfinite(f).all():
        raise ValueError(f"frequencies must be finite and positive, (frequencies,), got {f}; {duration = :g}")
    w = (sigma.min() / sigma) ** 2
    w = w / w.sum()
    centered, columns = t - w @ t, _finite_or_nan(x).reshape(n, math.prod(x.shape[1:]))
    columns = np.ldexp(columns, -np.frexp(np.max(abs(columns), axis=0))[1])  # of size 1: their squares are in range
    y = columns - w @ columns
    parts = np.array_split(f, -(-f.size * n // _AT_ONCE))
    explained = np.concatenate([_explained(part, centered, w, y) for part in parts])
    variance = w @ (y * y)
    constant = variance <= (ROUNDING * np.max(abs(columns), axis=0)) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        power = np.clip(explained / np.where(constant, np.nan, variance), 0, 1).reshape(len(f), *x.shape[1:])
        width = np.ptp(f) * duration * math.sqrt(4 * math.pi * (w @ (centered / duration) ** 2))
        return Periodogram(f, power, _false_alarm_probability(power, n, width))


def _explained(f: np.ndarray, t: np.ndarray, w: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The weighted mean square of y (times, m) that a sine and a constant explain, (frequencies, m).

    Of the two waves in phase and in quadrature that are orthogonal under the weights, one may vanish at all times.
    """
    phase = 2 * np.pi * f[:, None] * t
    c, s = np.cos(phase), np.sin(phase)
    yc, ys = c @ (w[:, None] * y), s @ (w[:, None] * y)
    C, S = c @ w, s @ w
    cc, ss, cs = (c * c) @ w - C * C, (s * s) @ w - S * S, (c * s) @ w - C * S
    turn = np.arctan2(2 * cs, cc - ss)[:, None] / 2
    middle, half = (cc + ss)[:, None] / 2, np.hypot(cc - ss, 2 * cs)[:, None] / 2
    waves = (yc * np.cos(turn) + ys * np.sin(turn), ys * np.cos(turn) - yc * np.sin(turn))
    pairs = zip(waves, (middle + half, middle - half), strict=True)
    first, second = (np.where(square > _SINGULAR, b * b / np.maximum(square, _SINGULAR), 0) for b, square in pairs)
    return first + second


def _false_alarm_probability(power: np.ndarray, n: int, width: float) -> np.ndarray:
    """Baluev's bound, for the width of the band times the effective duration, W = (f₂ − f₁)√(4π var t)."""
    gamma = math.sqrt(2 / (n - 1)) * math.exp(math.lgamma((n - 1) / 2) - math.lgamma((n - 2) / 2))
    rest = 1 - power
    crossings = gamma * width * rest ** ((n - 4) / 2) * np.sqrt((n - 1) * power / 2)
    return -np.expm1(np.log1p(-(rest ** ((n - 3) / 2))) - crossings)
