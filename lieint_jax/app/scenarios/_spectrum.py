"""Frequencies and amplitudes of the lines of a real series, from its Fourier transform under a Hann window."""

from __future__ import annotations

import numpy as np

_REFINEMENTS = 6  # of a frequency, each by the parabola through three values of the transform


def spectrum(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles per unit of t) and amplitudes of a series x (n,) at evenly spaced times t (n,).

    A line a cos(2πft + φ) away from others has a peak of height a, or down to 0.85 a between two frequencies.
    """
    window = np.hanning(len(t))
    transform = np.fft.rfft(window * (x - x.mean()))
    return np.fft.rfftfreq(len(t), t[1] - t[0]), 2 * abs(transform) / window.sum()


def line(t: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The frequency and the amplitude of the strongest line between two frequencies, for every column of x (n, m).

    It is the highest of the transform's values between `low` and `high`, (m,), refined between its two
    neighbors. nan for columns without a frequency of the transform between them.
    """
    window = np.hanning(len(t))
    windowed = window[:, None] * (x - x.mean(axis=0))
    frequencies = np.fft.rfftfreq(len(t), t[1] - t[0])
    inside = (frequencies[:, None] > low) & (frequencies[:, None] < high)
    peak = np.argmax(np.where(inside, abs(np.fft.rfft(windowed, axis=0)), -1.0), axis=0)
    found, reach = frequencies[peak], frequencies[1] / 2

    def height(f: np.ndarray) -> np.ndarray:
        return abs(np.sum(windowed * np.exp(-2j * np.pi * t[:, None] * f), axis=0))

    for _ in range(_REFINEMENTS):
        left, middle, right = height(found - reach), height(found), height(found + reach)
        curvature = left - 2 * middle + right
        slope = np.where(curvature < 0, (left - right) / np.where(curvature < 0, 2 * curvature, 1), 0)
        found, reach = found + reach * np.clip(slope, -1, 1), reach / 4
    exists = inside.any(axis=0)
    return np.where(exists, found, np.nan), np.where(exists, 2 * height(found) / window.sum(), np.nan)
