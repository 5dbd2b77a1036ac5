"""Functions of small arrays as arithmetic of single numbers, without an array in them.

The jaxpr of a function is walked through with every array as a NumPy array of its entries: what moves entries about
then costs nothing, and a product of matrices is its products and sums.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def _names(words: str) -> frozenset[str]:
    return frozenset(words.split())


_EACH = _names(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy cos cosh div "
    "eq erf erfc exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul name ne neg not "
    "or pow rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor"
)
_MOVES = _names(
    "broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile transpose unstack"
)
_CALLS = _names("checkpoint closed_call core_call custom_jvp_call custom_vjp_call jit pjit remat2")
_REDUCES: dict[str, Callable[..., Any]] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
}


class NotArithmeticError(Exception):
    """A function does something else than arithmetic of numbers."""


def flat(function: Callable[..., Any], *arguments: Any) -> tuple[ClosedJaxpr, Any]:
    """A jaxpr from all entries of the arguments to all entries of the results, and the results as shapes."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    leaves = jax.tree.leaves(arguments)

    def by_numbers(*numbers: Any) -> list[Any]:
        left = iter(numbers)
        inputs = [_array([next(left) for _ in range(np.size(x))], np.shape(x)) for x in leaves]
        outputs = _walked(closed.jaxpr, [_entries(x) for x in closed.consts], inputs)
        return [number for x in outputs for number in x.flat]

    numbers = [jax.ShapeDtypeStruct((), x.dtype) for x in leaves for _ in range(np.size(x))]
    return jax.make_jaxpr(by_numbers)(*numbers), shapes


def used(jaxpr: Jaxpr) -> list[bool]:
    """Which of its arguments the results of a jaxpr depend on."""
    needed = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            needed.update(x for x in equation.invars if not isinstance(x, Literal))
    return [x in needed for x in jaxpr.invars]


def _walked(jaxpr: Jaxpr, consts: Sequence[np.ndarray], inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))

    def read(x: Any) -> np.ndarray:
        return _entries(np.asarray(x.val, x.aval.dtype)) if isinstance(x, Literal) else values[x]  # pyright: ignore

    for equation in jaxpr.eqns:
        outputs = _applied(equation, [read(x) for x in equation.invars])
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _applied(equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    name, parameters = equation.primitive.name, equation.params
    if name in _EACH:
        pairs = np.broadcast_arrays(*inputs)
        entries = [equation.primitive.bind(*row, **parameters) for row in zip(*(x.flat for x in pairs), strict=True)]
        return [_array(entries, pairs[0].shape)]
    if not inputs:
        with jax.ensure_compile_time_eval():
            return [_entries(equation.primitive.bind(**parameters))]
    if name in _MOVES:
        return _moved(equation, inputs)
    if name in _REDUCES:
        return [_reduced(_REDUCES[name], inputs[0], parameters["axes"])]
    if name == "dot_general":
        return [_product(inputs[0], inputs[1], parameters["dimension_numbers"])]
    if name in _CALLS:
        inner = parameters["jaxpr"] if "jaxpr" in parameters else parameters["call_jaxpr"]
        inner = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return _walked(inner.jaxpr, [_entries(x) for x in inner.consts], inputs)
    raise NotArithmeticError(name)


def _moved(equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """What moves entries, done to their numbers."""
    ends = itertools.accumulate(x.size for x in inputs)
    rows = [np.arange(end - x.size, end).reshape(x.shape) for x, end in zip(inputs, ends, strict=True)]
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*rows, **equation.params)
        orders = [np.asarray(x) for x in (found if equation.primitive.multiple_results else [found])]
    entries = [entry for x in inputs for entry in x.flat]
    return [_array([entries[n] for n in order.flat], order.shape) for order in orders]


def _reduced(by: Callable[..., Any], x: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    rest = [n for n in range(x.ndim) if n not in axes]
    shape = [x.shape[n] for n in rest]
    rows = x.transpose(*rest, *axes).reshape(int(np.prod(shape)), -1)
    return _array([functools.reduce(by, row) for row in rows], shape)


def _product(a: np.ndarray, b: np.ndarray, dimensions: Any) -> np.ndarray:
    (a_sum, b_sum), (a_each, b_each) = dimensions
    left, right = _arranged(a, a_each, a_sum), _arranged(b, b_each, b_sum)
    shape = [a.shape[n] for n in a_each]
    for x, both in ((a, {*a_each, *a_sum}), (b, {*b_each, *b_sum})):
        shape += [x.shape[n] for n in range(x.ndim) if n not in both]
    entries = [
        functools.reduce(lax.add, map(lax.mul, row, column))
        for rows, columns in zip(left, right, strict=True)
        for row in rows
        for column in columns
    ]
    return _array(entries, shape)


def _arranged(x: np.ndarray, each: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """The axes of a factor as (those of both, its own, those to sum over)."""
    own = [n for n in range(x.ndim) if n not in (*each, *summed)]
    sizes = [int(np.prod([x.shape[n] for n in axes])) for axes in (each, own, summed)]
    return x.transpose(*each, *own, *summed).reshape(sizes)


def _entries(x: Any) -> np.ndarray:
    x = np.asarray(x)
    return _array(list(x.flat), x.shape)


def _array(entries: Sequence[Any], shape: Sequence[int]) -> np.ndarray:
    result = np.empty(len(entries), object)
    for n, entry in enumerate(entries):  # all at once NumPy would look into them
        result[n] = entry
    return result.reshape(shape)
