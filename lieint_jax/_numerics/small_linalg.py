"""Linear algebra of small matrices: unrolled into scalars, with structural zeros, or on whole arrays.

A matrix is either unrolled, a `Matrix` of rows of entries, each an array scalar or a Python number that is known when
the program is traced, or whole, an array (n, n); a vector likewise. `+`, `-`, `*`, `@` and `.T` serve both: XLA fuses
the unrolled arithmetic over a batch, and arrays go to `jax.numpy`, which compiles faster where n is large.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from lieint_jax import _xla
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import AlgebraVector, DualVector, PyTree
from lieint_jax._numerics.vectors import is_constant, plus, times

Scalar = Any  # an array scalar, or a Python number
Vector = Any  # a `vectors.Vector` of scalars, or an array (n,)
Matrix = Any  # a `vectors.Matrix`, or an array (n, n)


def total(terms: Iterable[Scalar]) -> Scalar:
    return functools.reduce(plus, terms, 0.0)


def combination(*pairs: tuple[Scalar, Matrix]) -> Matrix:
    """Σ cA over pairs (c, A)."""
    return functools.reduce(operator.add, (c * A for c, A in pairs))


def map_entries(function: Callable[..., Scalar], *operands: Vector) -> Vector:
    """The function applied to the entries, one by one."""
    if any(_is_array(x) for x in operands):
        return function(*operands)
    return vectors.Vector(function(*entries) for entries in zip(*operands, strict=True))


def identity(like: Matrix) -> Matrix:
    n = len(like)
    if _is_array(like):
        return jnp.eye(n, dtype=like.dtype)
    return vectors.Matrix((float(i == j) for j in range(n)) for i in range(n))


def linear(C: np.ndarray, x: Vector) -> Vector | Matrix:
    """Σ_i C[..., i] x_i for constants C, shape (m, d) or (m, k, d): a vector or a matrix."""
    if _is_array(x):
        return jnp.asarray(C, x.dtype) @ x
    if C.ndim > 2:
        return vectors.Matrix(linear(c, x) for c in C)
    return vectors.Vector(total(times(float(c[i]), x[i]) for i in np.flatnonzero(c)) for c in C)


def quadratic(C: np.ndarray, x: Vector) -> Array:
    """Σ C[i, j] x_i x_j for constants C, (d, d): an array scalar, even where C vanishes."""
    terms = [(float(C[i, j]), x[i] * x[j]) for i, j in zip(*np.nonzero(C), strict=True)]
    return total(times(c, xx) for c, xx in terms) + 0 * x[0]


def flatten(A: Matrix) -> Vector:
    return A.reshape(-1) if _is_array(A) else vectors.Vector(itertools.chain.from_iterable(A))


def columns(linear: Callable[..., PyTree], n: int, dtype: DTypeLike) -> list[PyTree]:
    """The values of a linear function of n numbers at the unit vectors.

    Each is the derivative by one number, in which JAX writes no product with the zeros of the others.
    """
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)
    along = (lambda x, k=k: linear(*(x if i == k else zero for i in range(n))) for k in range(n))
    return [jax.jvp(column, (zero,), (one,))[1] for column in along]


def at_each(function: Callable[[Array], PyTree], s: Array) -> PyTree:
    """The function at a number s, or at each of several, (k,)."""
    return jax.vmap(function)(s) if s.ndim else function(s)


def inverse(A: Matrix) -> Matrix:
    """A⁻¹ of any invertible matrix: by cofactors if unrolled, by `jax.numpy` if whole."""
    if _is_array(A):
        return jnp.linalg.inv(A)
    adjugate, det = _adjugate(A)
    return 1 / det * adjugate


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
                if not (is_constant(entry) and entry == 0):
                    rest = minor(rows[1:], columns[:k] + columns[k + 1 :])
                    terms.append(times((-1.0) ** k, times(entry, rest)))
            minors[rows, columns] = total(terms)
        return minors[rows, columns]

    def indices_without(k: int) -> tuple[int, ...]:
        return tuple(i for i in range(n) if i != k)

    adjugate = vectors.Matrix(
        (times((-1.0) ** (i + j), minor(indices_without(j), indices_without(i))) for j in range(n)) for i in range(n)
    )
    return adjugate, vectors.dot(A[0], adjugate.T[0])


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
        inverted = materialized(1 / det * adjugate)
        minors = [K[0][0], det] if len(K) < 3 else [K[0][0], K[0][0] * K[1][1] - K[0][1] * K[1][0], det]
        positive = functools.reduce(jnp.logical_and, [jnp.asarray(minor) > 0 for minor in minors])
        return Factored(lambda b: inverted @ b, positive)
    k = (len(K) + 1) // 2
    A, B, C, D = (
        vectors.Matrix(row[j] for row in K[i]) for i in (slice(k), slice(k, None)) for j in (slice(k), slice(k, None))
    )
    first = factored(A)
    W = materialized(vectors.Matrix(first.solve(column) for column in B.T).T)  # A⁻¹B
    second = factored(materialized(D - C @ W))

    def solved(b: Vector) -> Vector:
        y = materialized(first.solve(vectors.Vector(b[:k])))
        z = materialized(second.solve(vectors.Vector(b[k:]) - C @ y))
        return vectors.Vector((*(y - W @ z), *z))

    return Factored(solved, first.positive & second.positive)


def materialized(A: Vector | Matrix) -> Vector | Matrix:
    """A with each entry computed once and held in memory, see `_xla.materialized`."""
    if _is_array(A):
        return A
    entries, structure = jax.tree.flatten(A)
    unknown = [x for x in entries if not is_constant(x)]
    if not unknown:
        return A
    once = iter(_xla.materialized(unknown))
    return structure.unflatten([x if is_constant(x) else next(once) for x in entries])


def unrolled(x: Array) -> Vector | Matrix:
    """An array (n,) or (n, m) as a vector or a matrix of its entries."""
    return vectors.vector(x) if x.ndim == 1 else vectors.matrix(x)


def as_array(x: Vector | Matrix, like: Array) -> Array:
    """A vector or matrix as an array, in the dtype of `like`."""
    if _is_array(x):
        return x
    if isinstance(x[0], Sequence):
        return as_array(flatten(x), like).reshape(len(x), len(x[0]))
    return jnp.stack([jnp.asarray(entry, like.dtype) for entry in x])


def flat(metric: Array, xi: AlgebraVector) -> DualVector:
    """ξ♭ = m ξ, for a metric m that is principal, (d,), or full, (d, d)."""
    _check_shape(metric, len(xi))
    return metric * xi if metric.ndim == 1 else as_array(unrolled(metric) @ unrolled(xi), xi)


def sharp(metric: Array, mu: DualVector) -> AlgebraVector:
    """μ♯ = m⁻¹ μ, for a metric as in `flat`."""
    _check_shape(metric, len(mu))
    if metric.ndim == 1:
        return mu / metric
    return as_array(solve(unrolled(metric), unrolled(mu)), mu)


def _check_shape(metric: Array, d: int) -> None:
    if metric.shape not in ((d,), (d, d)):
        raise ValueError(f"the metric of one system has shape ({d},) or ({d}, {d}), got {metric.shape}; use jax.vmap")


def _is_array(x: object) -> bool:
    return not isinstance(x, tuple | list)
