"""Least squares by `scipy.optimize.least_squares`, for one start."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.fitting._box import Box
from lieint_jax.fitting._search import FLAT, RUNNING, SETTLED, STILL

_CLOSE = 1e-3  # cosine of residuals and derivatives, and relative step of Gauss–Newton, of a point near a minimum
_CODES = {0: RUNNING, 1: FLAT, 2: STILL, 3: SETTLED, 4: STILL}  # by scipy's status


class Look(NamedTuple):
    """Residuals r and their Jacobian J at a point, and whether the trial converged."""

    r: np.ndarray
    J: np.ndarray
    ok: bool


class Found(NamedTuple):
    """The end of a search: the point, why it stopped, the least losses up to each trial, and the trials that failed."""

    x: np.ndarray
    code: int
    history: np.ndarray
    failed: list[np.ndarray]


def is_stuck(found: Found, look: Look, newton: float, box: Box) -> bool:
    """Whether the last steps of a search were short because trials next to its end fail, far from a minimum in the box.

    Args:
        found: the search.
        look: residuals and Jacobian at its end.
        newton: the length of the step of Gauss–Newton in the box, in units of the norms of the columns of J.
        box: the bounds.
    """
    slope, size, length = look.J.T @ look.r, np.linalg.norm(look.J, axis=0), np.linalg.norm(look.r)
    near = _CLOSE * np.linalg.norm(size * found.x)
    if not any(np.linalg.norm(size * (x - found.x)) <= near for x in found.failed):
        return False
    room = np.where(slope > 0, found.x - box.low, box.high - found.x)
    cosines = np.abs(slope) / np.where(size * length > 0, size * length, 1)
    cosine = np.max(cosines * np.minimum(1, room * size / (length or 1)))
    return bool(cosine > _CLOSE and newton > near)


def least_squares(look: Callable[[np.ndarray], Look], x: np.ndarray, box: Box, tolerance: float, trials: int) -> Found:
    """Minimize |r(x)|²/2 inside a box by scipy's trust region; a trial that fails shortens the next step.

    Scipy compares gradients with a number, and steps with the length of all coordinates: so it is given coordinates in
    units of their derivatives at the first guess, and residuals that are not small there, all by powers of 2.

    Args:
        look: evaluates a point.
        x: the first guess, which does not fail.
        box: the bounds.
        tolerance: scipy's `ftol`, `xtol` and `gtol`, where they are not below the round-off.
        trials: the most trials, the first guess included; at least that one is made.
    """
    try:
        from scipy.optimize import least_squares as by_scipy
    except ImportError as error:
        raise ImportError('optimizer="scipy" needs scipy: python -m pip install scipy') from error
    losses, failed = [], []

    @functools.lru_cache(2)  # scipy asks for the Jacobian where it has asked for the residuals
    def seen_at(numbers: bytes) -> Look:
        return look(np.frombuffer(numbers))

    first = seen_at(x.astype(float).tobytes())
    enlarged = 1 / min(1.0, _power(first.r))
    unit = 1 / _power(enlarged * first.J)  # of each coordinate

    def residuals(z: np.ndarray) -> np.ndarray:
        x = unit * z
        seen = seen_at(x.tobytes())
        losses.append(float(seen.r @ seen.r) / 2 if seen.ok else np.nan)
        failed.extend([] if seen.ok else [x])
        return enlarged * seen.r if seen.ok else np.full(seen.r.shape, np.nan)

    def jacobian(z: np.ndarray) -> np.ndarray:
        return enlarged * seen_at((unit * z).tobytes()).J * unit

    least = max(tolerance, 2 * np.finfo(x.dtype).eps)
    sides = [np.broadcast_to(np.asarray(side, float) / unit, x.shape) for side in box]
    find: Any = by_scipy  # whose types take the name of a rule for the Jacobian only
    found = find(
        residuals, x / unit, jacobian, sides, ftol=least, xtol=least, gtol=least, x_scale="jac", max_nfev=max(trials, 1)
    )
    end = (unit * found.x).astype(x.dtype)
    return Found(end, _CODES[found.status], np.fmin.accumulate(losses), failed)


def _power(numbers: np.ndarray) -> np.ndarray:
    """The power of 2 above the largest of some numbers, or above that of each column; 1 if they are 0."""
    return np.ldexp(1.0, np.clip(np.frexp(np.max(np.abs(numbers), axis=0))[1], -1000, 1000))
