"""Gravity of a homogeneous ellipsoid and a sphere, in closed form.

    V = −(3/4) G m₁m₂ ∫_λ^∞ (1 − Σ Γ_i²/(a_i² + s)) ds/√((a₁² + s)(a₂² + s)(a₃² + s)),   Γ = Λ₁ᵀ(x₂ − x₁)

λ is the greatest root of Σ Γ_i²/(a_i² + λ) = 1, and 0 inside. The integrals are Carlson's R_F and R_D.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import newton
from lieint_jax._numerics.elliptic import carlson_rf_rd
from lieint_jax.potentials._potential import Potential
from lieint_jax.types import pytree
from lieint_jax.types.shapes import Positions, Rotations, Scalar

_ITERATIONS = 12  # Newton's, which doubles a_i² + λ while that is much too small


@pytree
class EllipsoidSphere(Potential):
    """Gravity of a homogeneous ellipsoid, body 0, and a sphere, body 1. Made by `ellipsoid_sphere`.

    Attributes:
        G: the constant of gravity.
        masses: (2,).
        semi_axes: a of the ellipsoid, (3,).
    """

    G: Array
    masses: Array
    semi_axes: Array

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
    """λ of the ellipsoid through Γ that is confocal with the one of squared semi-axes `axes`; 0 inside that one."""
    outside = jnp.sum(squares / axes) > 1
    squares = jnp.where(outside, squares, axes)

    def excess(at: Array) -> Array:
        return jnp.sum(squares / (axes + at)) - 1

    def correction(at: Array, F: Array) -> Array:
        return -F / jnp.sum(squares / (axes + at) ** 2)

    below = jnp.maximum(jnp.sum(squares) - jnp.max(axes), 0)  # the excess is convex: Newton's method comes from there
    return jnp.where(outside, newton.root(excess, correction, below, _ITERATIONS, unroll=False)[0], 0)


def ellipsoid_sphere(G: ArrayLike, masses: ArrayLike, semi_axes: ArrayLike) -> EllipsoidSphere:
    """Gravity of a homogeneous ellipsoid, body 0, and a sphere or a point, body 1, at any distance.

    Invariant: P and L are conserved. The ellipsoid's moments of inertia are m(b² + c²)/5 and so on.

    Args:
        G: the constant of gravity.
        masses: (2,), of the ellipsoid and the sphere.
        semi_axes: of the ellipsoid along its own axes, (3,), > 0, in any order.

    Source: Dirichlet's integral, Chandrasekhar 1969, Ellipsoidal Figures of Equilibrium, ch. 3; Carlson's forms, DLMF
    19.16.
    """
    m, a = _checks.positive("masses", masses, (2,)), _checks.positive("semi_axes", semi_axes, (3,))
    return EllipsoidSphere(_checks.real_array("G", G, ()), m, a)
