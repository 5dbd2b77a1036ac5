"""Arguments of laws of torque: vectors that may depend on time, limits, unit vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.types import callable_pytree

VectorOfTime = Array | Callable[[Array], Array]


def vector_of_time(name: str, value: Any) -> VectorOfTime:
    """A vector (3,), or a function of time with such values; ValueError if it is neither."""
    if not callable(value):
        return _checks.real_array(name, value, (3,))
    _checks.function(name, value, "the time t", (3,), jnp.zeros(()))
    return callable_pytree(value)


def value_at(vector: VectorOfTime, t: Array) -> Array:
    """The vector at a time, (3,)."""
    return jnp.asarray(evaluate(vector, t)) if callable(vector) else vector


@jax.jit
def evaluate(function: Callable[[Array], Any], t: Array) -> Any:
    """A function of time, traced once, although a step evaluates it in each iteration."""
    return function(t)


def cut(vector: Array, limit: Array) -> Array:
    """A vector with each component within ± the limit, whose derivative is 0 beyond it and at it."""
    vector = jnp.asarray(vector)
    limit = jnp.broadcast_to(limit, vector.shape).astype(vector.dtype)
    return lax.clamp(-limit, vector, limit)


def unit_vector(name: str, value: ArrayLike, *shapes: tuple[int, ...]) -> Array:
    """A vector of unit length, or an array of them."""
    vector = _checks.real_array(name, value, *(shapes or ((3,),)))
    if concrete(vector):
        lengths = np.linalg.norm(np.asarray(vector, float), axis=-1)
        if np.max(np.abs(lengths - 1)) > _checks.UNIT_TOLERANCE:
            what = "must be a unit vector" if vector.ndim == 1 else "must be unit vectors"
            raise ValueError(f"{name} {what}, got {np.asarray(vector)}; divide by the length")
    return vector
