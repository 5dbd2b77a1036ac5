"""Long functions of few numbers, whose derivatives are found forwards, in reverse mode too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from lieint_jax._xla._materialize import materialized
from lieint_jax._xla._rematerialize import saved

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Slopes = Callable[..., Sequence[Any]] | None


def forward_mode(function: _Function, smooth: _Function | None = None, slopes: _Slopes = None) -> _Function:
    """The same function, elementwise in arrays of one shape, with slopes by forward mode whoever asks for them.

    Reverse mode would keep what the function computes on its way and go through all of it again, a program that
    compiles for longer; and it cannot go through a `while_loop`. Here it goes through a sum over the slopes by each
    argument that varies. So do derivatives of derivatives.

    Args:
        function: of a few arrays of one shape; its value may be a tuple of them.
        smooth: the same function in a form whose derivatives are good, if those of `function` are not.
        slopes: the slopes of all values by each argument, where they are known.
    """
    sloped = jax.custom_jvp(function)
    sloped.defjvp(partial(_sloped, function, smooth or function, slopes), symbolic_zeros=True)
    return sloped  # pyright: ignore[reportReturnType]


def _sloped(function: _Function, form: _Function, slopes: _Slopes, primals: Any, tangents: Any) -> tuple[Any, Any]:
    """The value and its tangent: a sum over slopes, which are found together with the value."""
    varied = [k for k, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

    def found(*given: Any) -> tuple[Any, list[Any]]:
        if slopes is None:
            return _by_jvp(form, given, varied)
        each = slopes(*given)
        return function(*given), [each[k] for k in varied]

    def again(primals: Any, tangents: Any) -> tuple[Any, Any]:
        def only(*given: Any) -> list[Any]:
            return found(*given)[1]

        value = _sloped(function, form, slopes, primals, tangents)[1]
        return both(*primals), (value, _sloped(only, only, None, primals, tangents)[1])

    both = jax.custom_jvp(found)
    both.defjvp(again, symbolic_zeros=True)
    value, each = saved(both(*primals))
    total = jax.tree.map(lambda *s: sum(x * tangents[k] for k, x in zip(varied, s, strict=True)), *each)
    return value, total


def _by_jvp(function: Callable[..., Any], given: tuple[Any, ...], varied: list[int]) -> tuple[Any, list[Any]]:
    def of(*some: Any) -> Any:
        every = dict(enumerate(given)) | dict(zip(varied, some, strict=True))
        return function(*every.values())

    def along(*seeds: Any) -> Any:
        return jax.jvp(of, tuple(given[k] for k in varied), seeds)

    seeds = (jnp.stack([jnp.full_like(given[k], float(k == n)) for n in varied]) for k in varied)
    value, stacked = jax.vmap(along, out_axes=(None, 0))(*seeds)
    # once: else XLA computes a slope again in each of the many sums that reverse mode makes with it
    stacked = jax.tree.map(lambda s: materialized((s,))[0], stacked)
    return value, [jax.tree.map(lambda s, n=n: s[n], stacked) for n in range(len(varied))]
