"""What a search for a minimum carries from one iteration to the next, and how a trial is looked at."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

RUNNING, FLAT, STILL, TARGET, STUCK, NOWHERE = range(6)
REASONS = (
    "the iterations were used up",
    "the gradient vanished",
    "the loss no longer fell",
    "the target was reached",
    "every shorter step failed or went up",
    "the first guess failed",
)
GOOD = (FLAT, STILL, TARGET)
SHORTENINGS = 40  # in a row, before a search gives up


class Carry(NamedTuple):
    """One start's search.

    Attributes:
        x: where it is.
        loss: there.
        memory: what the method remembers.
        code: whether it goes on, or why not.
        bad: trials in a row that failed or went up.
        failures: trials that failed.
    """

    x: Array
    loss: Array
    memory: Any
    code: Array
    bad: Array
    failures: Array


class Method(NamedTuple):
    """An optimiser: its memory at a first guess, and one iteration."""

    first: Callable[[Array], tuple[Array, Any, Array]]  # x ↦ loss, memory, ok
    advance: Callable[[Carry], Carry]


def valued(outcome: Any) -> tuple[Any, Array]:
    """A value and whether it converged: a pair with a truth value, or a bare value, which has."""
    if isinstance(outcome, tuple) and len(outcome) == 2 and _is_flag(outcome[1]):
        return outcome[0], jnp.all(jnp.asarray(outcome[1]))
    return outcome, jnp.ones((), bool)


def _is_flag(x: Any) -> bool:
    return isinstance(x, bool | np.ndarray | np.generic | Array) and jnp.issubdtype(jnp.result_type(x), jnp.bool_)


def residuals_of(function: Callable[[Any], Any], params: Any) -> tuple[Array, Array]:
    """The residuals as one vector, and whether they converged."""
    value, ok = valued(function(params))
    return ravel_pytree(value)[0], ok


def where(good: Array, new: Any, old: Any) -> Any:
    """A tree of `new` where `good`, else of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)
