"""Numbers that XLA computes once and stores in memory."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from lieint_jax._xla._compile import Tree

UNKNOWN_ONE = "lieint_jax: 1"  # by this name machine code, which needs none of this, knows the number


def materialized(numbers: Tree) -> Tree:
    """The same numbers, an array (n,) or a list of arrays of one shape, each computed once and stored in memory.

    XLA on CPUs has no barrier that persists until fusion, but it does not duplicate expensive operations such as
    division. So each number is divided by a 1 that is unknown at compile time and computed from the first number.
    """
    first = numbers[0] / _unknown_one(numbers[0])
    one = _unknown_one(first)
    return (first, *(x / one for x in numbers[1:]))


def unfused(x: Tree) -> Tree:
    """The same array, which XLA computes before the operations that use it."""
    return lax.optimization_barrier(x)


def materialized_arrays(tree: Tree) -> Tree:
    """The same arrays, those of real numbers each computed once and stored in memory."""
    return jax.tree.map(lambda x: x / _unknown_one(x) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def with_materialized_derivatives(tree: Tree) -> Tree:
    """The same arrays of real numbers, materialized together with their tangents where forward mode differentiates.

    XLA computes the tangent of a long function again for each of its results. Without a derivative this costs nothing.
    """
    return jax.tree.map(_identity, tree)


@jax.custom_jvp
def _identity(x: Array) -> Array:
    return x


@_identity.defjvp
def _identity_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (slope,) = primals, tangents
    one = _unknown_one(x)
    return x / one, slope / one


def _unknown_one(x: Array) -> Array:
    """1 in the shape of x, which the compiler cannot know, since x may be NaN."""
    return checkpoint_name(1 + 0 * lax.stop_gradient(x), UNKNOWN_ONE)
