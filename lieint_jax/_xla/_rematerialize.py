"""Reverse mode of long loops: the backward pass computes a step again instead of storing its intermediate values.

A step has about a hundred intermediate values, each of which would be an array over the steps, written entry by entry.
Computing them again is faster than storing them, halves the compile time and needs hardly any memory. Values that are
expensive to compute, such as a root found by iteration, are `saved`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.ad_checkpoint import checkpoint_name

from lieint_jax._xla._compile import Tree

_SAVED = "lieint_jax"
_Function = TypeVar("_Function", bound=Callable[..., Tree])
_Tree = TypeVar("_Tree")


def rematerialized(function: _Function) -> _Function:
    """The body of a loop, of which reverse mode stores only the arguments and the values that are `saved`."""
    return jax.checkpoint(function, prevent_cse=False, policy=_is_saved)  # pyright: ignore[reportReturnType]


def saved(tree: _Tree) -> _Tree:
    """The same arrays, which a function that is `rematerialized` does not compute again."""
    return jax.tree.map(lambda x: checkpoint_name(x, _SAVED), tree)


def _is_saved(primitive: object, *_: object, **parameters: Any) -> bool:
    """True if the results of an operation are saved; a `custom_root` with a saved root is one operation here."""
    composite = getattr(parameters.get("_prim"), "params", {})  # what `custom_root` is in JAX ≥ 0.12
    inside = [getattr(x, "jaxpr", x) for x in (*parameters.values(), *composite.values())]
    equations = [equation for x in inside for equation in getattr(x, "eqns", ())]
    return _SAVED in (parameters.get("name"), *(equation.params.get("name") for equation in equations))
