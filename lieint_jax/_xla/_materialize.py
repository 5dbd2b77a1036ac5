"""Numbers that XLA computes once, and keeps in memory."""

from __future__ import annotations

from typing import Any

from jax import lax


def materialized(numbers: Any) -> Any:
    """The same numbers, an array (n,) or a list of arrays of one shape, each computed once and held in memory.

    XLA on CPUs has no barrier that lasts until fusion, but it does not duplicate expensive operations such as division:
    so each number is divided by a 1 that is not known at compile time, got from the first.
    """
    first = numbers[0] / (1 + 0 * lax.stop_gradient(numbers[0]))
    one = 1 + 0 * lax.stop_gradient(first)
    return (first, *(x / one for x in numbers[1:]))


def unfused(x: Any) -> Any:
    """The same array, which XLA computes before what uses it."""
    return lax.optimization_barrier(x)
