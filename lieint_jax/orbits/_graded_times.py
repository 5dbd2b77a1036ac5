"""Times of steps that are short where a body is close to the center of attraction."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls
from lieint_jax.core import callable_pytree
from lieint_jax.orbits._kepler import kepler

__all__ = ["graded_times"]

_GRADINGS, _PARTS = 4, 16  # passes of `graded_times`, and parts of a step in its sums


def graded_times(
    orbit: Callable[[Array], tuple[Array, Array]], t0: float, t1: float, n: int, *, c: float = 0.15
) -> np.ndarray:
    """Step boundaries for `integrate(…, times=…)` on an orbit: n steps, shorter where the body is closer to the center.

    Steps are proportional to 1/(r₀/r + c), where r₀ is the least distance between t0 and t1. Far away c bounds them;
    near the center they are about c/(1 + c) of this bound. The times depend on the orbit only and are the same for all
    members of an ensemble, so a symplectic step remains symplectic.

    Args:
        orbit: t ↦ (position, velocity), such as `kepler(...)`.
        t0, t1: first and last time, in either order.
        n: the number of steps.
        c: > 0; 0.15 suits tumbling bodies in flybys. With c → 0 steps far away become too long for the rotation.

    Returns:
        (n+1,) times from t0 to t1.

    Raises:
        ValueError: t0 = t1, a time is not finite, n < 1, or c ≤ 0.
    """
    _checks.all_plain(t0=t0, t1=t1, c=c)
    n, t0, t1, c = _checks.count("n", n, 1), float(t0), float(t1), float(c)
    if not (math.isfinite(t0) and math.isfinite(t1) and t0 != t1):
        raise ValueError(f"t0 and t1 must be finite and differ, got {t0} and {t1}")
    if not (0 < c < math.inf):
        raise ValueError(f"c must be positive and finite, got {c}")
    # The orbit is an argument: a jitted function that closes over its arrays was called without them by JAX 0.10.
    whole, position = callable_pytree(orbit), jax.jit(jax.vmap(lambda orbit, t: orbit(t)[0], (None, 0)))
    times = np.linspace(t0, t1, n + 1)
    for _ in range(_GRADINGS):  # each on a grid graded by the one before
        fine = np.interp(np.arange(_PARTS * n + 1) / _PARTS, np.arange(n + 1), times)
        r = np.linalg.norm(np.asarray(position(whole, jnp.asarray(fine)), float), axis=1)
        rate = r.min() / r + c
        s = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) * np.diff(fine))])
        times = np.interp(np.linspace(0, 1, n + 1), s / s[-1], fine)
    return times


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"graded_times": partial(graded_times, orbit=kepler(1.3, 1.2, 0.1), t0=0.1, t1=0.9, n=4, c=0.15)}
