"""Numbers that XLA computes once and stores in memory."""

from __future__ import annotations

from jax import lax

from lieint_jax._xla._compile import Tree


def materialized(numbers: Tree) -> Tree:
    """The same numbers, an array (n,) or a list of arrays of one shape, each computed once and stored in memory.

    XLA on CPUs has no barrier that persists until fusion, but it does not duplicate expensive operations such as
    division. So each number is divided by a 1 that is unknown at compile time and computed from the first number.
    """
    first = numbers[0] / (1 + 0 * lax.stop_gradient(numbers[0]))
    one = 1 + 0 * lax.stop_gradient(first)
    return (first, *(x / one for x in numbers[1:]))


def unfused(x: Tree) -> Tree:
    """The same array, which XLA computes before the operations that use it."""
    return lax.optimization_barrier(x)
