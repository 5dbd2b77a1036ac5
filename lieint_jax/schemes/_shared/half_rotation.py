"""Half the rotation of an energy-momentum step, h = ½Θ of (2.24), (3.3), by the scalar or the vector form of (3.4).

Scalar form, for the symplectic κ: one quartic for m = a·h, the same for every step of a trajectory,

    J h = a + a × h + m h,    so  h = (J − m − â)⁻¹ a  and  m = a·(J − m − â)⁻¹ a

Vector form, for any scaling κ = κ(4|y|²), with h = κy,

    J y + b + κ y × (J y + b) = a

with a = ½Δt Π_n, and b = ½Δt h̄_r for a rotor, 0 for a free body; J, a and b are over tr J. They are derived in
`schemes._so3_midpoint`.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike, DTypeLike

from lieint_jax._numerics import newton
from lieint_jax._numerics.arrays import Flag, Scalar, Vector3
from lieint_jax._numerics.vectors import (
    Matrix,
    Symmetric,
    Vector,
    VectorLike,
    cross,
    dot,
    hat,
    max_abs,
    outer,
    unit_trace,
    vector,
)
from lieint_jax.core import State, StepInfo
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa
from lieint_jax.systems._equations import AbstractFreeBody, AbstractGyrostat

ITERATIONS = {"scalar": 3, "vector": 4}  # Newton corrections per step, by the form of the equation
SLENDER = (
    "the inertia's moments differ so much that a full tensor does not hold the smallest one (to 1 : 3.5e4 in float64, "
    "1 : 1400 in float32): give principal moments (3,), and turn the attitude to the principal axes"
)


def attitude_error_limit(dtype: DTypeLike) -> float:
    """The error of an attitude, by rounding of the state alone, above which a step is not to be trusted."""
    return max(1e-6, math.sqrt(jnp.finfo(dtype).eps))


def half_rotation(
    J: Symmetric, a: Vector3, kappa: Kappa, iterations: int, b: Vector3 | None = None
) -> tuple[VectorLike, StepInfo]:
    """h = ½Θ of a step, shape (3,), from J and a as in `scaled` and b as in `bias`, and its report."""
    if kappa.solve_by == "scalar" and b is None:
        h, residual, good = solve_scalar(J, a, iterations)
    else:
        h, residual, good = solve_vector(kappa, J, a, iterations, b)
        good &= jnp.finfo(a.dtype).eps * _size(a, b) * J.inverse_trace <= attitude_error_limit(a.dtype)
    return h, StepInfo.of_root(max_abs(residual), good & J.well_conditioned, _size(a, b))


def scaled(system: AbstractFreeBody | AbstractGyrostat, state: State, dt: ArrayLike) -> tuple[Symmetric, Vector3]:
    """J and a = ½Δt Π_n, both over tr J: then |a| is an angle, and no power of a large inertia overflows."""
    J, r = unit_trace(system.inertia)
    return J, (0.5 * r * dt) * so3.Ad_star(state.q, state.p)


def bias(system: AbstractFreeBody | AbstractGyrostat, dt: ArrayLike) -> Vector3 | None:
    """b = ½Δt h_r over tr J; None for a free body."""
    return (0.5 * unit_trace(system.inertia)[1] * dt) * system.rotor if isinstance(system, AbstractGyrostat) else None


def _size(a: Vector3, b: Vector3 | None) -> Array:
    """The size of the terms of the vector form."""
    return max_abs(a) if b is None else max_abs(a, b)


# The scalar form ------------------------------------------------------------------------------------------------------


def solve_scalar(J: Symmetric, a: Vector3, iterations: int) -> tuple[Vector3, Vector3, Array]:
    """h = ½Θ of the symplectic κ by the scalar form, its residual, and whether h is on the branch |h| ≤ 1.

    The scalar form gives the value; derivatives are those of the equation for h, which has far fewer terms.
    """
    h = half_cayley(J, a, scalar_root(J, a, iterations))
    h, residual, _ = newton.root(lambda h: jnp.stack(scalar_residual(J, a, h)), lambda _, f: f, h, iterations=0)
    return h, residual, dot(h, h) <= 1


def scalar_root(J: Symmetric, a: Vector3, iterations: int) -> Scalar:
    """m = a·(J − m − â)⁻¹a, constant along a trajectory, for tr J = 1."""
    C = J.adjugate
    J3, J2 = J.det(C), C.trace
    s, Ca = dot(a, a), C @ a
    c0, c1, c2 = -(dot(a, Ca) + s * s), J3 + s, -(J2 + 2 * s)  # m det(J − m − â) − a·adj(J − m − â)a = c0 + c1 m + …

    def quartic(m: Array) -> Array:
        return c0 + m * (c1 + m * (c2 + m * (1 - m)))

    def correction(m: Array, f: Array) -> Array:
        """Newton's step on f/√f′ (Halley), as the second derivative of a quartic costs little."""
        slope = c1 + m * (2 * c2 + m * (3 - 4 * m))
        bend = 2 * c2 + m * (6 - 12 * m)
        return 2 * f * slope / (2 * slope * slope - f * bend)

    r = 1 / J3
    u = r * Ca  # J⁻¹a
    g = cross(a, u)
    m = r * dot(a, Ca) * (1 + dot(u, u)) - r * dot(g, C @ g)  # the root, but for O(Δt⁶)
    return newton.root(quartic, correction, m, iterations)[0]


def half_cayley(J: Symmetric, a: Vector3, m: Scalar, gain: Scalar | None = None) -> Vector3:
    """h = (J − m − â)⁻¹a, shape (3,).

    With D = J − m, adj(D − â)a = adj(D)a + |a|²a − a × Da and det(D − â) = det D + a·Da. If m was computed elsewhere on
    a trajectory, the value of the quartic is the error of the energy here; a rotation about a × J⁻¹a removes the
    fraction `gain` of it.
    """
    D = Symmetric((J[0] - m, J[1] - m, J[2] - m, *J[3:]))
    C = D.adjugate
    Da, Ca, s = D @ a, C @ a, dot(a, a)
    det = D.det(C) + dot(a, Da)
    if gain is None:
        x = cross(a, Da)
    else:
        t = gain * lax.stop_gradient(m * det - s * s - dot(a, Ca))  # 0 but for rounding, and so is its derivative
        x = cross(a, Da + t * Ca)
    r = 1 / det
    return (r * s) * a + r * jnp.stack(Ca - x)


def scalar_residual(J: Symmetric, a: Vector3, h: Vector3) -> Vector:
    """Jh − a − a × h − (a·h)h: the scalar form itself, with m = a·h."""
    return J @ h - dot(a, h) * vector(h) - a - cross(a, h)


def half_rotation_derivative(J: Symmetric, a: Vector3, h: Vector3, da: Vector3) -> Vector:
    """The rotation of the body at the end of a step, in the axes of its beginning, caused by a change δa of a.

    (J − m − â − h⊗a) δh = δa + δa × h + (δa·h)h, m = a·h, the derivative of the scalar form; and cay 2h rotates by
    2/(1 + |h|²) (δh + h × δh).
    """
    m = dot(a, h)
    K = J.rows - hat(a) - outer(h, a) - Symmetric((m, m, m))
    dh = K.solve(da + (cross(da, h) + dot(da, h) * vector(h)), divide=True)
    return 2 / (1 + dot(h, h)) * (dh + cross(h, dh))


# The vector form ------------------------------------------------------------------------------------------------------


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
    """Jy + b + κ y × (Jy + b), the left side of the vector form; b = 0 if it is None.

    Differences of moments, as in `gyroscopic`, are rounded alike in each step: by them the energy would have a slope.
    """
    w = _momentum(J, y, b)
    return w + kappa(4 * dot(y, y)) * cross(y, w)


def gyration_matrix(kappa: Kappa, J: Symmetric, y: Vector, b: VectorLike | None = None) -> Matrix:
    """The derivative of `gyration`, K = J + κ(ŷJ − (Jy + b)^) + 8κ′(y × (Jy + b))⊗y."""
    G = gyroscopic(J, y, b)
    if kappa.constant:
        return J.rows + G
    k, slope = jax.jvp(kappa, (4 * dot(y, y),), (jnp.full_like(y[0], 8),))
    return J.rows + k * G + outer(slope * cross(y, _momentum(J, y, b)), y)


def _momentum(J: Symmetric, y: Vector, b: VectorLike | None) -> Vector:
    """Jy + b; b = 0 if it is None."""
    return J @ y if b is None else J @ y + b


def on_branch(kappa: Kappa, y: Vector, K: Matrix) -> Flag:
    """Whether κ is real at y = ½Θ̄, and y lies before the fold of the branch, where an eigenvalue of K vanishes."""
    return (4 * dot(y, y) <= kappa.limit**2) & K.no_negative_eigenvalue


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
