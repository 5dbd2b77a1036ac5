"""A loop compiled as a program of single numbers, where that is possible.

The transpose of v[i] is a `pad`, and the pull-back of a step is full of them; XLA does not fuse pads, and works on all
components even where only one is not zero. In a program of numbers indexing, stacking and padding cost nothing, and
zeros are dropped. Over a batch, the pull-back of a free body's step is 3 times faster.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.typing import ArrayLike

from lieint_jax._checks import concrete
from lieint_jax.native import Flattened, UnsupportedError
from lieint_jax.types.shapes import PyTree

_LONGEST = 10_000  # the most operations of a program of numbers that XLA compiles in bearable time


def repeat(
    count: ArrayLike, function: Callable[[PyTree, PyTree], PyTree], carry: PyTree, over: tuple[float, ...]
) -> PyTree:
    """Apply carry ← function(carry, x) for each x in `over`, `count` times. It is not differentiable."""
    dtype = jnp.result_type(*jax.tree.leaves(carry))
    explicit, closed = _explicit_arrays(function, carry, jnp.ones((), dtype))

    def repeat_with_arrays(count: ArrayLike, carry: PyTree, closed: PyTree) -> PyTree:
        return _repeat_program(count, partial(explicit, closed), carry, over, dtype)

    arguments = (count, carry, closed)
    try:
        by_numbers = Flattened(repeat_with_arrays, ("shared",) * 3, arguments)
        if by_numbers.length <= _LONGEST:
            return by_numbers(*arguments)
    except UnsupportedError:
        pass
    return repeat_with_arrays(*arguments)


def _explicit_arrays(function: Callable[..., PyTree], *example: PyTree) -> tuple[Callable[..., PyTree], list[Array]]:
    """`function` with the traced arrays that it closes over, of any type, as its first argument; and these arrays.

    `jax.closure_convert` makes only arrays of real numbers arguments.
    """
    closed, out = jax.make_jaxpr(function, return_shape=True)(*example)
    traced = [not concrete(x) for x in closed.consts]

    def call_with_arrays(arrays: list[Array], *arguments: PyTree) -> PyTree:
        following = iter(arrays)
        consts = [next(following) if hoisted else x for x, hoisted in zip(closed.consts, traced, strict=True)]
        results = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, consts))(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(out), results)

    return call_with_arrays, [x for x, hoisted in zip(closed.consts, traced, strict=True) if hoisted]


def _repeat_program(
    count: ArrayLike,
    function: Callable[[PyTree, PyTree], PyTree],
    carry: PyTree,
    over: tuple[float, ...],
    dtype: np.dtype,
) -> PyTree:
    if len(over) == 1:
        return lax.fori_loop(0, count, lambda _, c: function(c, np.asarray(over[0], dtype)), carry)

    # x is carried, since XLA would fuse a slice of `over` into every loop over a batch
    def step_once(carry: tuple[PyTree, Array], following: Array) -> tuple[tuple[PyTree, Array], None]:
        return (function(*carry), following), None

    xs = jnp.asarray(over, dtype)
    return lax.fori_loop(0, count, lambda _, c: lax.scan(step_once, (c, xs[0]), jnp.roll(xs, -1))[0][0], carry)
