"""Reverse mode of long loops: a step is computed once more on the way back, in place of keeping all that it computes.

What a step computes on its way is a hundred numbers, each an array over the steps, written one by one. To compute them
again takes less time than to keep them, half of the compile time, and hardly any memory. What is dear to compute, such
as a root that a loop finds, is `saved`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax
from jax.ad_checkpoint import checkpoint_name

_SAVED = "lieint_jax"
_Function = TypeVar("_Function", bound=Callable[..., Any])
_Tree = TypeVar("_Tree")
_Carry = TypeVar("_Carry")


def rematerialized(function: _Function) -> _Function:
    """The body of a loop, of which reverse mode keeps the arguments and what in it is `saved`."""
    return jax.checkpoint(function, prevent_cse=False, policy=_is_saved)  # pyright: ignore[reportReturnType]


def scan_stages(function: Callable[[_Carry, Any], tuple[_Carry, None]], carry: _Carry, each: Any) -> _Carry:
    """The last carry of a `lax.scan` over the stages of a step, each `rematerialized`, their carries `saved`.

    Else reverse mode of a loop over steps would go through the stages of a step twice, first to find the carries.
    """
    again = rematerialized(function)
    return saved(lax.scan(lambda carry, one: again(saved(carry), one), carry, each)[0])


def saved(tree: _Tree) -> _Tree:
    """The same arrays, which a function that is `rematerialized` does not compute again."""
    return jax.tree.map(lambda x: checkpoint_name(x, _SAVED), tree)


def _is_saved(primitive: Any, *_: Any, name: Any = None, call_jaxpr: Any = None, **__: Any) -> bool:
    """Whether results of an operation are saved; a `custom_root` that keeps its root is one operation here."""
    inside = getattr(call_jaxpr, "jaxpr", call_jaxpr)
    return name == _SAVED or (inside is not None and any(eqn.params.get("name") == _SAVED for eqn in inside.eqns))
