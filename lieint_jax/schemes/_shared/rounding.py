"""The limits of schemes on SO(3) that rounding sets."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax.typing import DTypeLike

SLENDER = (
    "the inertia's moments differ so much that a full tensor does not hold the smallest one (to 1 : 3.5e4 in float64, "
    "1 : 1400 in float32): give principal moments (3,), and turn the attitude to the principal axes"
)


def attitude_error_limit(dtype: DTypeLike) -> float:
    """The error of an attitude, by rounding of the state alone, above which a step is not to be trusted."""
    return max(1e-6, math.sqrt(jnp.finfo(dtype).eps))
