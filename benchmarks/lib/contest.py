"""Contestants, and their timing.

Contestants are timed in turn, round after round, so that a slow spell of the machine affects all alike. The first call,
which traces and compiles, is reported separately.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np


class Contestant(NamedTuple):
    """An integrator that advances many rigid bodies by many steps.

    Attributes:
        name: for the tables.
        dtype: the dtype of its states, "float64" or "float32".
        pace: a rough guess of its body-steps a second, which sets the length of its runs.
        load: quaternions (B, 4) and spatial momenta (B, 3) ↦ states in its own form.
        advance: (states, number of steps) ↦ states; returns when the work is done, and does not change its argument.
        read: states ↦ quaternions and spatial momenta.
        info: states ↦ the largest residual so far and whether all converged; None if it solves no equation.
    """

    name: str
    dtype: str
    pace: float
    load: Callable[[np.ndarray, np.ndarray], Any]
    advance: Callable[[Any, int], Any]
    read: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    info: Callable[[Any], tuple[float, bool]] | None = None


class Timing(NamedTuple):
    """Seconds of the first call and of each later one; every call takes `body_steps` body-steps."""

    first: float
    later: tuple[float, ...]
    body_steps: int

    @property
    def rate(self) -> float:
        """Body-steps a second of the best call."""
        return self.body_steps / min(self.later)

    @property
    def median_rate(self) -> float:
        """Body-steps a second of the median call."""
        return self.body_steps / median(self.later)

    @property
    def compile_seconds(self) -> float:
        """Seconds of tracing and compiling: the time of the first call less that of the best one."""
        return max(self.first - min(self.later), 0.0)


def race(
    contestants: Sequence[Contestant], q: np.ndarray, p: np.ndarray, steps: Sequence[int], rounds: int
) -> list[Timing]:
    """Time every contestant from the same states, `steps[k]` steps a call, in turn, `rounds` times after a warm-up."""
    loaded = [c.load(q, p) for c in contestants]
    times: list[list[float]] = [[] for _ in contestants]
    for _ in range(rounds + 1):
        for c, states, n, seconds in zip(contestants, loaded, steps, times, strict=True):
            start = time.perf_counter()
            c.advance(states, n)
            seconds.append(time.perf_counter() - start)
    return [Timing(t[0], tuple(t[1:]), n * len(q)) for t, n in zip(times, steps, strict=True)]


def steps_lasting(seconds: float, contestant: Contestant, bodies: int) -> int:
    """The number of steps of `bodies` bodies that take about `seconds`, at most a million."""
    return int(np.clip(seconds * contestant.pace / bodies, 10, 1_000_000))
