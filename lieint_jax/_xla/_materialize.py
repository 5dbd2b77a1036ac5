"""Numbers that XLA computes once and stores in memory."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from lieint_jax._xla._compile import Tree

once_p = Primitive("once")  # the same array, computed once


def materialized(numbers: Tree) -> Tree:
    """The same numbers, an array (n,) or a list of arrays of one shape, each computed once and stored in memory."""
    return tuple(map(once_p.bind, numbers))


def unfused(x: Tree) -> Tree:
    """The same array, which XLA computes before the operations that use it."""
    return lax.optimization_barrier(x)


def materialized_arrays(tree: Tree) -> Tree:
    """The same arrays, those of real numbers each computed once and stored in memory."""
    return jax.tree.map(lambda x: once_p.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


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
    return once_p.bind(*primals), once_p.bind(*tangents)


def _once(x: Array) -> Array:
    return x


def _over_one(x: Array) -> Array:
    """x/1 with a 1 that the compiler cannot know, since x may be NaN.

    XLA on CPUs has no barrier that persists until fusion, but it does not compute a division twice. A divisor that is a
    broadcast array would not do: XLA multiplies by its reciprocal. So this is a primitive, which sees its final shape.
    """
    return x / (1 + 0 * x)


once_p.def_impl(_once)
once_p.def_abstract_eval(_once)
ad.deflinear2(once_p, lambda ct, _: [once_p.bind(ct)])
batching.defvectorized(once_p)
mlir.register_lowering(once_p, mlir.lower_fun(_once, multiple_results=False))
mlir.register_lowering(once_p, mlir.lower_fun(_over_one, multiple_results=False), platform="cpu")
