"""Long functions of few numbers, whose derivatives are computed in forward mode even within reverse mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from lieint_jax._xla._compile import Tree
from lieint_jax._xla._materialize import materialized_arrays, saved

_Function = TypeVar("_Function", bound=Callable[..., Tree])
_Slopes = Callable[..., Sequence[Tree]] | None


def forward_mode(function: _Function, smooth: _Function | None = None, slopes: _Slopes = None) -> _Function:
    """The same function, elementwise in arrays of one shape, with slopes always computed in forward mode.

    Reverse mode would store the intermediate values of the function and traverse all of them again, which compiles
    more slowly, and it cannot traverse a `while_loop`. Here it traverses a sum over the slopes by each argument that
    varies. The same holds for higher derivatives.

    Args:
        function: of a few arrays of one shape; its value may be a tuple of them.
        smooth: the same function in a form with accurate derivatives, if those of `function` are not accurate.
        slopes: the slopes of all values by each argument, where a formula in the value and the arguments is available.
    """
    sloped = jax.custom_jvp(function)
    sloped.defjvp(partial(_value_and_tangent, function, smooth or function, slopes), symbolic_zeros=True)
    return sloped  # pyright: ignore[reportReturnType]


def _value_and_tangent(
    function: _Function, form: _Function, slopes: _Slopes, primals: Tree, tangents: Tree
) -> tuple[Tree, Tree]:
    """The value and its tangent: a sum over slopes, which are computed together with the value."""
    varied = [k for k, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

    def value_and_slopes(*arguments: Tree) -> tuple[Tree, list[Tree]]:
        if slopes is None:
            return _slopes_by_jvp(form, arguments, varied)
        value = function(*arguments)
        each = slopes(value, *arguments)
        return value, [each[k] for k in varied]

    def second_derivatives(primals: Tree, tangents: Tree) -> tuple[Tree, Tree]:
        def slopes_only(*arguments: Tree) -> list[Tree]:
            return value_and_slopes(*arguments)[1]

        value = _value_and_tangent(function, form, slopes, primals, tangents)[1]
        return both(*primals), (value, _value_and_tangent(slopes_only, slopes_only, None, primals, tangents)[1])

    both = jax.custom_jvp(value_and_slopes)
    both.defjvp(second_derivatives, symbolic_zeros=True)
    value, each = saved(both(*primals))
    total = jax.tree.map(lambda *s: sum(x * tangents[k] for k, x in zip(varied, s, strict=True)), *each)
    return value, total


def jvp_of_varied(
    function: Callable[..., tuple[Tree, Tree]], primals: tuple[Tree, ...], tangents: tuple[Tree, ...]
) -> tuple[Tree, Tree, Tree]:
    """`jax.jvp(…, has_aux=True)` of a function, where tangents may be symbolic zeros."""
    arguments, structure = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
    varied = [k for k, t in enumerate(slopes) if not isinstance(t, SymbolicZero)]
    of_varied = _of_varied(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), arguments, varied)
    return jax.jvp(of_varied, tuple(arguments[k] for k in varied), tuple(slopes[k] for k in varied), has_aux=True)


def _of_varied(function: Callable[..., Tree], arguments: Sequence[Tree], varied: list[int]) -> Callable[..., Tree]:
    """The function of those of its arguments that vary."""

    def function_of_varied(*values: Tree) -> Tree:
        replaced = dict(enumerate(arguments)) | dict(zip(varied, values, strict=True))
        return function(*replaced.values())

    return function_of_varied


def _slopes_by_jvp(
    function: Callable[..., Tree], arguments: tuple[Tree, ...], varied: list[int]
) -> tuple[Tree, list[Tree]]:
    def jvp(*seeds: Tree) -> Tree:
        return jax.jvp(_of_varied(function, arguments, varied), tuple(arguments[k] for k in varied), seeds)

    seeds = (jnp.stack([jnp.full_like(arguments[k], float(k == n)) for n in varied]) for k in varied)
    value, stacked = jax.vmap(jvp, out_axes=(None, 0))(*seeds)
    # otherwise XLA computes a slope again in each of the many sums that reverse mode builds from it
    stacked = materialized_arrays(stacked)
    return value, [jax.tree.map(lambda s, n=n: s[n], stacked) for n in range(len(varied))]
