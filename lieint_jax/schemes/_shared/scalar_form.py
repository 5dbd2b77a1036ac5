"""The scalar form of (3.4) for the symplectic κ: one quartic for m = a·h, the same for every step of a trajectory.

    J h = a + a × h + m h,    so  h = (J − m − â)⁻¹ a  and  m = a·(J − m − â)⁻¹ a

with h = ½Θ and a = ½Δt Π_n, both over tr J; derived in `schemes._so3_midpoint`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import newton
from lieint_jax.types.shapes import Scalar, Vector3
from lieint_jax.types.vectors import Symmetric, Vector, cross, dot, hat, outer, vector


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
    """h = (J − m − â)⁻¹a, shape (3,), for tr J = 1.

    With adj(J − m − â)a = adj(J)a + (m² − m tr J + |a|²)a + m Ja − a×Ja everything is a polynomial in m. If m was
    computed elsewhere on a trajectory, the value of the quartic is the error of the energy here; a rotation about
    a × J⁻¹a removes the fraction `gain` of it.
    """
    C = J.adjugate
    J3, J2 = J.det(C), C.trace
    Ja, Ca, s = J @ a, C @ a, dot(a, a)
    k = s - m * (1 - m)
    w = J3 - m * (J2 + k)
    r = 1 / (w + dot(a, Ja))
    if gain is None:
        x = cross(a, Ja)
    else:
        t = gain * lax.stop_gradient(m * w - k * s - dot(a, Ca))  # 0 but for rounding, and so is its derivative
        x = cross(a, Ja + t * Ca)
    return (r * k) * a + r * jnp.stack(Ca + m * Ja - x)


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
