"""The state of a search for a minimum, why a search stops, and the values of trial points."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from lieint_jax._checks import dtype_of
from lieint_jax._numerics.arrays import PyTree
from lieint_jax.core import StepInfo

RUNNING, FLAT, STILL, SETTLED, TARGET, STUCK, NOWHERE, BEYOND, HIDDEN = range(9)
REASONS = (
    "the iterations were used up",
    "the gradient vanished",
    "the loss no longer fell",
    "the steps became negligible",
    "the target was reached",
    "no step led further down, though the gradient has not vanished",
    "the first guess failed",
    "the sum of squares at the first guess leaves the range of floating-point numbers",
    "a parameter is far from its optimum, which the rounding errors of the loss hide",
)
GOOD = (FLAT, STILL, SETTLED, TARGET)
SHORTENINGS = 40  # the most in a row before a search gives up


class Carry(NamedTuple):
    """The state of the search from one start.

    Attributes:
        x: the current point.
        loss: the loss at x.
        memory: the optimizer's own state.
        code: RUNNING, or why the search stopped: an index of REASONS.
        bad: the number of trials in a row that failed or raised the loss.
        failures: the number of trials that failed.
    """

    x: Array
    loss: Array
    memory: PyTree
    code: Array
    bad: Array
    failures: Array


class Method(NamedTuple):
    """An optimizer: `first` evaluates the first guess, `iterate` makes one iteration."""

    first: Callable[[Array], tuple[Array, PyTree, Array]]  # x ↦ loss, memory, ok
    iterate: Callable[[Carry], Carry]


def value_and_flag(outcome: PyTree) -> tuple[PyTree, Array]:
    """A value and whether it converged, from a pair (value, flags or `StepInfo`) or a value alone, which converged."""
    if isinstance(outcome, tuple) and len(outcome) == 2:
        value, flag = outcome
        flag = flag.converged if isinstance(flag, StepInfo) else flag
        if _is_flag(flag):
            return value, jnp.all(jnp.asarray(flag))
    return outcome, jnp.ones((), bool)


def _is_flag(x: object) -> bool:
    return isinstance(x, bool | np.ndarray | np.generic | Array) and jnp.issubdtype(jnp.result_type(x), jnp.bool_)


def residuals_of(function: Callable[[PyTree], PyTree], params: PyTree) -> tuple[Array, Array]:
    """The residuals as one vector, and whether they converged."""
    value, ok = value_and_flag(function(params))
    check_real("the residuals", value)
    return ravel_pytree(value)[0], ok


def check_real(name: str, tree: PyTree, *more: type) -> None:
    """ValueError if a leaf of a tree does not hold floating-point numbers, or such of `more` kinds of dtypes."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        dtype = np.asarray(leaf).dtype if (known := dtype_of(leaf)) is None else known
        if not any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, *more)):
            parts = ": fit real and imaginary parts" if jnp.issubdtype(dtype, jnp.complexfloating) else ""
            raise ValueError(f"{name}{jax.tree_util.keystr(path)} must hold real numbers, got dtype {dtype}{parts}")


def where(good: Array, new: PyTree, old: PyTree) -> PyTree:
    """The tree `new` where `good`, otherwise `old`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)
