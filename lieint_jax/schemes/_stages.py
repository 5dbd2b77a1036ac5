"""The stages of a collocation method: the values of several unknowns at s nodes, or their derivatives there.

Each unknown is an array with the axis of stages first, (s, …). Many members may be computed at once, their axis the
last, (s, …, members): so they vectorise on a CPU, which a vmapped step does not do, whose member axis JAX puts first.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics import kernel

Components = tuple[Array, ...]


class Members(NamedTuple):
    """Which arguments have an axis of members, the last; of one member none has.

    Attributes:
        many: whether there are members.
        system, inverse, state: −1 or None for each leaf, as of `jax.vmap`.
    """

    many: bool
    system: Any = None
    inverse: Any = None
    state: Any = None

    def each(self, function: Callable[..., Any], axes: tuple[Any, ...], out: int = -1) -> Callable[..., Any]:
        """`function` of one member, for all."""
        return jax.vmap(function, axes, out) if self.many else function

    def largest(self, x: Array) -> Array:
        """The largest entry, of each member."""
        return jnp.max(x, axis=tuple(range(x.ndim - self.many)))


def moved(z: Components, k: Components, dt: Array, weights: np.ndarray) -> Components:
    """z + Δt Σ_j w_ij k_j, of every row of weights."""

    @kernel.stage
    def sums(z: Components, k: Components, dt: Array) -> Components:
        if not kernel.inside() and jax.default_backend() == "cpu":  # a shorter program there, and a faster one
            w = dt * jnp.asarray(weights, dt.dtype)
            return tuple(x + jnp.tensordot(w, y, 1, precision="highest") for x, y in zip(z, k, strict=True))
        w = [row.reshape(-1, *[1] * (k[0].ndim - 1)) for row in weights.astype(dt.dtype).T]
        return tuple(
            x + dt * functools.reduce(jnp.add, [a * y[j : j + 1] for j, a in enumerate(w)])
            for x, y in zip(z, k, strict=True)
        )

    return sums(z, k, dt)


def summed(z: Components, k: Components, dt: Array, weights: np.ndarray) -> Components:
    """z + Δt Σ w_j k_j, of one row of weights."""
    return tuple(x[0] for x in moved(z, k, dt, weights[None]))
