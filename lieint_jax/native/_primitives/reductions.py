"""Sums, products and extremes along axes. A sum is taken in the order of its terms, so its bits are always the same."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.typing import DTypeLike

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Arrays, UnsupportedError, array_of, row_number
from lieint_jax.native._program import Value


def _reduction(op: str) -> Callable[..., np.ndarray]:
    def reduce(walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, axes: Sequence[int]) -> np.ndarray:
        x = inputs[0]
        rest, d = [n for n in range(x.ndim) if n not in axes], walk.long_axis(x.shape)
        reduced = functools.partial(reduce_terms, walk, op, dtype=np.dtype(out.dtype))
        if d is None or d not in axes:
            terms = x.transpose(*rest, *axes).reshape(int(np.prod(out.shape)), int(np.prod([x.shape[n] for n in axes])))
            return array_of([reduced(list(each)) for each in terms], out.shape)
        terms = x.transpose(*rest, d, *(n for n in axes if n != d)).reshape(int(np.prod(out.shape)), x.shape[d], -1)

        def next_totals(carry: list[Value]) -> list[Value]:
            k, *totals = carry
            rows = [[row_number(walk, list(column), k) for column in each.T] for each in terms]
            after = [reduced([total, *row]) for total, row in zip(totals, rows, strict=True)]
            return [walk.offset(k, 1), *after]

        first = [reduced(list(each[0])) for each in terms]
        end = walk.index(terms.shape[1])
        found = walk.builder.loop([walk.index(1), *first], lambda c: walk.number("lt", c[0], end), next_totals)
        return array_of(found[1:], out.shape)

    return reduce


def reduce_terms(walk: AbstractWalk, op: str, terms: list[Value], dtype: np.dtype) -> Value:
    """x₁ ∘ x₂ ∘ …, from the left; of no terms, what a reduction by this operation starts from."""
    if terms:
        return functools.reduce(lambda x, y: walk.number(op, x, y), terms)
    low, high = (-np.inf, np.inf) if dtype.kind == "f" else (False, True)
    if dtype.kind in "iu":
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    starts = {"add": 0, "mul": 1, "max": low, "min": high, "and": np.array(-1).astype(dtype), "or": 0, "xor": 0}
    return walk.builder.constant(starts[op], dtype)


def _cumulative(op: str) -> Callable[..., np.ndarray]:
    def cumulate(walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, axis: int, reverse: bool) -> np.ndarray:
        x = np.moveaxis(inputs[0], axis, 0)
        found = np.empty(x.shape, object)
        order = range(len(x))[::-1] if reverse else range(len(x))
        for index in np.ndindex(x.shape[1:]):
            total = None
            for k in order:
                term = x[k, *index]
                total = found[k, *index] = term if total is None else walk.number(op, total, term)
        return np.moveaxis(found, 0, axis)

    return cumulate


def _product(
    walk: AbstractWalk,
    inputs: Arrays,
    out: ShapedArray,
    *,
    dimension_numbers: lax.DotDimensionNumbers,
    precision: object = None,
    preferred_element_type: DTypeLike | None = None,
) -> np.ndarray:
    """Sums of products; `out` has the preferred type, and a CPU has no less precision than that of the types."""
    if precision is not None and not all(isinstance(x, lax.Precision) for x in jax.tree.leaves(precision)):
        raise UnsupportedError(f"a product of precision {precision}")
    a, b = inputs
    (a_sum, b_sum), (a_each, b_each) = dimension_numbers
    left, right = _as_matrices(a, a_each, a_sum), _as_matrices(b, b_each, b_sum)
    dtype, entries = np.dtype(out.dtype), []
    for rows, columns in zip(left, right, strict=True):
        for row, column in itertools.product(rows, columns):
            factors = ([walk.number("convert", x, dtype=dtype) for x in pair] for pair in zip(row, column, strict=True))
            entries.append(reduce_terms(walk, "add", [walk.number("mul", *pair) for pair in factors], dtype))
    return array_of(entries, out.shape)


def _as_matrices(x: np.ndarray, each: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """The axes of a factor as (those of both, its own, those to sum over)."""
    own = [n for n in range(x.ndim) if n not in (*each, *summed)]
    sizes = [int(np.prod([x.shape[n] for n in axes])) for axes in (each, own, summed)]
    return x.transpose(*each, *own, *summed).reshape(sizes)


def _extreme(by: str) -> Callable[..., np.ndarray]:
    def index_of(
        walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, axes: Sequence[int], index_dtype: DTypeLike
    ) -> np.ndarray:
        [axis] = axes
        rows = np.moveaxis(inputs[0], axis, -1).reshape(-1, inputs[0].shape[axis])
        found = []
        for row in rows:
            best, at = row[0], walk.builder.constant(0, out.dtype)
            for k in range(1, len(row)):
                better = is_beyond(walk, by, row[k], best)
                at = walk.select(better, walk.builder.constant(k, out.dtype), at)
                best = walk.select(better, row[k], best)
            found.append(at)
        return array_of(found, out.shape)

    return index_of


def is_beyond(walk: AbstractWalk, by: str, x: Value, y: Value) -> Value:
    """Whether x is greater than y, or less, by an operation; NaN is beyond all numbers."""
    found = walk.number(by, x, y)
    if x.dtype.kind != "f":
        return found
    return walk.number("or", found, walk.number("and", walk.number("ne", x, x), walk.number("eq", y, y)))


REDUCTIONS: dict[str, Callable[..., np.ndarray]] = {
    "argmax": _extreme("gt"),
    "argmin": _extreme("lt"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
    "cumprod": _cumulative("mul"),
    "cumsum": _cumulative("add"),
    "dot_general": _product,
    "reduce_and": _reduction("and"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_or": _reduction("or"),
    "reduce_prod": _reduction("mul"),
    "reduce_sum": _reduction("add"),
    "reduce_xor": _reduction("xor"),
}
