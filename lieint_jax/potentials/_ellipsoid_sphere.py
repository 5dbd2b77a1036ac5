"""Gravity of a homogeneous ellipsoid and a sphere, in closed form.

    V = −(3/4) G m₁m₂ ∫_λ^∞ (1 − Σ Γ_i²/(a_i² + s)) ds/√((a₁² + s)(a₂² + s)(a₃² + s)),   Γ = Λ₁ᵀ(x₂ − x₁)

λ is the greatest root of Σ Γ_i²/(a_i² + λ) = 1, and 0 inside. The integrals are Carlson's R_F and R_D.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jax import Array, lax

from lieint_jax import _checks
from lieint_jax._checks import named, positive
from lieint_jax._numerics import newton
from lieint_jax._numerics.arrays import Calls, Positions, Rotations, Scalar
from lieint_jax._numerics.elliptic import carlson_rf_rd
from lieint_jax.core import Converted, argument, pytree
from lieint_jax.potentials._potential import Potential

__all__ = ["ellipsoid_sphere"]

_MOST = 64  # corrections: at most 8 for axes of a ratio of 30, 15 for 10⁶


@pytree
class EllipsoidSphere(Potential):
    """Gravity of a homogeneous ellipsoid, body 0, and a sphere or a point, body 1, at any distance.

    Invariant: P and L are conserved. The ellipsoid's moments of inertia are m(b² + c²)/5 and so on.
    V and the force are right to round-off at any distance r. The torque is the moment of the force, so its relative
    error is about eps (r/a)², 1e-10 at r = 1000a; beyond 10⁴a `maccullagh` is more accurate.

    Args:
        G: the constant of gravity.
        masses: (2,), of the ellipsoid and the sphere.
        semi_axes: of the ellipsoid along its own axes, (3,), > 0, in any order.

    Source: Dirichlet's integral, Chandrasekhar 1969, Ellipsoidal Figures of Equilibrium, ch. 3; Carlson's forms, DLMF
    19.16.
    """

    G: Converted[Array] = argument(converter=named(_checks.real_array, "G", ()))
    masses: Converted[Array] = argument(converter=named(positive, "masses", (2,)))
    semi_axes: Converted[Array] = argument(converter=named(positive, "semi_axes", (3,)))

    @property
    def count(self) -> int:
        return 2

    def invariants(self, x: Positions, R: Rotations) -> Array:
        """Γ, the position of the sphere in the axes of the ellipsoid, (3,)."""
        return jnp.sum(R[0] * (x[1] - x[0])[:, None], axis=0)

    def value(self, invariants: Array) -> Scalar:
        """V of Γ."""
        squares = invariants**2
        RF, *RD = carlson_rf_rd(*(self.semi_axes**2 + _confocal(squares, self.semi_axes**2)))
        return -self.G * self.masses[0] * self.masses[1] * (1.5 * RF - jnp.sum(squares * jnp.stack(RD)) / 2)


def _confocal(squares: Array, axes: Array) -> Array:
    """λ of the ellipsoid through Γ that is confocal with the one of squared semi-axes `axes`; 0 inside that one.

    With φ(λ) = Σ Γ_i²/(a_i² + λ), by Newton's method for 1/φ = 1. 1/φ is a parallel sum of functions that are linear in
    λ, so it is concave and increases: a tangent at a λ below the root lies above it and meets 1 between λ and the root.
    So the iterates increase to the root from any λ with φ ≥ 1, where each multiplies the least a_i² + λ by φ or more.
    NaN if they have not come to round-off.
    """
    outside = jnp.sum(squares / axes) > 1
    squares = jnp.where(outside, squares, axes)
    enough = 4 * float(jnp.finfo(axes.dtype).eps)  # a rounding of λ changes φ by less than its own

    def excess(at: Array) -> Array:
        return jnp.sum(squares / (axes + at)) - 1

    def correct(at: Array, F: Array) -> Array:
        return at + (1 + F) * F / jnp.sum(squares / (axes + at) ** 2)

    def solve(function: Callable[[Array], Array], at: Array) -> tuple[Array, Array]:
        def improve(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            at, F, k = carry
            at = correct(at, F)
            return at, function(at), k + 1

        start = at, function(at), jnp.zeros((), jnp.int32)
        at, F, _ = lax.while_loop(lambda carry: (carry[1] > enough) & (carry[2] < _MOST), improve, start)
        return correct(at, F), F  # the last one has the derivatives of the root, whatever the guess has

    below = jnp.maximum(jnp.sum(squares) - jnp.max(axes), jnp.maximum(jnp.max(squares - axes), 0))
    root, F = newton.implicit_root(excess, below, solve, lambda slope, y: y / slope(jnp.ones_like(y)))
    return jnp.where(outside, jnp.where(enough >= F, root, jnp.nan), 0)


ellipsoid_sphere = EllipsoidSphere


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    masses, semi_axes = jnp.array([2.0, 1.0]), jnp.array([1.0, 0.8, 0.3])
    return {"ellipsoid_sphere": partial(ellipsoid_sphere, G=1.3, masses=masses, semi_axes=semi_axes)}
