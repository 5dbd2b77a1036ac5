"""Reverse mode of long loops: a step is computed once more on the way back, in place of keeping all that it computes.

What a step computes on its way is a hundred numbers, each an array over the steps, written one by one. To compute them
again takes less time than to keep them, half of the compile time, and hardly any memory. What is dear to compute, such
as a root that a loop finds, is `kept`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax
from jax.ad_checkpoint import checkpoint_name

_KEPT = "lieint_jax"
_Function = TypeVar("_Function", bound=Callable[..., Any])
_Tree = TypeVar("_Tree")
_Carry = TypeVar("_Carry")


def replayed(function: _Function) -> _Function:
    """The same function, of which reverse mode keeps the arguments and what in it is `kept`; for the body of a loop."""
    return jax.checkpoint(function, prevent_cse=False, policy=_is_kept)  # pyright: ignore[reportReturnType]


def stages(function: Callable[[_Carry, Any], tuple[_Carry, None]], carry: _Carry, each: Any) -> _Carry:
    """The last carry of a `lax.scan` over the stages of a step, each `replayed`, their carries `kept`.

    Else reverse mode of a loop over steps would go through the stages of a step twice, first to find the carries.
    """
    again = replayed(function)
    return kept(lax.scan(lambda carry, one: again(kept(carry), one), carry, each)[0])


def kept(tree: _Tree) -> _Tree:
    """The same arrays, which a function that is `replayed` does not compute again."""
    return jax.tree.map(lambda x: checkpoint_name(x, _KEPT), tree)


def _is_kept(primitive: Any, *_: Any, name: Any = None, call_jaxpr: Any = None, **__: Any) -> bool:
    """Whether results of an operation are kept; a `custom_root` that keeps its root is one operation here."""
    inside = getattr(call_jaxpr, "jaxpr", call_jaxpr)
    return name == _KEPT or (inside is not None and any(eqn.params.get("name") == _KEPT for eqn in inside.eqns))
