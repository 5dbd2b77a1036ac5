"""Tables of functions of time: the interval of a table that holds a time."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete


def increasing_times(times: Any) -> Array:
    """The times of a table, (n,) with n ≥ 2; ValueError unless they are finite and increase."""
    t = _checks.real_array("times", times)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(f"times must have shape (n,) with n ≥ 2, got {t.shape}")
    if concrete(t) and not (np.diff(np.asarray(t)) > 0).all():
        k = int(np.argmin(np.diff(np.asarray(t)) > 0))
        raise ValueError(f"times must increase, got {float(t[k])} before {float(t[k + 1])}, entries {k} and {k + 1}")
    return t


def interval(times: Array, t: ArrayLike) -> tuple[Array, Array, Array]:
    """The number k of the interval that holds t, the time since its start, and its length.

    Outside of the table it raises ValueError if t is concrete; otherwise the length is NaN.
    """
    first, last = times[0], times[-1]
    if concrete(t, times) and not float(first) <= float(now := np.asarray(t)) <= float(last):
        raise ValueError(f"the table has times from {float(first):g} to {float(last):g}, got t = {float(now):g}")
    t = jnp.asarray(t, times.dtype)
    k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    return k, t - times[k], jnp.where((first <= t) & (t <= last), times[k + 1] - times[k], jnp.nan)
