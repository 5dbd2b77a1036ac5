"""Arithmetic of small matrices of any size: entry by entry with structural zeros, or whole.

A matrix is either a list of rows of entries, each an array scalar or a Python number that is known when the program is
traced, or an array (n, n); a vector likewise. Lists are worked out entry by entry: XLA fuses that over a batch, and
what is multiplied by a known 0 or 1 costs nothing. Arrays go to the library, which compiles faster where n is large.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

Scalar = Any  # an array scalar, or a Python number
Vector = Any  # a list of scalars, or an array (n,)
Matrix = Any  # a list of rows, or an array (n, n)


def times(a: Scalar, b: Scalar) -> Scalar:
    for x, y in ((a, b), (b, a)):
        if _known(x) and x in (0, 1, -1):
            return 0.0 if x == 0 else y if x == 1 else -y
    return a * b


def total(terms: Iterable[Scalar]) -> Scalar:
    sum_ = 0.0
    for term in terms:
        if not (_known(term) and term == 0):
            sum_ = term if _known(sum_) and sum_ == 0 else sum_ + term
    return sum_


def dot(a: Vector, b: Vector) -> Scalar:
    if _whole(a) and _whole(b):
        return a @ b
    return total(times(x, y) for x, y in zip(a, b, strict=True))


def matvec(A: Matrix, x: Vector) -> Vector:
    if _whole(A):
        return A @ as_array(x, A)
    return [dot(row, x) for row in A]


def matmul(A: Matrix, B: Matrix) -> Matrix:
    if _whole(A) or _whole(B):
        return A @ B
    columns = transpose(B)
    return [[dot(row, column) for column in columns] for row in A]


def transpose(A: Matrix) -> Matrix:
    return A.T if _whole(A) else [list(column) for column in zip(*A, strict=True)]


def combination(*pairs: tuple[Scalar, Matrix]) -> Matrix:
    """Σ cA over pairs (c, A)."""
    if any(_whole(A) for _, A in pairs):
        return sum((c * A for c, A in pairs[1:]), pairs[0][0] * pairs[0][1])
    n, m = len(pairs[0][1]), len(pairs[0][1][0])
    return [[total(times(c, A[i][j]) for c, A in pairs) for j in range(m)] for i in range(n)]


def identity(like: Matrix) -> Matrix:
    n = len(like)
    return jnp.eye(n, dtype=like.dtype) if _whole(like) else [[float(i == j) for j in range(n)] for i in range(n)]


def linear(C: np.ndarray, x: Vector) -> Any:
    """Σ_i C[..., i] x_i for constants C, shape (m, d) or (m, k, d): a vector or a matrix."""
    if _whole(x):
        return jnp.asarray(C, x.dtype) @ x
    if C.ndim > 2:
        return [linear(c, x) for c in C]
    return [total(times(float(c[i]), x[i]) for i in np.flatnonzero(c)) for c in C]


def flatten(A: Matrix) -> Vector:
    return A.reshape(-1) if _whole(A) else list(itertools.chain.from_iterable(A))


def inverse(A: Matrix) -> Matrix:
    """A⁻¹, of any invertible matrix: by cofactors entry by entry, by the library if whole."""
    if _whole(A):
        return jnp.linalg.inv(A)
    adjugate, det = _adjugate(A)
    r = 1 / det
    return [[times(r, entry) for entry in row] for row in adjugate]


def _adjugate(A: Matrix) -> tuple[Matrix, Scalar]:
    """adj A and det A by cofactors."""
    n, minors = len(A), {}

    def minor(rows: tuple[int, ...], columns: tuple[int, ...]) -> Scalar:
        if not rows:
            return 1.0
        if (rows, columns) not in minors:
            terms = []
            for k, j in enumerate(columns):
                entry = A[rows[0]][j]
                if not (_known(entry) and entry == 0):
                    rest = minor(rows[1:], columns[:k] + columns[k + 1 :])
                    terms.append(times((-1.0) ** k, times(entry, rest)))
            minors[rows, columns] = total(terms)
        return minors[rows, columns]

    def without(k: int) -> tuple[int, ...]:
        return tuple(i for i in range(n) if i != k)

    adjugate = [[times((-1.0) ** (i + j), minor(without(j), without(i))) for j in range(n)] for i in range(n)]
    return adjugate, dot(A[0], [row[0] for row in adjugate])


def solve(K: Matrix, b: Vector) -> Vector:
    """K⁻¹b, see `inverse_definite`."""
    return matvec(inverse_definite(K), b)


def inverse_definite(K: Matrix) -> Matrix:
    """K⁻¹ by elimination without pivoting: for K with a positive definite symmetric part, or near such a matrix.

    The matrices here are a metric less a nearly skew matrix, where no pivot can vanish and none is small. Lists are
    halved, so that there are two divisions for up to six unknowns: XLA stops fusing at a division.
    """
    d, k = len(K), (len(K) + 1) // 2
    if _whole(K):
        return jnp.linalg.inv(K)
    if d <= 3:
        return inverse(K)
    rows = settled(K)
    A, B = [row[:k] for row in rows[:k]], [row[k:] for row in rows[:k]]
    C, D = [row[:k] for row in rows[k:]], [row[k:] for row in rows[k:]]
    P = settled(inverse_definite(A))
    W, V = settled(matmul(P, B)), settled(matmul(C, P))
    S = settled(inverse_definite(settled(combination((1.0, D), (-1.0, matmul(C, W))))))
    X = settled(matmul(W, S))
    upper = [
        [*p, *(times(-1.0, x) for x in q)] for p, q in zip(combination((1.0, P), (1.0, matmul(X, V))), X, strict=True)
    ]
    lower = [[*(times(-1.0, x) for x in p), *q] for p, q in zip(matmul(S, V), S, strict=True)]
    return settled(upper + lower)


def determinant(K: Matrix) -> Scalar:
    """det K, of a matrix as `inverse_definite` takes it."""
    if _whole(K):
        return jnp.linalg.det(K)
    d, k = len(K), (len(K) + 1) // 2
    if d <= 3:
        return _adjugate(K)[1]
    rows = settled(K)
    A, B = [row[:k] for row in rows[:k]], [row[k:] for row in rows[:k]]
    C, D = [row[:k] for row in rows[k:]], [row[k:] for row in rows[k:]]
    W = settled(matmul(inverse_definite(A), B))
    return times(determinant(A), determinant(combination((1.0, D), (-1.0, matmul(C, W)))))


def settled(A: list[list[Scalar]]) -> list[list[Scalar]]:
    """The same, held in memory: else XLA works out what is shared once for every entry that needs it."""
    return as_list(lax.optimization_barrier(as_array(A, total(flatten(A)))))


def as_list(x: Array) -> Any:
    """The entries of an array (n,) or (n, m), as lists."""
    return [x[i] if x.ndim == 1 else [x[i, j] for j in range(x.shape[1])] for i in range(x.shape[0])]


def as_array(x: Vector | Matrix, like: Array) -> Array:
    """The array of a vector or matrix, in the dtype of `like`."""
    if _whole(x):
        return x
    if isinstance(x[0], Sequence):
        n, m = len(x), len(x[0])
        return as_array(flatten(x), like).reshape(n, m)
    return jnp.stack([jnp.asarray(entry, like.dtype) for entry in x])


def _known(x: Scalar) -> bool:
    return isinstance(x, int | float)


def _whole(x: Any) -> bool:
    return not isinstance(x, list)
