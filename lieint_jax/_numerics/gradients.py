"""Gradients of any function: its derivative, and the mean of it along a step, corrected (Gonzalez 1996)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import PyTree

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def autodiff_gradient(potential: Callable[..., Array], argnums: int | tuple[int, ...] = 0) -> Callable[..., PyTree]:
    """`jax.grad(potential, argnums)`, but NaN where the potential itself is not finite.

    The derivative of log x is finite for x < 0, where log x is NaN: a step would continue where there is no motion.
    """

    def gradient(*arguments: Array) -> PyTree:
        V, slopes = jax.value_and_grad(potential, argnums)(*arguments)
        defined = jnp.isfinite(V)
        return jax.tree.map(lambda slope: jnp.where(defined, slope, jnp.nan), slopes)

    return gradient


def discrete_gradient(function: Callable[..., Array], a: Array, b: Array, apart: float, *more: Array) -> Array:
    """D with D·(b − a) = V(b) − V(a) and D(a, b) = D(b, a), of vectors of any length, for V = function(·, *more).

    This is the mean of the gradient over four Gauss nodes. Where |b − a|² exceeds the threshold `apart`, relative to
    the greater of |a|² and |b|², a multiple of b − a is added; below, the quadrature is exact to round-off and this
    correction would consist of rounding errors only.
    """
    step = b - a
    at = (a + b)[None] / 2 + jnp.asarray(_NODES, a.dtype)[:, None] * (step / 2)[None]
    gradients = jax.vmap(lambda x: autodiff_gradient(function)(x, *more))(at)
    mean = jnp.tensordot(jnp.asarray(_WEIGHTS / 2, a.dtype), gradients, 1)
    square = jnp.sum(step * step)
    corrected = square > apart * jnp.maximum(jnp.sum(a * a), jnp.sum(b * b))
    missing = function(b, *more) - function(a, *more) - jnp.sum(mean * step)
    return mean + jnp.where(corrected, missing / jnp.where(corrected, square, 1), 0) * step
