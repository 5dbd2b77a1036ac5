"""Long functions of few numbers, whose derivatives are found forwards, in reverse mode too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

_Function = TypeVar("_Function", bound=Callable[..., Any])


def forwards(function: _Function, smooth: _Function | None = None) -> _Function:
    """The same function, elementwise in arrays of one shape, with slopes by forward mode whoever asks for them.

    Reverse mode would keep what the function computes on its way and go through all of it again, a program that
    compiles for longer; and it cannot go through a `while_loop`. Here it goes through a sum over the slopes by each
    argument that varies. So do derivatives of derivatives.

    Args:
        function: of a few arrays of one shape; its value may be a tuple of them.
        smooth: the same function in a form whose derivatives are good, if those of `function` are not.
    """
    sloped, form = jax.custom_jvp(function), smooth or function

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        varied = [k for k, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

        @forwards
        def slopes(*given: Any) -> Any:
            def of(*some: Any) -> Any:
                every = dict(enumerate(given)) | dict(zip(varied, some, strict=True))
                return form(*every.values())

            def along(*seeds: Any) -> Any:
                return jax.jvp(of, tuple(given[k] for k in varied), seeds)[1]

            return jax.vmap(along)(
                *(jnp.stack([jnp.full_like(given[k], float(k == n)) for n in varied]) for k in varied)
            )

        total = jax.tree.map(lambda s: sum(s[n] * tangents[k] for n, k in enumerate(varied)), slopes(*primals))
        return sloped(*primals), total

    sloped.defjvp(rule, symbolic_zeros=True)
    return sloped  # pyright: ignore[reportReturnType]
