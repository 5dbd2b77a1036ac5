"""The vector form of (3.4), J y + b + κ y × (J y + b) = a, for any scaling κ(4|y|²).

Θ = 2κy is the rotation of a step, a = ½Δt Π_n, and b = ½Δt h̄_r for a rotor, 0 for a free body.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import newton
from lieint_jax.maps import Kappa
from lieint_jax.types.shapes import Flag, Vector3
from lieint_jax.types.vectors import Matrix, Symmetric, Vector, VectorLike, cross, dot, hat, outer


def solve_vector(
    kappa: Kappa, J: Symmetric, a: Vector3, iterations: int, b: Array | None = None
) -> tuple[Vector, Vector, Array]:
    """h = ½Θ for any κ by the vector form, its residual, and whether it is on the branch that starts at Δt = 0."""

    def residual(y: Vector) -> Vector:
        return gyration(kappa, J, y, b) - a

    def correction(y: Vector, f: Vector) -> Vector:
        return gyration_matrix(kappa, J, y, b).solve(f)

    u = J.solve(a if b is None else a - b)
    guess = u + J.solve(cross(a, u))  # ½(ΔtΩ + ½Δt²J⁻¹(Π × Ω))
    y, f, steady = newton.root(residual, correction, guess, iterations)
    k = kappa(4 * dot(y, y))
    good = steady & on_branch(kappa, y, gyration_matrix(kappa, J, lax.stop_gradient(y), b))
    return k * y, f, good


def gyration(kappa: Kappa, J: Symmetric, y: Vector, b: VectorLike | None = None) -> Vector:
    """Jy + b + κ y × (Jy + b), the left side of the vector form; b = 0 if it is None."""
    Jy = J @ y if b is None else J @ y + b
    return Jy + kappa(4 * dot(y, y)) * cross_apply(y, J, b)


def gyration_matrix(kappa: Kappa, J: Symmetric, y: Vector, b: VectorLike | None = None) -> Matrix:
    """The derivative of `gyration`, K = J + κ(ŷJ − (Jy + b)^) + 8κ′(y × (Jy + b))⊗y."""
    G = gyroscopic(J, y, b)
    if kappa.constant:
        return J.rows + G
    k, slope = jax.jvp(kappa, (4 * dot(y, y),), (jnp.full_like(y[0], 8),))
    return J.rows + k * G + outer(slope * cross_apply(y, J, b), y)


def on_branch(kappa: Kappa, y: Vector, K: Matrix) -> Flag:
    """Whether κ is real at y = ½Θ̄, and y lies before the fold of the branch, where an eigenvalue of K vanishes."""
    return (4 * dot(y, y) <= kappa.limit**2) & K.no_negative_eigenvalue


def cross_apply(y: Vector, J: Symmetric, b: VectorLike | None = None) -> Vector:
    """y × (Jy + b); b = 0 if it is None."""
    if b is not None:
        return cross_apply(y, J) + cross(y, b)
    if len(J) == 3:
        return Vector(((J[2] - J[1]) * (y[1] * y[2]), (J[0] - J[2]) * (y[2] * y[0]), (J[1] - J[0]) * (y[0] * y[1])))
    return cross(y, J @ y)


def gyroscopic(J: Symmetric, y: Vector, b: VectorLike | None = None) -> Matrix:
    """The derivative of y × (Jy + b): ŷJ − (Jy + b)^."""
    if b is not None:
        return gyroscopic(J, y) - hat(b)
    if len(J) == 3:
        d = (J[2] - J[1], J[0] - J[2], J[1] - J[0])
        zero = jnp.zeros_like(d[0])
        return Matrix(
            ((zero, d[0] * y[2], d[0] * y[1]), (d[1] * y[2], zero, d[1] * y[0]), (d[2] * y[1], d[2] * y[0], zero))
        )
    yJ = Matrix(cross(y, row) for row in J.rows).T  # column by column, J being symmetric
    return yJ - hat(J @ y)
