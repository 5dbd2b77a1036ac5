"""Reverse mode of long loops: the backward pass computes a step again instead of storing its intermediate values.

A step has about a hundred intermediate values, each of which would be an array over the steps, written entry by entry.
Computing them again is faster than storing them, halves the compile time and needs hardly any memory. Values that are
expensive to compute, such as a root found by iteration, are `saved`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax
from jax.ad_checkpoint import checkpoint_name

from lieint_jax._xla._compile import Tree

_SAVED = "lieint_jax"
_Function = TypeVar("_Function", bound=Callable[..., Tree])
_Tree = TypeVar("_Tree")
_Carry = TypeVar("_Carry")


def rematerialized(function: _Function) -> _Function:
    """The body of a loop, of which reverse mode stores only the arguments and the values that are `saved`."""
    return jax.checkpoint(function, prevent_cse=False, policy=_is_saved)  # pyright: ignore[reportReturnType]


def scan_stages(function: Callable[[_Carry, Tree], tuple[_Carry, None]], carry: _Carry, stages: Tree) -> _Carry:
    """The last carry of a `lax.scan` over the stages of a step, each `rematerialized`, their carries `saved`.

    Otherwise reverse mode of a loop over steps would compute the stages of a step twice more, first for the carries.
    """
    body = rematerialized(function)
    return saved(lax.scan(lambda carry, stage: body(saved(carry), stage), carry, stages)[0])


def saved(tree: _Tree) -> _Tree:
    """The same arrays, which a function that is `rematerialized` does not compute again."""
    return jax.tree.map(lambda x: checkpoint_name(x, _SAVED), tree)


def _is_saved(primitive: object, *_: object, name: object = None, call_jaxpr: object = None, **__: object) -> bool:
    """True if the results of an operation are saved; a `custom_root` with a saved root is one operation here."""
    inside: Any = getattr(call_jaxpr, "jaxpr", call_jaxpr)
    return name == _SAVED or (inside is not None and any(eqn.params.get("name") == _SAVED for eqn in inside.eqns))
