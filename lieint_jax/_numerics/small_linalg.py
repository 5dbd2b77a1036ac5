"""Arithmetic of small matrices: unrolled into scalars, with structural zeros, or on whole arrays.

A matrix is either unrolled, a list of rows of entries, each an array scalar or a Python number that is known when the
program is traced, or whole, an array (n, n); a vector likewise. Arithmetic on lists is written out entry by entry: XLA
fuses it over a batch, and a product with a known 0 or 1 costs nothing. Arrays go to `jax.numpy`, which compiles faster
where n is large.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from lieint_jax import _xla
from lieint_jax._numerics import vec3
from lieint_jax.types.shapes import PyTree

Scalar = Any  # an array scalar, or a Python number
Vector = Any  # a list of scalars, or an array (n,)
Matrix = Any  # a list of rows, or an array (n, n)


def times(a: Scalar, b: Scalar) -> Scalar:
    for x, y in ((a, b), (b, a)):
        if _is_constant(x) and x in (0, 1, -1):
            return 0.0 if x == 0 else y if x == 1 else -y
    return a * b


def total(terms: Iterable[Scalar]) -> Scalar:
    sum_ = 0.0
    for term in terms:
        if not (_is_constant(term) and term == 0):
            sum_ = term if _is_constant(sum_) and sum_ == 0 else sum_ + term
    return sum_


def dot(a: Vector, b: Vector) -> Scalar:
    if _is_array(a) and _is_array(b):
        return a @ b
    return total(times(x, y) for x, y in zip(a, b, strict=True))


def matvec(A: Matrix, x: Vector) -> Vector:
    if _is_array(A):
        return A @ as_array(x, A)
    return [dot(row, x) for row in A]


def matmul(A: Matrix, B: Matrix) -> Matrix:
    if _is_array(A) or _is_array(B):
        return A @ B
    columns = transpose(B)
    return [[dot(row, column) for column in columns] for row in A]


def transpose(A: Matrix) -> Matrix:
    return A.T if _is_array(A) else [list(column) for column in zip(*A, strict=True)]


def combination(*pairs: tuple[Scalar, Matrix]) -> Matrix:
    """Σ cA over pairs (c, A)."""
    if any(_is_array(A) for _, A in pairs):
        return sum((c * A for c, A in pairs[1:]), pairs[0][0] * pairs[0][1])
    n, m = len(pairs[0][1]), len(pairs[0][1][0])
    return [[total(times(c, A[i][j]) for c, A in pairs) for j in range(m)] for i in range(n)]


def plus(*terms: Vector | tuple[Scalar, Vector]) -> Vector:
    """Σ cx over vectors x and pairs (c, x)."""
    pairs = [term if isinstance(term, tuple) else (1.0, term) for term in terms]
    if any(_is_array(x) for _, x in pairs):
        return sum((c * x for c, x in pairs[1:]), pairs[0][0] * pairs[0][1])
    rows = zip(*(x for _, x in pairs), strict=True)
    return [total(times(c, x) for (c, _), x in zip(pairs, row, strict=True)) for row in rows]


def scaled(c: Scalar, x: Vector) -> Vector:
    """cx."""
    return c * x if _is_array(x) else [times(c, entry) for entry in x]


def map_entries(function: Callable[..., Scalar], *vectors: Vector) -> Vector:
    """The function applied to the entries, one by one."""
    if any(_is_array(x) for x in vectors):
        return function(*vectors)
    return [function(*entries) for entries in zip(*vectors, strict=True)]


def identity(like: Matrix) -> Matrix:
    n = len(like)
    return jnp.eye(n, dtype=like.dtype) if _is_array(like) else [[float(i == j) for j in range(n)] for i in range(n)]


def linear(C: np.ndarray, x: Vector) -> Vector | Matrix:
    """Σ_i C[..., i] x_i for constants C, shape (m, d) or (m, k, d): a vector or a matrix."""
    if _is_array(x):
        return jnp.asarray(C, x.dtype) @ x
    if C.ndim > 2:
        return [linear(c, x) for c in C]
    return [total(times(float(c[i]), x[i]) for i in np.flatnonzero(c)) for c in C]


def quadratic(C: np.ndarray, x: Vector) -> Array:
    """Σ C[i, j] x_i x_j for constants C, (d, d): an array scalar, even where C vanishes."""
    terms = [(float(C[i, j]), x[i] * x[j]) for i, j in zip(*np.nonzero(C), strict=True)]
    return total(times(c, xx) for c, xx in terms) + 0 * x[0]


def flatten(A: Matrix) -> Vector:
    return A.reshape(-1) if _is_array(A) else list(itertools.chain.from_iterable(A))


def columns(linear: Callable[..., PyTree], n: int, dtype: DTypeLike) -> list[PyTree]:
    """The values of a linear function of n numbers at the unit vectors.

    Each is the derivative by one number, in which JAX writes no product with the zeros of the others.
    """
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)

    def column(k: int) -> Callable[[Array], PyTree]:
        return lambda x: linear(*(x if i == k else zero for i in range(n)))

    return [jax.jvp(column(k), (zero,), (one,))[1] for k in range(n)]


def at_each(function: Callable[[Array], PyTree], s: Array) -> PyTree:
    """The function at a number s, or at each of several, (k,)."""
    return jax.vmap(function)(s) if s.ndim else function(s)


def inverse(A: Matrix) -> Matrix:
    """A⁻¹ of any invertible matrix: by cofactors if unrolled, by `jax.numpy` if whole."""
    if _is_array(A):
        return jnp.linalg.inv(A)
    adjugate, det = _adjugate(A)
    r = 1 / det
    return [[times(r, entry) for entry in row] for row in adjugate]


def determinant(A: Matrix) -> Scalar:
    """det A: by cofactors if unrolled, by `jax.numpy` if whole."""
    return jnp.linalg.det(A) if _is_array(A) else _adjugate(A)[1]


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
                if not (_is_constant(entry) and entry == 0):
                    rest = minor(rows[1:], columns[:k] + columns[k + 1 :])
                    terms.append(times((-1.0) ** k, times(entry, rest)))
            minors[rows, columns] = total(terms)
        return minors[rows, columns]

    def indices_without(k: int) -> tuple[int, ...]:
        return tuple(i for i in range(n) if i != k)

    adjugate = [
        [times((-1.0) ** (i + j), minor(indices_without(j), indices_without(i))) for j in range(n)] for i in range(n)
    ]
    return adjugate, dot(A[0], [row[0] for row in adjugate])


class Factored(NamedTuple):
    """A factored matrix K.

    Attributes:
        solve: b ↦ K⁻¹b.
        positive: whether elimination without pivoting meets positive pivots only: det K > 0, and no two eigenvalues
            have become negative together. For an array, whether its symmetric part is positive definite.
    """

    solve: Callable[[Vector], Vector]
    positive: Array


def solve(K: Matrix, b: Vector) -> Vector:
    """K⁻¹b, see `factored`."""
    return factored(K).solve(b)


def factored(K: Matrix) -> Factored:
    """Elimination without pivoting: for K with a positive definite symmetric part, or near such a matrix.

    The matrices of schemes are a metric less a nearly skew matrix, so that no pivot vanishes or is small. Unrolled
    matrices are cut into 2×2 blocks, so that up to six unknowns need two divisions: XLA stops fusing at a division.
    """
    if _is_array(K):
        inverted = jnp.linalg.inv(K)
        pivots = jnp.diagonal(jnp.linalg.cholesky(lax.stop_gradient(K + K.T)))  # NaN if there is no such factor
        return Factored(lambda b: inverted @ as_array(b, K), jnp.all(pivots > 0))
    if len(K) <= 3:
        adjugate, det = _adjugate(K)
        r = 1 / det
        inverted = materialized([[times(r, entry) for entry in row] for row in adjugate])
        minors = [K[0][0], det] if len(K) < 3 else [K[0][0], K[0][0] * K[1][1] - K[0][1] * K[1][0], det]
        positive = functools.reduce(jnp.logical_and, [jnp.asarray(minor) > 0 for minor in minors])
        return Factored(lambda b: matvec(inverted, b), positive)
    k = (len(K) + 1) // 2
    B, C, D = [row[k:] for row in K[:k]], [row[:k] for row in K[k:]], [row[k:] for row in K[k:]]
    first = factored([row[:k] for row in K[:k]])
    W = materialized(transpose([first.solve(column) for column in transpose(B)]))  # A⁻¹B
    second = factored(materialized(combination((1.0, D), (-1.0, matmul(C, W)))))

    def solved(b: Vector) -> Vector:
        y = materialized(first.solve(b[:k]))
        z = materialized(second.solve([u - v for u, v in zip(b[k:], matvec(C, y), strict=True)]))
        return [u - v for u, v in zip(y, matvec(W, z), strict=True)] + z

    return Factored(solved, first.positive & second.positive)


def eliminate(A: Sequence[Sequence[Scalar]], *right: Sequence[Scalar]) -> list[list[Scalar]]:
    """A⁻¹b for several right-hand sides b at once, unrolled, by Gaussian elimination without pivoting.

    Over a batch it is 4 times faster than `jnp.linalg.solve` at 9×9, and inside `schemes.additive` 1.17 times faster
    than `factored`. Meant for Newton's method: a small pivot costs digits of a correction, which the next one restores.
    """
    n = len(A)
    M = [[*row, *(b[i] for b in right)] for i, row in enumerate(A)]
    for k in range(n):
        r = 1 / M[k][k]
        for i in range(k + 1, n):
            f = r * M[i][k]
            M[i][k + 1 :] = [x - f * y for x, y in zip(M[i][k + 1 :], M[k][k + 1 :], strict=True)]
    solutions = []
    for column in range(n, n + len(right)):
        x: list[Scalar] = []
        for i in reversed(range(n)):
            known = sum(m * v for m, v in zip(M[i][i + 1 : n], x, strict=True))
            x.insert(0, (M[i][column] - known) / M[i][i])
        solutions.append(x)
    return solutions


def materialized(A: Vector | Matrix) -> Vector | Matrix:
    """A with each entry computed once and held in memory, see `_xla.materialized`."""
    if _is_array(A):
        return A
    rows = A if isinstance(A[0], list) else [A]
    unknown = [x for x in flatten(rows) if not _is_constant(x)]
    if not unknown:
        return A
    once = iter(_xla.materialized(unknown))
    held = [[x if _is_constant(x) else next(once) for x in row] for row in rows]
    return held if isinstance(A[0], list) else held[0]


def as_list(x: Array) -> Vector | Matrix:
    """An array (n,) or (n, m) as a list of its entries."""
    return [*vec3.components(x)] if x.ndim == 1 else [[x[i, j] for j in range(x.shape[1])] for i in range(x.shape[0])]


def as_array(x: Vector | Matrix, like: Array) -> Array:
    """A vector or matrix as an array, in the dtype of `like`."""
    if _is_array(x):
        return x
    if isinstance(x[0], Sequence):
        n, m = len(x), len(x[0])
        return as_array(flatten(x), like).reshape(n, m)
    return jnp.stack([jnp.asarray(entry, like.dtype) for entry in x])


def _is_constant(x: Scalar) -> bool:
    return isinstance(x, int | float)


def _is_array(x: object) -> bool:
    return not isinstance(x, list)
