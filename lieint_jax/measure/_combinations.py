"""The frequencies of a tumbler's light: sines one after the other, and the two frequencies that generate them."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.measure._series import series
from lieint_jax.measure._spectrum import ROUNDING, periodogram

__all__ = [
    "Combination",
    "DoublePeriods",
    "Sine",
    "chance_of_match",
    "combination",
    "combinations",
    "double_periods",
    "equivalent_pairs",
    "sines",
]

_PER_RESOLUTION = 4  # default frequencies of a pair per resolution, 1/duration
_RIDGE = 1e-6  # relative, added to the diagonal: some combinations of two frequencies may coincide
_MOST = 5000  # frequencies of a band, whose pairs are tried
_AT_ONCE = 2000  # pairs of frequencies whose series are fitted together


class Sine(NamedTuple):
    """A sine in a series.

    Attributes:
        frequency: in cycles per unit of time.
        share: the increase of the explained share of the variance by this sine.
    """

    frequency: float
    share: float


class DoublePeriods(NamedTuple):
    """Fourier series in two frequencies that fit a series.

    Attributes:
        pairs: the two frequencies f₁ < f₂ of each, the best first, in cycles per unit of time, (pairs, 2).
        unexplained: the share of the variance that each series does not explain, (pairs,).
    """

    pairs: np.ndarray
    unexplained: np.ndarray


class Combination(NamedTuple):
    """The combination j f₁ + k f₂ that a frequency is.

    Attributes:
        j, k: its integers.
        difference: the frequency less the combination.
    """

    j: int
    k: int
    difference: float


def sines(t: ArrayLike, x: ArrayLike, frequencies: ArrayLike, count: int) -> list[Sine]:
    """The strongest sines of a series, one after the other: each is fitted with all before it, and subtracted.

    Args:
        t: times, (times,), in any order.
        x: the series, (times,).
        frequencies: those that are tried, > 0, (frequencies,), some per resolution 1/duration.
        count: the largest number of sines, ≥ 1.

    Returns:
        Fewer than `count` where they leave nothing but round-off, or no more data than unknowns; none of a constant.

    Raises:
        ValueError: times or values that are not finite, or not as many of both; frequencies that are not positive; a
            `count` that is no integer ≥ 1.

    Example:
        >>> t = np.sort(np.random.default_rng(0).uniform(0, 100, 200))
        >>> found = sines(t, 2 * np.cos(3 * t) + np.sin(t), np.arange(0.02, 1, 1e-3), 2)
        >>> [(round(2 * np.pi * sine.frequency, 2), round(sine.share, 1)) for sine in found]
        [(3.0, 0.8), (1.0, 0.2)]

    Source: prewhitening, as in Lenz & Breger 2005, Commun. Asteroseismol. 146, 53.
    """
    t, y = _finite_series(t, x)
    found: list[Sine] = []
    rest, unexplained, least = y, 1.0, ROUNDING * np.max(abs(y))
    for _ in range(_checks.count("count", count, 1)):
        if rest.std() <= least or 2 * len(found) + 3 > len(t):
            break
        spectrum = periodogram(t, rest, frequencies=frequencies)
        f = float(spectrum.frequency[np.argmax(spectrum.power)])
        phase = 2 * np.pi * t[:, None] * np.array([*(sine.frequency for sine in found), f])
        A = np.concatenate([np.ones((len(t), 1)), np.cos(phase), np.sin(phase)], axis=1)
        rest = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
        now = float(rest.var() / y.var())
        if not unexplained - now > ROUNDING:
            break
        found.append(Sine(f, unexplained - now))
        unexplained = now
    return found


def double_periods(
    t: ArrayLike,
    x: ArrayLike,
    low: float,
    high: float,
    *,
    separation: float,
    order: int = 2,
    count: int = 10,
    step: float | None = None,
) -> DoublePeriods:
    """The pairs of frequencies whose Fourier series Σ c_jk exp 2πi(j f₁ + k f₂)t, |j|, |k| ≤ order, fits best.

    A torque-free tumbler has two frequencies, those of precession and of rotation, and its light has all combinations
    of them. It does not show which of the pairs that generate the same combinations these two are: see
    `equivalent_pairs`. If half a rotation about each axis of the body leaves its light unchanged, the light shows the
    rotation twice as fast.

    Args:
        t: times, (times,), in any order.
        x: the series, (times,); its mean is subtracted.
        low, high: the band in which both frequencies are searched.
        separation: the least f₂ − f₁, and the distance from a better pair within which another is part of its peak.
        order: of the series.
        count: the largest number of pairs in the result.
        step: of the frequencies that are tried; by default a quarter of the resolution 1/duration.

    Raises:
        ValueError: the band has no two frequencies that differ by more than `separation`, or too many; it is not
            positive; times or values that are not finite, or not as many of both; a constant; no more times than the
            series has coefficients, (2 order + 1)²; `order` or `count` is no integer ≥ 1.

    Source: Pravec et al. 2005, Icarus 173, 108.
    """
    _checks.all_plain(low=low, high=high, separation=separation, step=step)
    t, y = _finite_series(t, x)
    order, count = _checks.count("order", order, 1), _checks.count("count", count, 1)
    unknown = (2 * order + 1) ** 2
    if len(t) <= unknown or not np.ptp(t) > 0 or not (y - y.mean()).std() > ROUNDING * np.max(abs(y)):
        raise ValueError(
            f"a series of order {order} in two frequencies needs more than its {unknown} coefficients of different "
            f"times, and values that are not constant, got {len(t)} times from {t.min():g} to {t.max():g}, and values "
            f"from {y.min():g} to {y.max():g}"
        )
    step = float(1 / (_PER_RESOLUTION * np.ptp(t))) if step is None else step
    if not (0 <= low < high < np.inf and separation >= 0 and 0 < step < np.inf):
        raise ValueError(
            f"0 ≤ low < high, separation ≥ 0 and step > 0 are needed, got {low}, {high}, {separation}, {step}"
        )
    if (high - low) / step > _MOST:
        raise ValueError(
            f"from {low:g} to {high:g} there are {(high - low) / step:.3g} frequencies in steps of {step:g}, more than "
            f"{_MOST}: give a narrower band, or a larger step"
        )
    numbers = np.arange(int(low / step) + 1, int(high / step))
    f, g = np.meshgrid(numbers, numbers, indexing="ij")
    separate = g - f > separation / step
    if not separate.any():
        raise ValueError(f"no two frequencies from {low:g} to {high:g}, in steps of {step:g}, differ by {separation:g}")
    multiples = np.stack([f[separate], g[separate]], axis=1)
    pairs, unexplained = step * multiples, _unexplained_shares(t, y - y.mean(), step, multiples, order)
    chosen: list[int] = []
    for k in np.argsort(unexplained):
        if all(abs(pairs[k] - pairs[other]).max() > separation for other in chosen):
            chosen.append(int(k))
        if len(chosen) == count:
            break
    return DoublePeriods(pairs[chosen], unexplained[chosen])


def _finite_series(t: ArrayLike, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Times and values, (times,), checked."""
    t, y = series(t, x)
    if y.ndim != 1 or not np.isfinite(y).all():
        raise ValueError(
            f"x must be finite, (times,), got shape {y.shape}, {np.sum(~np.isfinite(y))} values not finite"
        )
    return t, np.ldexp(y, -np.frexp(np.max(abs(y)))[1])  # of size 1: its square is in range


def _unexplained_shares(t: np.ndarray, y: np.ndarray, step: float, multiples: np.ndarray, order: int) -> np.ndarray:
    """The share of the variance of y that the series of each pair does not explain, (pairs,).

    The pairs are multiples (pairs, 2) of `step`: so are all combinations, and one table of waves is enough.
    """
    jk = combinations(order)
    reach = int(2 * order * abs(multiples).sum(axis=1).max())
    powers = np.cumprod(np.broadcast_to(np.exp(2j * np.pi * step * t), (reach, len(t))), axis=0)
    window, data = (np.concatenate([[w.sum()], powers @ w]) for w in (np.ones(len(t)), y))
    between = jk[None, :, :] - jk[:, None, :]  # the combination in the product of e*_a and e_b

    def coefficient(table: np.ndarray, k: np.ndarray) -> np.ndarray:
        return np.where(k < 0, table[np.abs(k)].conj(), table[np.abs(k)])

    def shares(pairs: np.ndarray) -> np.ndarray:
        gram = coefficient(window, np.einsum("abc,pc->pab", between, pairs)) + _RIDGE * len(t) * np.eye(len(jk))
        b = coefficient(data, -pairs @ jk.T)
        return 1 - np.einsum("pa,pa->p", b.conj(), np.linalg.solve(gram, b[..., None])[..., 0]).real / (y @ y)

    return np.concatenate([shares(part) for part in np.array_split(multiples, -(-len(multiples) // _AT_ONCE))])


def combinations(order: int) -> np.ndarray:
    """All pairs of integers (j, k) with |j|, |k| ≤ order, ((2 order + 1)², 2).

    Example:
        >>> combinations(1).tolist()
        [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 0], [0, 1], [1, -1], [1, 0], [1, 1]]
    """
    return np.array(list(itertools.product(range(-order, order + 1), repeat=2)))


def combination(frequency: float, pair: ArrayLike, order: int, width: float) -> Combination:
    """The simplest combination j f₁ + k f₂, |j|, |k| ≤ order, within `width` of a frequency, or else the nearest.

    Example:
        >>> j, k, difference = combination(0.1384, [0.0613, 0.0771], order=6, width=0.002)
        >>> j, k, round(difference, 9)
        (1, 1, 0.0)
    """
    _checks.all_plain(frequency=frequency, width=width)
    jk = combinations(order)
    f = jk @ _checks.host_array("pair", pair)
    off, size = abs(f - frequency), abs(jk).sum(axis=1)
    best = int(np.lexsort((off, np.where(off < width, size, size.max() + off / width)))[0])
    return Combination(int(jk[best, 0]), int(jk[best, 1]), float(frequency - f[best]))


def chance_of_match(frequencies: ArrayLike, low: float, high: float, width: float) -> float:
    """The share of a band within `width` of one of these frequencies: the probability of a match by chance.

    Example:
        >>> round(chance_of_match([0.1, 0.11, 0.3], 0.0, 0.5, 0.01), 9)
        0.1
    """
    _checks.all_plain(low=low, high=high, width=width)
    lines = np.sort(np.ravel(_checks.host_array("frequencies", frequencies)))
    below, above = ((lines + side).clip(low, high) for side in (-width, width))
    covered = np.append(low, above[:-1])  # the upper end of the part covered by lower frequencies
    return float((above - np.maximum(below, covered)).sum() / (high - low))


def equivalent_pairs(pair: ArrayLike, low: float, high: float, most: int = 2) -> np.ndarray:
    """All pairs of frequencies in a band that generate the same combinations as a pair, (pairs, 2).

    They are |a f₁ + b f₂| and |c f₁ + d f₂| with |ad − bc| = 1 and coefficients of at most `most`.

    Example:
        >>> equivalent_pairs([0.05, 0.08], 0.04, 0.09, most=1).tolist()
        [[0.05, 0.08], [0.08, 0.05]]
    """
    _checks.all_plain(low=low, high=high)
    f, g = _checks.host_array("pair", pair)
    integers = np.array(list(itertools.product(range(-most, most + 1), repeat=4)))
    a, b, c, d = integers.T
    found = np.stack([a * f + b * g, c * f + d * g], axis=1)[abs(a * d - b * c) == 1]
    found = found[((found > low) & (found < high)).all(axis=1)]
    _, first = np.unique(np.round(found / max(f, g), 12), axis=0, return_index=True)
    return found[first]
