"""Arithmetic of 3-vectors and 3×3 matrices, component by component.

XLA fuses scalar arithmetic over a batch into vector loops; `@`, `einsum` and `jnp.linalg` on 3×3 data become calls that
it cannot fuse. So a vector here is anything with three components (an array (3,) or a tuple of scalars), results are
tuples, and a symmetric matrix is the tuple of its distinct entries: 3 of them if it is diagonal, 6 if it is full.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

Vector = Any  # three components: Array (3,) or a tuple of scalars
Symmetric = tuple[Array, ...]  # (xx, yy, zz) or (xx, yy, zz, yz, xz, xy)
Matrix = Any  # three rows: Array (3, 3) or a tuple of vectors
PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # which entries a full Symmetric holds


def components(v: Array) -> tuple[Array, ...]:
    return tuple(x.reshape(v.shape[1:]) for x in lax.split(v, (1,) * v.shape[0]))


def add(a: Vector, b: Vector) -> tuple[Array, Array, Array]:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vector, b: Vector) -> tuple[Array, Array, Array]:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s: Any, v: Vector) -> tuple[Array, Array, Array]:
    return (s * v[0], s * v[1], s * v[2])


def dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> tuple[Array, Array, Array]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def angle(a: Vector, b: Vector) -> Array:
    """The angle between two vectors of any lengths, in radians, accurate where it is small."""
    c = cross(a, b)
    return jnp.arctan2(jnp.sqrt(dot(c, c)), dot(a, b))


def hat(v: Vector) -> Matrix:
    """v̂, with v̂ w = v × w."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return ((zero, -z, y), (z, zero, -x), (-y, x, zero))


def max_abs(v: Vector) -> Array:
    return jnp.maximum(jnp.maximum(jnp.abs(v[0]), jnp.abs(v[1])), jnp.abs(v[2]))


def solve(K: Matrix, b: Vector, n: Array | float = 1, divide: bool = False) -> tuple[Array, Array, Array]:
    """(nK)⁻¹b for a 3×3 matrix of rows, by the adjugate.

    With `divide`, by three divisions instead of one. XLA never computes a quotient twice, so a long computation that
    follows, such as a pull-back, does not recompute the solve for each of its results.
    """
    c0, c1, c2 = cross(K[1], K[2]), cross(K[2], K[0]), cross(K[0], K[1])
    d = n * dot(K[0], c0)
    x, y, z = (c0[i] * b[0] + c1[i] * b[1] + c2[i] * b[2] for i in range(3))
    if divide:
        return x / d, y / d, z / d
    r = 1 / d
    return x * r, y * r, z * r


def transpose(A: Matrix) -> Matrix:
    return tuple(zip(*A, strict=True))


def product(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    columns = transpose(B)
    return tuple(tuple(dot(row, column) for column in columns) for row in A)


def transposed_product(A: Matrix, B: Matrix) -> Matrix:
    """Aᵀ B."""
    return product(transpose(A), B)


def scale_matrix(s: Any, A: Matrix) -> Matrix:
    """s A."""
    return tuple(tuple(s * x for x in row) for row in A)


def combine(A: Matrix, B: Matrix, b: Any = 1) -> Matrix:
    """A + b B."""
    return tuple(tuple(x + b * y for x, y in zip(r, s, strict=True)) for r, s in zip(A, B, strict=True))


def det(A: Matrix) -> Array:
    return dot(A[0], cross(A[1], A[2]))


def no_negative_eigenvalue(A: Matrix) -> Array:
    """False if A has a real eigenvalue ≤ 0: whether its characteristic polynomial's signs alternate (Descartes)."""
    minors = [A[i][i] * A[j][j] - A[i][j] * A[j][i] for i, j in PAIRS[3:]]
    return (A[0][0] + A[1][1] + A[2][2] > 0) & (minors[0] + minors[1] + minors[2] > 0) & (det(A) > 0)


def positive_definite(S: Symmetric) -> Array:
    """Whether a full symmetric matrix is positive definite: whether its leading minors are positive."""
    adj = adjugate(S)
    return (S[0] > 0) & (adj[2] > 0) & (determinant(S, adj) > 0)


def symmetric(J: Array) -> Symmetric:
    """The distinct entries of a symmetric matrix given by its diagonal, shape (3,), or in full, shape (3, 3)."""
    if J.shape not in ((3,), (3, 3)):
        raise ValueError(
            f"a tensor of one body has shape (3,) or (3, 3), got {J.shape}: where each member has a system of its own, "
            "give own_step=True, step_axis=0 or system_axis=0, or use jax.vmap"
        )
    return components(J) if J.ndim == 1 else entries(J)


def entries(J: Array) -> Symmetric:
    """The distinct entries of symmetric matrices whose first two axes are those of the matrix."""
    off = [(J[i, j] + J[j, i]) / 2 for i, j in ((1, 2), (0, 2), (0, 1))]
    return (J[0, 0], J[1, 1], J[2, 2], *off)


def trace(S: Symmetric) -> Array:
    return S[0] + S[1] + S[2]


def unit_trace(J: Array) -> tuple[Symmetric, Array]:
    """J / tr J and 1 / tr J, for J as in `symmetric`."""
    S = symmetric(J)
    r = 1 / trace(S)
    return tuple(r * x for x in S), r


def add_scaled(S: Symmetric, R: Symmetric, s: Any) -> Symmetric:
    """S + s R."""
    return tuple(x + s * y for x, y in zip(S, R, strict=True))


def full(S: Symmetric) -> Symmetric:
    """The six entries of S, also where S is diagonal."""
    return S if len(S) == 6 else (*S, *[jnp.zeros_like(S[0])] * 3)


def rows(S: Symmetric) -> Matrix:
    x, y, z, yz, xz, xy = S
    return ((x, xy, xz), (xy, y, yz), (xz, yz, z))


def apply(S: Symmetric, v: Vector) -> tuple[Array, Array, Array]:
    """S v."""
    if len(S) == 3:
        return (S[0] * v[0], S[1] * v[1], S[2] * v[2])
    r = rows(S)
    return (dot(r[0], v), dot(r[1], v), dot(r[2], v))


def adjugate(S: Symmetric) -> Symmetric:
    """adj S, so that S⁻¹ = adj S / det S."""
    x, y, z = S[:3]
    if len(S) == 3:
        return (y * z, z * x, x * y)
    yz, xz, xy = S[3:]
    return (y * z - yz * yz, x * z - xz * xz, x * y - xy * xy, xz * xy - x * yz, xy * yz - y * xz, xz * yz - z * xy)


def determinant(S: Symmetric, adj: Symmetric) -> Array:
    """det S from S and its adjugate, along the first row."""
    if len(S) == 3:
        return S[0] * adj[0]
    return S[0] * adj[0] + S[4] * adj[4] + S[5] * adj[5]


def mean_cofactor(S: Symmetric, D: Symmetric) -> Symmetric:
    """The mean of cof(S + sD) over 0 ≤ s ≤ 1, a symmetric matrix whose product with D is det(S + D) − det S."""
    return add_scaled(adjugate(add_scaled(S, D, 0.5)), adjugate(D), 1 / 12)


def inverse_trace(S: Symmetric) -> Array:
    """tr S⁻¹: for a positive definite S, 1 to 3 times the largest |S⁻¹v|/|v|."""
    if len(S) == 3:
        return 1 / S[0] + 1 / S[1] + 1 / S[2]
    r = 1 / trace(S)
    S = tuple(s * r for s in S)
    adj = adjugate(S)
    return r * trace(adj) / determinant(S, adj)


def well_conditioned(S: Symmetric) -> Array:
    """Whether v·S⁻¹v is right to ten digits in float64, to four in float32; for diagonal matrices it always is.

    The smallest eigenvalue of a full matrix has an error of ε times the largest, so their ratio may be at most 3.5e4 in
    float64 and 1.4e3 in float32.
    """
    if len(S) == 3:
        return jnp.ones((), bool)
    S = tuple(lax.stop_gradient(s) for s in S)
    adj, most = adjugate(S), min(7e4, float(jnp.finfo(S[0].dtype).eps) ** -0.5)
    return trace(S) * trace(adj) <= most * determinant(S, adj)  # twice the ratio for a rod or a needle


def inner(S: Symmetric, R: Symmetric) -> Array:
    """S:R = tr(SR) of two full symmetric matrices."""
    return S[0] * R[0] + S[1] * R[1] + S[2] * R[2] + 2 * (S[3] * R[3] + S[4] * R[4] + S[5] * R[5])


def plus_transpose(A: Matrix) -> Symmetric:
    """A + Aᵀ, as a full symmetric matrix."""
    return tuple(A[i][j] + A[j][i] for i, j in PAIRS)


def gram(F: Matrix) -> Symmetric:
    """FᵀF, as a full symmetric matrix."""
    columns = transpose(F)
    return tuple(dot(columns[i], columns[j]) for i, j in PAIRS)


def inverse(J: Array) -> Symmetric:
    """J⁻¹, for J as in `symmetric`."""
    S, r = unit_trace(J)  # scaled, as in `solve_symmetric`
    if len(S) == 3:
        return tuple(r / x for x in S)
    adj = adjugate(S)
    s = r / determinant(S, adj)
    return tuple(s * x for x in adj)


def solve_symmetric(S: Symmetric, v: Vector) -> tuple[Array, Array, Array]:
    """S⁻¹ v."""
    if len(S) == 3:
        return (v[0] / S[0], v[1] / S[1], v[2] / S[2])
    S = tuple(s.astype(jnp.result_type(s, v[0])) for s in S)  # the digits of v, if it has more
    r = 1 / trace(S)  # scaled by the trace: the cube of a large inertia leaves the range of float32
    S = tuple(s * r for s in S)
    adj = adjugate(S)
    x, y, z = apply(adj, v)
    r = r / determinant(S, adj)
    return (x * r, y * r, z * r)
