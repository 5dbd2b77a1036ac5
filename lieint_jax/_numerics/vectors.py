"""Vectors, matrices and symmetric tensors of scalars, with the operators of mathematics.

XLA fuses scalar arithmetic over a batch into vector loops; `@`, `einsum` and `jnp.linalg` on small arrays become calls
that it cannot fuse. So a `Vector` here is a tuple of scalars, a `Matrix` one of rows, and a `Symmetric`, 3×3, holds its
distinct entries: 3 of them if it is diagonal, 6 if it is full. `+`, `-`, `*`, `/` and `@` write out the arithmetic of
the entries, and a product with an entry that is the Python number 0 or ±1 costs nothing. Each is a pytree.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any, Self

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import DTypeLike

Scalar = Any  # an array of one number, or a Python number
VectorLike = Any  # three components: a Vector, an Array (3,) or a tuple of scalars
PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # which entries a full Symmetric holds


def times(a: Scalar, b: Scalar) -> Scalar:
    """ab of scalars; a factor that is known to be 0 or ±1 is not multiplied."""
    for x, y in ((a, b), (b, a)):
        if is_constant(x) and x in (0, 1, -1):
            return 0.0 if x == 0 else y if x == 1 else -y
    return a * b


def plus(a: Scalar, b: Scalar) -> Scalar:
    """a + b of scalars, of which a known 0 is not added."""
    return b if _is_zero(a) else a if _is_zero(b) else a + b


def is_constant(x: object) -> bool:
    """Whether a scalar is a Python number, known when the program is traced."""
    return isinstance(x, int | float)


def _is_zero(x: object) -> bool:
    return is_constant(x) and x == 0


class _Space(tuple):
    """A tuple with the arithmetic of a vector space."""

    __slots__ = ()
    __array_ufunc__ = None  # NumPy leaves s * v to v

    def _like(self, other: VectorLike) -> Iterable[Scalar]:
        """The entries of another one."""
        return components(other) if isinstance(other, Array) else other

    def __neg__(self) -> Self:
        return type(self)(-x for x in self)

    def __add__(self, other: VectorLike) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        return type(self)(plus(x, y) for x, y in zip(self, self._like(other), strict=True))

    def __radd__(self, other: VectorLike) -> Self:
        if isinstance(other, int) and other == 0:  # where `sum` begins
            return self
        return type(self)(self._like(other)) + self

    def __sub__(self, other: VectorLike) -> Self:
        return type(self)(x if _is_zero(y) else x - y for x, y in zip(self, self._like(other), strict=True))

    def __rsub__(self, other: VectorLike) -> Self:
        return type(self)(self._like(other)) - self

    def __mul__(self, s: Scalar) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        return type(self)(x * s if isinstance(x, _Space) else times(s, x) for x in self)

    def __rmul__(self, s: Scalar) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self * s

    def __truediv__(self, s: Scalar) -> Self:
        return type(self)(x / s for x in self)

    @property
    def dtype(self) -> DTypeLike:
        return jnp.result_type(*jax.tree.leaves(self))


class Vector(_Space):
    """A vector."""

    def __matmul__(self, other: VectorLike) -> Array:
        """v · w."""
        return dot(self, other)


class Symmetric(_Space):
    """A symmetric tensor S: (xx, yy, zz), or in full (xx, yy, zz, yz, xz, xy)."""

    @property
    def full(self) -> Symmetric:
        """The six entries, also of a diagonal one."""
        return self if len(self) == 6 else Symmetric((*self, *[jnp.zeros_like(self[0])] * 3))

    @property
    def rows(self) -> Matrix:
        x, y, z, yz, xz, xy = self.full
        return Matrix(((x, xy, xz), (xy, y, yz), (xz, yz, z)))

    @property
    def trace(self) -> Array:
        return self[0] + self[1] + self[2]

    @property
    def adjugate(self) -> Symmetric:
        """adj S, so that S⁻¹ = adj S / det S."""
        x, y, z = self[:3]
        if len(self) == 3:
            return Symmetric((y * z, z * x, x * y))
        yz, xz, xy = self[3:]
        minors = (y * z - yz * yz, x * z - xz * xz, x * y - xy * xy)
        return Symmetric((*minors, xz * xy - x * yz, xy * yz - y * xz, xz * yz - z * xy))

    def det(self, adjugate: Symmetric) -> Array:
        """det S, along the first row."""
        first = self[0] * adjugate[0]
        return first if len(self) == 3 else first + self[4] * adjugate[4] + self[5] * adjugate[5]

    def __matmul__(self, other: VectorLike) -> Any:
        """S v or S A."""
        if isinstance(other, Matrix | Symmetric) or len(self) == 6:
            return self.rows @ other
        return Vector(s * x for s, x in zip(self, self._like(other), strict=True))

    def solve(self, v: VectorLike) -> Vector:
        """S⁻¹ v."""
        if len(self) == 3:
            return Vector((v[0] / self[0], v[1] / self[1], v[2] / self[2]))
        S = Symmetric(s.astype(jnp.result_type(s, v[0])) for s in self)  # the digits of v, if it has more
        r = 1 / S.trace  # scaled by the trace: the cube of a large inertia leaves the range of float32
        S = r * S
        adjugate = S.adjugate
        return (adjugate @ v) * (r / S.det(adjugate))

    @property
    def inverse_trace(self) -> Array:
        """tr S⁻¹: for a positive definite S, 1 to 3 times the largest |S⁻¹v|/|v|."""
        if len(self) == 3:
            return 1 / self[0] + 1 / self[1] + 1 / self[2]
        r = 1 / self.trace
        S = r * self
        adjugate = S.adjugate
        return r * adjugate.trace / S.det(adjugate)

    @property
    def well_conditioned(self) -> Array:
        """Whether v·S⁻¹v is right to ten digits in float64, to four in float32; for diagonal matrices it always is.

        The smallest eigenvalue of a full matrix has an error of ε times the largest, so their ratio may be at most
        3.5e4 in float64 and 1.4e3 in float32.
        """
        if len(self) == 3:
            return jnp.ones((), bool)
        S = Symmetric(lax.stop_gradient(s) for s in self)
        adjugate, most = S.adjugate, min(7e4, float(jnp.finfo(S[0].dtype).eps) ** -0.5)
        return S.trace * adjugate.trace <= most * S.det(adjugate)  # twice the ratio for a rod or a needle

    @property
    def positive_definite(self) -> Array:
        """Whether a full S is positive definite: whether its leading minors are positive."""
        adjugate = self.adjugate
        return (self[0] > 0) & (adjugate[2] > 0) & (self.det(adjugate) > 0)

    def inner(self, other: Symmetric) -> Array:
        """S:R = tr(SR) of two full tensors."""
        S, R = self, other
        return S[0] * R[0] + S[1] * R[1] + S[2] * R[2] + 2 * (S[3] * R[3] + S[4] * R[4] + S[5] * R[5])


class Matrix(_Space):
    """A matrix A: three rows, each a vector."""

    def __new__(cls, rows: Iterable[Iterable[Scalar]]) -> Self:
        return super().__new__(cls, (row if isinstance(row, Vector) else Vector(row) for row in rows))

    def _like(self, other: VectorLike) -> Iterable[Scalar]:
        return other.rows if isinstance(other, Symmetric) else other

    def __rmatmul__(self, other: Array) -> Array:
        """An array times this."""
        return other @ self.array

    @property
    def T(self) -> Matrix:
        return Matrix(zip(*self, strict=True))

    def __matmul__(self, other: VectorLike) -> Any:
        """A v or A B."""
        if not isinstance(other, Matrix | Symmetric):
            return Vector(dot(row, other) for row in self)
        columns = (other.rows if isinstance(other, Symmetric) else other).T
        return Matrix((dot(row, column) for column in columns) for row in self)

    @property
    def array(self) -> Array:
        """The matrix as an array, (3, 3)."""
        return jnp.stack([jnp.stack(row) for row in self])

    @property
    def cofactors(self) -> Matrix:
        """cof A, whose rows are the cross products of the rows of A."""
        return Matrix((cross(self[1], self[2]), cross(self[2], self[0]), cross(self[0], self[1])))

    @property
    def trace(self) -> Array:
        return self[0][0] + self[1][1] + self[2][2]

    def det(self) -> Array:
        return dot(self[0], cross(self[1], self[2]))

    def solve(self, b: VectorLike, n: Array | float = 1, divide: bool = False) -> Vector:
        """(nA)⁻¹b, by the adjugate.

        With `divide`, by three divisions instead of one. XLA never computes a quotient twice, so a long computation
        that follows, such as a pull-back, does not recompute the solve for each of its results.
        """
        cof = self.cofactors
        d = n * dot(self[0], cof[0])
        x = cof.T @ b
        return x / d if divide else x * (1 / d)

    @property
    def no_negative_eigenvalue(self) -> Array:
        """False if A has a real eigenvalue ≤ 0: whether its characteristic polynomial's signs alternate (Descartes)."""
        A = self
        minors = [A[i][i] * A[j][j] - A[i][j] * A[j][i] for i, j in PAIRS[3:]]
        return (A[0][0] + A[1][1] + A[2][2] > 0) & (minors[0] + minors[1] + minors[2] > 0) & (A.det() > 0)

    def plus_transpose(self) -> Symmetric:
        """A + Aᵀ."""
        return Symmetric(self[i][j] + self[j][i] for i, j in PAIRS)

    def times_hat(self, v: VectorLike) -> Matrix:
        """A v̂."""
        return Matrix(cross(row, v) for row in self)

    def gram(self) -> Symmetric:
        """AᵀA."""
        columns = self.T
        return Symmetric(dot(columns[i], columns[j]) for i, j in PAIRS)


for _kind in (Vector, Symmetric, Matrix):
    jax.tree_util.register_pytree_node(
        _kind, lambda v: (tuple(v), None), lambda _, entries, kind=_kind: tuple.__new__(kind, entries)
    )


def components(v: Array) -> tuple[Array, ...]:
    return tuple(x.reshape(v.shape[1:]) for x in lax.split(v, (1,) * v.shape[0]))


def _scalars(v: VectorLike) -> Iterable[Scalar]:
    return (v[i] for i in range(v.shape[0])) if isinstance(v, Array) else v


def vector(v: Array) -> Vector:
    """A vector, from an array (n,)."""
    return Vector(components(v))


def matrix(A: Array) -> Matrix:
    """A matrix, from an array (n, m)."""
    return Matrix(components(row) for row in components(A))


def dot(a: VectorLike, b: VectorLike) -> Array:
    """a · b of two vectors, or arrays (n,), of the same length."""
    return functools.reduce(plus, (times(x, y) for x, y in zip(_scalars(a), _scalars(b), strict=True)))


def norm(v: VectorLike) -> Array:
    """|v|."""
    return jnp.sqrt(dot(v, v))


def cross(a: VectorLike, b: VectorLike) -> Vector:
    return Vector((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def max_abs(*vectors: VectorLike) -> Array:
    """The largest size of an entry."""
    return functools.reduce(jnp.maximum, [jnp.abs(x) for v in vectors for x in v])


def outer(a: VectorLike, b: VectorLike) -> Matrix:
    """a ⊗ b."""
    return Matrix((x * y for y in b) for x in a)


def angle(a: VectorLike, b: VectorLike) -> Array:
    """The angle between two vectors of any lengths, in radians, accurate where it is small."""
    c = cross(a, b)
    return jnp.arctan2(norm(c), dot(a, b))


def hat(v: VectorLike) -> Matrix:
    """v̂, with v̂ w = v × w."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return Matrix(((zero, -z, y), (z, zero, -x), (-y, x, zero)))


def symmetric(J: Array) -> Symmetric:
    """A symmetric tensor given by its diagonal, an array (3,), or in full, (3, 3)."""
    if J.shape not in ((3,), (3, 3)):
        raise ValueError(
            f"a tensor of one body has shape (3,) or (3, 3), got {J.shape}: where each member has a system of its own, "
            "give own_step=True, or use jax.vmap"
        )
    return Symmetric(components(J)) if J.ndim == 1 else entries(J)


def entries(J: Array) -> Symmetric:
    """The distinct entries of symmetric matrices whose first two axes are those of the matrix."""
    off = [(J[i, j] + J[j, i]) / 2 for i, j in ((1, 2), (0, 2), (0, 1))]
    return Symmetric((J[0, 0], J[1, 1], J[2, 2], *off))


def unit_trace(J: Array) -> tuple[Symmetric, Array]:
    """J / tr J and 1 / tr J, for J as in `symmetric`."""
    S = symmetric(J)
    r = 1 / S.trace
    return r * S, r


def inverse(J: Array) -> Symmetric:
    """J⁻¹, for J as in `symmetric`."""
    S, r = unit_trace(J)  # scaled, as in `Symmetric.solve`
    if len(S) == 3:
        return Symmetric(r / x for x in S)
    adjugate = S.adjugate
    return (r / S.det(adjugate)) * adjugate


def mean_cofactor(S: Symmetric, D: Symmetric) -> Symmetric:
    """The mean of cof(S + sD) over 0 ≤ s ≤ 1, a symmetric matrix whose product with D is det(S + D) − det S."""
    return (S + 0.5 * D).adjugate + (1 / 12) * D.adjugate
