"""Primitives that act on each entry by itself, or only move entries.

The formulas of the first are the numbers of an entry ↦ that of the result. NumPy moves entries while the program is
written, and the program has nothing of it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax import lax

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Arrays, UnsupportedError, array_of
from lieint_jax.native._program import Value


def _integer_power(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype, *, y: int) -> Value:
    found, power = None, x[0]
    for bit in reversed(bin(abs(y))[2:]):
        if bit == "1":
            found = power if found is None else walk.number("mul", found, power)
        power = walk.number("mul", power, power)
    one = walk.builder.constant(1, dtype)
    found = one if found is None else found
    return walk.number("div", one, found) if y < 0 else found


def _select(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype) -> Value:
    which, cases = x[0], x[1:]
    if which.dtype == bool:
        return walk.select(which, cases[1], cases[0]) if len(cases) > 1 else cases[0]
    found = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        found = walk.select(walk.number("le", which, walk.builder.constant(k, which.dtype)), cases[k], found)
    return found


def _quotient(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype, op: str) -> Value:
    """A quotient or a remainder; that of integers by 0 and −1, where a CPU would trap, as XLA defines it."""
    if dtype.kind == "f":
        return walk.number(op, *x)
    a, b = x
    zero, one, ones = (walk.builder.constant(np.array(k).astype(dtype)) for k in (0, 1, -1))
    by_zero = walk.number("eq", b, zero)
    by_minus = walk.number("eq", b, ones) if dtype.kind == "i" else walk.builder.constant(False)
    found = walk.number(op, a, walk.select(walk.number("or", by_zero, by_minus), one, b))
    found = walk.select(by_minus, walk.number("neg", a) if op == "div" else zero, found)
    return walk.select(by_zero, ones if op == "div" else a, found)


def _shift(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype, op: str) -> Value:
    """A shift; for a shift by too many bits, or by a negative number, all bits are shifted out."""
    zero, last = (walk.builder.constant(k, dtype) for k in (0, 8 * dtype.itemsize - 1))
    inside = walk.number("and", walk.number("ge", x[1], zero), walk.number("le", x[1], last))
    found = walk.number(op, x[0], walk.select(inside, x[1], last))
    return found if op == "shift_right_arithmetic" else walk.select(inside, found, zero)


def _reduce_precision(
    walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype, *, exponent_bits: int, mantissa_bits: int
) -> Value:
    info = np.finfo(dtype)
    if (exponent_bits, mantissa_bits) != (info.nexp, info.nmant):
        raise UnsupportedError("reduce_precision")
    return x[0]


def _sign(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype) -> Value:
    if dtype.kind == "u":
        return walk.number("min", x[0], walk.builder.constant(1, dtype))
    zero, one, minus = (walk.builder.constant(k, dtype) for k in (0, 1, -1))
    below = walk.select(walk.number("lt", x[0], zero), minus, x[0])
    return walk.select(walk.number("gt", x[0], zero), one, below)


def _one_minus_square(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype) -> Value:
    one = walk.builder.constant(1, dtype)
    return walk.number("mul", walk.number("add", one, x[0]), walk.number("sub", one, x[0]))


def _polynomial(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype) -> Value:
    """Horner's rule; the coefficients begin with the constant."""
    at, *coefficients = x
    return functools.reduce(lambda y, c: walk.number("add", walk.number("mul", y, at), c), coefficients[::-1])


def _is_before(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype) -> Value:
    """Whether x₀ comes before x₁ in the order in which a NaN is the last, as in `jnp.searchsorted`."""
    last = walk.number("and", walk.number("eq", x[0], x[0]), walk.number("ne", x[1], x[1]))
    return walk.number("or", walk.number("lt", *x), last)


def _operation(walk: AbstractWalk, x: Sequence[Value], dtype: np.dtype, op: str) -> Value:
    return walk.number(op, *x, dtype=dtype)


_ROUNDINGS = {
    lax.RoundingMethod.AWAY_FROM_ZERO: "round_away",
    lax.RoundingMethod.TO_NEAREST_EVEN: "round_even",
}
_OPERATIONS = (  # of programs, which JAX calls by the same names
    "acos acosh add and asin asinh atan atan2 atanh cbrt ceil cos cosh eq exp exp2 expm1 floor ge gt le log log1p "
    "logistic lt max min mul ne neg not or sin sinh sqrt sub tan tanh xor"
)
ELEMENTWISE: dict[str, Callable[..., Value]] = {
    name: functools.partial(_operation, op=name) for name in _OPERATIONS.split()
} | {
    "abs": lambda walk, x, dtype: x[0] if dtype.kind == "u" else walk.number("abs", x[0]),
    "add_any": functools.partial(_operation, op="add"),
    "clamp": lambda walk, x, dtype: walk.number("min", walk.number("max", x[1], x[0]), x[2]),
    "convert_element_type": lambda walk, x, dtype, *, new_dtype: walk.number("convert", x[0], dtype=dtype),
    "copy": lambda walk, x, dtype: x[0],
    "copy_p": lambda walk, x, dtype: x[0],
    "div": functools.partial(_quotient, op="div"),
    "integer_pow": _integer_power,
    "is_finite": lambda walk, x, dtype: walk.number(
        "lt", walk.number("abs", x[0]), walk.builder.constant(np.inf, x[0].dtype)
    ),
    "log2": lambda walk, x, dtype: walk.number(
        "mul", walk.number("log", x[0]), walk.builder.constant(1 / np.log(2.0), dtype)
    ),
    "lt_to": _is_before,
    "name": lambda walk, x, dtype, *, name: x[0],
    "once": lambda walk, x, dtype: x[0],
    "one_minus_square": _one_minus_square,
    "polynomial": _polynomial,
    "pow": lambda walk, x, dtype: walk.number("pow", x[0], walk.number("convert", x[1], dtype=dtype)),
    "reduce_precision": _reduce_precision,
    "rem": functools.partial(_quotient, op="rem"),
    "round": lambda walk, x, dtype, *, rounding_method: walk.number(_ROUNDINGS[rounding_method], x[0]),
    "rsqrt": lambda walk, x, dtype: walk.number("div", walk.builder.constant(1, dtype), walk.number("sqrt", x[0])),
    "select_n": _select,
    "shift_left": functools.partial(_shift, op="shift_left"),
    "shift_right_arithmetic": functools.partial(_shift, op="shift_right_arithmetic"),
    "shift_right_logical": functools.partial(_shift, op="shift_right_logical"),
    "sign": _sign,
    "square": lambda walk, x, dtype: walk.number("mul", x[0], x[0]),
    "stop_gradient": lambda walk, x, dtype: x[0],
}


def _broadcast_in_dim(x: np.ndarray, *, shape: Sequence[int], broadcast_dimensions: Sequence[int]) -> np.ndarray:
    sizes = [1] * len(shape)
    for axis, n in zip(broadcast_dimensions, x.shape, strict=True):
        sizes[axis] = n
    return np.broadcast_to(x.reshape(sizes), shape)


def _slice(
    x: np.ndarray, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None = None
) -> np.ndarray:
    return x[tuple(itertools.starmap(slice, zip(start_indices, limit_indices, strides or (1,) * x.ndim, strict=True)))]


def _pad(x: np.ndarray, value: np.ndarray, padding_config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    shape = [lo + hi + max(n + (n - 1) * gap, 0) for n, (lo, hi, gap) in zip(x.shape, padding_config, strict=True)]
    found = array_of([value.item()] * int(np.prod(shape)), shape)
    places = [lo + np.arange(n) * (gap + 1) for n, (lo, _, gap) in zip(x.shape, padding_config, strict=True)]
    inside = [(at >= 0) & (at < n) for at, n in zip(places, shape, strict=True)]
    found[np.ix_(*(at[which] for at, which in zip(places, inside, strict=True)))] = x[np.ix_(*inside)]
    return found


def stack(*arrays: np.ndarray, axis: int = 0) -> np.ndarray:
    """Arrays along a new axis."""
    return np.concatenate([np.expand_dims(x, axis) for x in arrays], axis)


def _unstack(x: np.ndarray, axis: int) -> Arrays:
    return [array_of(list(y.flat), y.shape) for y in (x.take([k], axis).squeeze(axis) for k in range(x.shape[axis]))]


MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, dimensions),
    "pad": _pad,
    "reshape": lambda x, new_sizes, dimensions=None: x.transpose(dimensions or range(x.ndim)).reshape(new_sizes),
    "reshard": lambda x, dst_sharding: x,
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "stack": stack,
    "tile": lambda x, reps: np.tile(x, reps),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "unstack": _unstack,
}
