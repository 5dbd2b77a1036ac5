"""Selection between two values.

`jnp.where` is a jitted function, which is traced again by every transformation: gradients of long functions with many
of them need a tenth longer to trace and to compile.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike


def where(condition: Array, x: ArrayLike, y: ArrayLike) -> Array:
    """`jnp.where` for values that are numbers or arrays."""
    dtype = jnp.result_type(x, y)
    shape = jnp.broadcast_shapes(jnp.shape(condition), jnp.shape(x), jnp.shape(y))
    chosen, other = (jnp.broadcast_to(jnp.asarray(value, dtype), shape) for value in (x, y))
    return lax.select(jnp.broadcast_to(condition, shape), chosen, other)
