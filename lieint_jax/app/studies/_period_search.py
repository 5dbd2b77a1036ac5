"""Periods of unevenly sampled data: the least-squares spectrum, and the Fourier series in two frequencies.

A torque-free tumbler has two frequencies, those of precession and of rotation. Its light has all combinations
j f₁ + k f₂, and does not determine which of the many pairs that generate the same combinations these two are. Source:
Pravec et al. 2005, Icarus 173, 108; the spectrum is that of `li.measure.periodogram`.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from lieint_jax.measure import periodogram

BAND = (0.01, 0.16)  # 1/min, the range of the pairs of frequencies that are searched
SPECTRUM = (0.005, 0.35)  # 1/min, the range of the spectrum
ORDER = 2  # of the series in two frequencies
SEPARATION = 0.004  # 1/min; pairs of frequencies that are closer are one peak
HARMONICS = 6  # largest |j| and |k| of the combinations by which a sine is identified
_FINE, _COARSE = 6, 4  # grid points per resolution (1/duration), of the spectrum and of the pairs
_SHOWN, _NUMBERS = 10, 2  # number of peaks and pairs in the result; largest coefficients of another basis
_RIDGE = 1e-6  # relative, added to the diagonal: some combinations of two frequencies may coincide
_AT_ONCE = 2000  # pairs of frequencies whose series are fitted together


def combinations(order: int) -> np.ndarray:
    """All (j, k) with |j|, |k| ≤ order, ((2 order + 1)², 2)."""
    return np.array(list(itertools.product(range(-order, order + 1), repeat=2)))


class TwoPeriods(NamedTuple):
    """Fourier series in pairs of frequencies, fitted to data."""

    pairs: np.ndarray  # the pairs of frequencies f₁ < f₂, (pairs, 2)
    left: np.ndarray  # the share of the variance that each series does not explain, (pairs,)

    def select_best(self, count: int, separation: float) -> TwoPeriods:
        """The best pairs, of which none is within `separation` of a better one in both frequencies."""
        chosen: list[int] = []
        for k in np.argsort(self.left):
            if all(np.abs(self.pairs[k] - self.pairs[other]).max() > separation for other in chosen):
                chosen.append(int(k))
            if len(chosen) == count:
                break
        return TwoPeriods(self.pairs[chosen], self.left[chosen])


def fit_two_periods(t: np.ndarray, y: np.ndarray, step: float, numbers: np.ndarray, order: int) -> TwoPeriods:
    """Fit Fourier series of `order` in pairs of frequencies, Σ c_jk exp 2πi(j f₁ + k f₂)t with |j|, |k| ≤ order.

    The pairs, (pairs, 2), are given as multiples of `step`: so are all combinations, and one table of waves is enough.
    """
    jk = combinations(order)
    reach = int(2 * order * np.abs(numbers).sum(axis=1).max())
    wave = np.exp(2j * np.pi * step * t)
    powers = np.cumprod(np.broadcast_to(wave, (reach, len(t))), axis=0)
    y = y - y.mean()
    window, data = (np.concatenate([[w.sum()], powers @ w]) for w in (np.ones(len(t)), y))
    between = jk[None, :, :] - jk[:, None, :]  # the combination in the product of e*_a and e_b

    def coefficient(table: np.ndarray, k: np.ndarray) -> np.ndarray:
        return np.where(k < 0, table[np.abs(k)].conj(), table[np.abs(k)])

    def unexplained_share(pair: np.ndarray) -> np.ndarray:
        gram = coefficient(window, np.einsum("abc,pc->pab", between, pair))
        gram = gram + _RIDGE * len(t) * np.eye(len(jk))
        b = coefficient(data, -pair @ jk.T)
        return 1 - np.einsum("pa,pa->p", b.conj(), np.linalg.solve(gram, b[..., None])[..., 0]).real / (y @ y)

    parts = np.array_split(numbers, -(-len(numbers) // _AT_ONCE))
    return TwoPeriods(step * numbers, np.concatenate([unexplained_share(part) for part in parts]))


class Peak(NamedTuple):
    """A sine in the data, found after the removal of stronger ones."""

    frequency: float  # its frequency
    share: float  # the increase of the explained share of the variance by this sine


def peaks(t: np.ndarray, y: np.ndarray, frequencies: np.ndarray, count: int) -> list[Peak]:
    """The strongest sines, one after the other: each is fitted with all before it and subtracted (prewhitening)."""
    found: list[Peak] = []
    rest, left = y, 1.0
    for _ in range(count):
        f = float(frequencies[int(np.argmax(periodogram(t, rest, frequencies=frequencies).power))])
        phase = 2 * np.pi * t[:, None] * np.array([*(p.frequency for p in found), f])
        A = np.concatenate([np.ones((len(t), 1)), np.cos(phase), np.sin(phase)], axis=1)
        rest = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
        now = float(rest.var() / y.var())
        found.append(Peak(f, left - now))
        left = now
    return found


def find_combination(frequency: float, pair: np.ndarray, order: int, width: float) -> tuple[int, int, float]:
    """Identify a frequency with a combination j f₁ + k f₂, |j|, |k| ≤ order: j, k and the difference.

    The combination is the simplest of those within `width` of the frequency, or the nearest one if there is none.
    """
    jk = combinations(order)
    off, size = np.abs(jk @ pair - frequency), np.abs(jk).sum(axis=1)
    best = int(np.lexsort((off, np.where(off < width, size, size.max() + off / width)))[0])
    return int(jk[best, 0]), int(jk[best, 1]), float(frequency - jk[best] @ pair)


def coincidence(frequencies: np.ndarray, band: tuple[float, float], width: float) -> float:
    """The share of a band within `width` of one of these frequencies: the probability of a match by chance."""
    low, high = ((np.sort(frequencies) + side).clip(*band) for side in (-width, width))
    covered = np.append(band[0], high[:-1])  # the upper end of the part covered by lower frequencies
    return float((high - np.maximum(low, covered)).sum() / (band[1] - band[0]))


def bases(pair: np.ndarray, most: int, band: tuple[float, float]) -> np.ndarray:
    """All pairs of frequencies inside the band that generate the same combinations as a pair, (bases, 2).

    They are |a f₁ + b f₂| and |c f₁ + d f₂| with |ad − bc| = 1 and coefficients of at most `most`.
    """
    found = []
    for a, b, c, d in itertools.product(range(-most, most + 1), repeat=4):
        f, g = a * pair[0] + b * pair[1], c * pair[0] + d * pair[1]
        if abs(a * d - b * c) == 1 and band[0] < f < band[1] and band[0] < g < band[1]:
            found.append((f, g))
    return np.unique(np.round(found, 12), axis=0)


class Search(NamedTuple):
    """The search for the periods of a light curve."""

    frequencies: np.ndarray  # the frequencies of the spectrum, 1/min, (k,)
    power: np.ndarray  # the share of the variance that each frequency explains alone, (k,)
    peaks: list[Peak]  # the strongest sines, one after the other
    pairs: TwoPeriods  # the best pairs of frequencies, best first
    lines: np.ndarray  # pairs of frequencies that generate the same combinations as the best pair, (c, 2)

    @property
    def candidates(self) -> np.ndarray:
        """Candidates for the frequencies of (precession, rotation), 1/min, (c, 2).

        If half a rotation about each axis maps the facets onto equal ones, the light shows the rotation twice as fast.
        """
        return self.lines / np.array([1.0, 2.0])


def search(t: np.ndarray, y: np.ndarray) -> Search:
    """The spectrum of magnitudes y at times t (min), its peaks, and pairs of frequencies."""
    duration = float(t[-1] - t[0])
    frequencies = np.arange(*SPECTRUM, 1 / (_FINE * duration))
    step = 1 / (_COARSE * duration)
    numbers = np.arange(int(BAND[0] / step) + 1, int(BAND[1] / step))
    f, g = np.meshgrid(numbers, numbers, indexing="ij")
    separate = g - f > SEPARATION / step
    fits = fit_two_periods(t, y, step, np.stack([f[separate], g[separate]], axis=1), ORDER)
    best, power = fits.select_best(_SHOWN, SEPARATION), periodogram(t, y, frequencies=frequencies).power
    return Search(frequencies, power, peaks(t, y, frequencies, _SHOWN), best, bases(best.pairs[0], _NUMBERS, BAND))
