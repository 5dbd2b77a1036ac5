"""Arguments of laws of torque: vectors and directions that may depend on time, limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics.vectors import Symmetric, norm, symmetric
from lieint_jax._xla import rereading_jit
from lieint_jax.core import callable_pytree
from lieint_jax.groups import so3

VectorOfTime = Array | Callable[[Array], Array]
NO_ROTATION = (1.0, 0.0, 0.0, 0.0)


def rotation(name: str, value: ArrayLike) -> Array:
    """A unit quaternion, normalized. That of a default, NO_ROTATION, is weakly typed, as a Python number is."""
    if value is NO_ROTATION:
        return jnp.stack(NO_ROTATION)
    return so3.normalize(_checks.unit_quaternion(name, value))


def vector_of_time(name: str, value: Any) -> VectorOfTime:
    """A vector (3,), or a function of time with such values; ValueError if it is neither."""
    if not callable(value):
        return _checks.real_array(name, value, (3,))
    _checks.function(name, value, "the time t", (3,), jnp.zeros(()))
    return callable_pytree(value)


def value_at(vector: VectorOfTime, t: Array) -> Array:
    """The vector at a time, (3,)."""
    return jnp.asarray(evaluate(vector, t)) if callable(vector) else vector


def direction_of_time(name: str, value: Any) -> VectorOfTime:
    """A unit vector (3,), or a function of time with vectors of any length; ValueError if it is neither."""
    return vector_of_time(name, value) if callable(value) else _checks.unit_vector(name, value)


def direction_at(direction: VectorOfTime, t: Array) -> Array:
    """The unit vector at a time, (3,): the values of a function are normalized, for it was not checked."""
    s = value_at(direction, t)
    return s / norm(s) if callable(direction) else s


@rereading_jit
def evaluate(function: Callable[[Array], Any], t: Array) -> Any:
    """A function of time, traced once, although a step evaluates it in each iteration."""
    return function(t)


def dissipative_tensor(name: str, value: ArrayLike) -> Array:
    """A number, principal values (3,), or a symmetric tensor (3, 3) without a negative principal value."""
    D = _checks.real_array(name, value, (), (3,), (3, 3))
    if concrete(D):
        values = np.asarray(D, float)
        if values.ndim == 2:
            if not np.allclose(values, values.T, rtol=1e-6, atol=1e-6 * np.abs(values).max()):
                raise ValueError(f"{name} must be symmetric, got\n{values}\nGive (D + D.T) / 2")
            values = np.linalg.eigvalsh(values)
        if values.min() < -1e-12 * np.abs(values).max():
            raise ValueError(f"{name} must not be negative, got principal values {values}")
    return D


def tensor_of(value: Array) -> Symmetric:
    """The tensor that `dissipative_tensor` accepts; a number stands for a multiple of the identity."""
    return symmetric(value if value.ndim else jnp.broadcast_to(value, (3,)))


def cut(vector: Array, limit: Array) -> Array:
    """A vector with each component within ± the limit, whose derivative is 0 beyond it and at it."""
    vector = jnp.asarray(vector)
    limit = jnp.broadcast_to(limit, vector.shape).astype(vector.dtype)
    return lax.clamp(-limit, vector, limit)


def rotating(vector: Array, t: Array) -> Array:
    """A vector that rotates about the third axis, for the examples."""
    c, s = jnp.cos(t), jnp.sin(t)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])


def example_of_time(x: float = 0.1, y: float = 0.2, z: float = -0.9) -> Partial:
    """A vector that depends on time, whose numbers are leaves."""
    return Partial(rotating, jnp.array([x, y, z]))
