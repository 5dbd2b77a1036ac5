"""Runs with steps of half the size: how `fit` measures the error of the steps behind its residuals."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import jax

from lieint_jax.types import Step


class HalvedRuns:
    """The runs of finite order that were traced in `halved_steps`.

    Attributes:
        orders: the orders of their steps.
    """

    def __init__(self) -> None:
        self.orders: list[float] = []


_context = jax.make_user_context(None)  # part of the key of every jit cache: jitted functions are traced again


@contextlib.contextmanager
def halved_steps() -> Iterator[HalvedRuns]:
    """A context in which `integrate`, `observe`, `reversible` and `event` split every step into two."""
    runs = HalvedRuns()
    with _context(runs):
        yield runs


def splits(step: Step) -> int:
    """Into how many steps a run splits each step: 2 in `halved_steps`, otherwise 1.

    Exact steps are not split, nor are those with noise, which half the size would change.
    """
    if _context.value is None or math.isinf(step.order) or step.deterministic is not None:
        return 1
    _context.value.orders.append(float(step.order))
    return 2
