"""The vector form of (3.4), J y + b + κ y × (J y + b) = a, for any scaling κ(4|y|²).

Θ = 2κy is the rotation of a step, a = ½Δt Π_n, and b = ½Δt h̄_r for a rotor, 0 for a free body.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import newton, vec3
from lieint_jax._numerics.vec3 import Symmetric, Vector, add, apply, cross, dot, scale, subtract
from lieint_jax.maps import Kappa
from lieint_jax.types.shapes import Flag, Vector3


def solve_vector(
    kappa: Kappa, J: Symmetric, a: Vector3, iterations: int, b: Array | None = None
) -> tuple[Vector, Vector, Array]:
    """h = ½Θ for any κ by the vector form, its residual, and whether it is on the branch that starts at Δt = 0."""

    def residual(y: Vector) -> Vector:
        return subtract(gyration(kappa, J, y, b), a)

    def correction(y: Vector, f: Vector) -> Vector:
        return vec3.solve(gyration_matrix(kappa, J, y, b), f)

    u = vec3.solve_symmetric(J, a if b is None else a - b)
    guess = add(u, vec3.solve_symmetric(J, cross(a, u)))  # ½(ΔtΩ + ½Δt²J⁻¹(Π × Ω))
    y, f, steady = newton.root(residual, correction, guess, iterations)
    k = kappa(4 * dot(y, y))
    good = steady & on_branch(kappa, y, gyration_matrix(kappa, J, lax.stop_gradient(y), b))
    return (k * y[0], k * y[1], k * y[2]), f, good


def gyration(kappa: Kappa, J: Symmetric, y: Vector, b: Vector | None = None) -> Vector:
    """Jy + b + κ y × (Jy + b), the left side of the vector form; b = 0 if it is None."""
    still = apply(J, y) if b is None else add(apply(J, y), b)
    return add(still, scale(kappa(4 * dot(y, y)), cross_apply(y, J, b)))


def gyration_matrix(kappa: Kappa, J: Symmetric, y: Vector, b: Vector | None = None) -> vec3.Matrix:
    """The derivative of `gyration`, K = J + κ(ŷJ − (Jy + b)^) + 8κ′(y × (Jy + b))⊗y, as rows."""
    e, G = dense(J), gyroscopic(J, y, b)
    if kappa.constant:
        return vec3.combine(e, G)
    k, slope = jax.jvp(kappa, (4 * dot(y, y),), (jnp.full_like(y[0], 8),))
    g = scale(slope, cross_apply(y, J, b))
    return [[e[i][j] + k * G[i][j] + g[i] * y[j] for j in range(3)] for i in range(3)]


def on_branch(kappa: Kappa, y: Vector, K: vec3.Matrix) -> Flag:
    """Whether κ is real at y = ½Θ̄, and y lies before the fold of the branch, where an eigenvalue of K vanishes."""
    return (4 * dot(y, y) <= kappa.limit**2) & vec3.no_negative_eigenvalue(K)


def cross_apply(y: Vector, J: Symmetric, b: Vector | None = None) -> Vector:
    """y × (Jy + b); b = 0 if it is None."""
    if b is not None:
        return add(cross_apply(y, J), cross(y, b))
    if len(J) == 3:
        return ((J[2] - J[1]) * (y[1] * y[2]), (J[0] - J[2]) * (y[2] * y[0]), (J[1] - J[0]) * (y[0] * y[1]))
    return cross(y, apply(J, y))


def gyroscopic(J: Symmetric, y: Vector, b: Vector | None = None) -> vec3.Matrix:
    """The derivative of y × (Jy + b): ŷJ − (Jy + b)^."""
    if b is not None:
        return vec3.combine(gyroscopic(J, y), vec3.hat(b), -1)
    if len(J) == 3:
        d = (J[2] - J[1], J[0] - J[2], J[1] - J[0])
        zero = jnp.zeros_like(d[0])
        return (
            (zero, d[0] * y[2], d[0] * y[1]),
            (d[1] * y[2], zero, d[1] * y[0]),
            (d[2] * y[1], d[2] * y[0], zero),
        )
    yJ = [cross(y, row) for row in vec3.rows(J)]  # columns of ŷJ, J being symmetric
    Jy = vec3.hat(apply(J, y))
    return [[yJ[j][i] - Jy[i][j] for j in range(3)] for i in range(3)]


def dense(J: Symmetric) -> vec3.Matrix:
    """J as rows."""
    if len(J) == 6:
        return vec3.rows(J)
    zero = jnp.zeros_like(J[0])
    return ((J[0], zero, zero), (zero, J[1], zero), (zero, zero, J[2]))
