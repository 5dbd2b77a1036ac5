"""Factorizations of small matrices, triangular systems, and sorting, by which `jax.numpy` inverts a permutation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Arrays, Shapes, UnsupportedError, array_of
from lieint_jax.native._primitives.reductions import is_beyond
from lieint_jax.native._program import Value

_LARGEST = 12  # unknowns of a system, and entries to sort; XLA runs what is larger


def _lu(walk: AbstractWalk, inputs: Arrays, out: Shapes) -> Arrays:
    """Gaussian elimination with the largest pivot of each column: L below U, the rows swapped with, and their order."""
    found = [np.empty(x.shape, object) for x in out]
    for batch in _batches(inputs[0], 2):
        A = inputs[0][batch].copy()
        rows, columns = A.shape
        order = array_of([walk.builder.constant(k, out[2].dtype) for k in range(rows)], (rows,))
        for k in range(min(A.shape)):
            found[1][*batch, k] = _swap_with_largest(walk, A, order, k, out[1].dtype)
            singular = walk.number("eq", A[k, k], walk.builder.constant(0, A[k, k].dtype))
            r = _reciprocal(walk, walk.select(singular, walk.builder.constant(1, A[k, k].dtype), A[k, k]))
            for i in range(k + 1, rows):
                A[i, k] = walk.number("mul", A[i, k], r)
                for j in range(k + 1, columns):
                    A[i, j] = _less_product(walk, A[i, j], A[i, k], A[k, j])
        found[0][batch], found[2][batch] = A, order
    return found


def _swap_with_largest(walk: AbstractWalk, A: np.ndarray, order: np.ndarray, k: int, dtype: np.dtype) -> Value:
    """Swap row k with the row at or below it whose entry of column k is the largest; returns the place of that row."""
    place = walk.builder.constant(k, dtype)
    row, number, largest = A[k], order[k], walk.number("abs", A[k, k])
    for i in range(k + 1, len(A)):
        size = walk.number("abs", A[i, k])
        larger = walk.number("gt", size, largest)
        largest, place = walk.select(larger, size, largest), walk.select(larger, walk.builder.constant(i, dtype), place)
        row, number = walk.select(larger, A[i], row), walk.select(larger, order[i], number)
    for i in range(k + 1, len(A)):
        here = walk.number("eq", place, walk.builder.constant(i, dtype))
        A[i], order[i] = walk.select(here, A[k], A[i]), walk.select(here, order[k], order[i])
    A[k], order[k] = row, number
    return place


def _triangular_solve(
    walk: AbstractWalk,
    inputs: Arrays,
    out: Shapes,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    conjugate_a: bool,
    unit_diagonal: bool,
) -> Arrays:
    """A X = B, or X A = B, which is Aᵀ Xᵀ = Bᵀ. Real numbers are their conjugates."""
    found = np.empty(out[0].shape, object)
    for batch in _batches(found, 2):
        A, X = inputs[0][batch], inputs[1][batch].copy()
        A, X = (A.T if transpose_a == left_side else A), (X if left_side else X.T)
        first_to_last = (lower != transpose_a) == left_side
        order = range(len(A)) if first_to_last else range(len(A))[::-1]
        for n, i in enumerate(order):
            r = None if unit_diagonal else _reciprocal(walk, A[i, i])
            for column in X.T:
                for j in order[:n]:
                    column[i] = _less_product(walk, column[i], A[i, j], column[j])
                if r is not None:
                    column[i] = walk.number("mul", column[i], r)
        found[batch] = X if left_side else X.T
    return [found]


def _cholesky(walk: AbstractWalk, inputs: Arrays, out: Shapes) -> Arrays:
    """L of L Lᵀ; NaN if the matrix is not positive definite."""
    found = np.empty(out[0].shape, object)
    zero, nan = (walk.builder.constant(x, out[0].dtype) for x in (0, np.nan))
    for batch in _batches(found, 2):
        L, failed = inputs[0][batch].copy(), walk.builder.constant(False)
        for k in range(len(L)):
            failed = walk.number("or", failed, walk.number("le", L[k, k], zero))
            L[k, k] = walk.number("sqrt", L[k, k])
            r = _reciprocal(walk, L[k, k])
            for i in range(k + 1, len(L)):
                L[k, i], L[i, k] = zero, walk.number("mul", L[i, k], r)
                for j in range(k + 1, i + 1):
                    L[i, j] = _less_product(walk, L[i, j], L[i, k], L[j, k])
        found[batch] = array_of([walk.select(failed, nan, x) for x in L.flat], L.shape)
    return [found]


def _sort(walk: AbstractWalk, inputs: Arrays, out: Shapes, *, dimension: int, is_stable: bool, num_keys: int) -> Arrays:
    """By swaps of neighbors, which keep the order of equal entries; NaN comes last."""
    if num_keys != 1:
        raise UnsupportedError(f"a sort by {num_keys} keys")
    found = [np.moveaxis(x, dimension, -1).copy() for x in inputs]
    for batch in _batches(found[0], 1):
        columns = [x[batch] for x in found]
        for last in range(len(columns[0]) - 1, 0, -1):
            for k in range(last):
                swap = is_beyond(walk, "gt", columns[0][k], columns[0][k + 1])
                for x in columns:
                    x[k], x[k + 1] = walk.select(swap, x[k + 1], x[k]), walk.select(swap, x[k], x[k + 1])
    return [np.moveaxis(x, -1, dimension) for x in found]


def _batches(x: np.ndarray, axes: int) -> list[tuple[int, ...]]:
    """The indices of the leading axes; the last `axes` are those of one matrix or vector."""
    shape = x.shape[x.ndim - axes :]
    if max(shape) > _LARGEST:
        raise UnsupportedError(f"linear algebra, or a sort, of shape {shape}")
    return list(np.ndindex(x.shape[: x.ndim - axes]))


def _reciprocal(walk: AbstractWalk, x: Value) -> Value:
    return walk.number("div", walk.builder.constant(1, x.dtype), x)


def _less_product(walk: AbstractWalk, x: Value, y: Value, z: Value) -> Value:
    return walk.number("sub", x, walk.number("mul", y, z))


LINEAR_ALGEBRA: dict[str, Callable[..., list[Any]]] = {
    "cholesky": _cholesky,
    "lu": _lu,
    "sort": _sort,
    "triangular_solve": _triangular_solve,
}
