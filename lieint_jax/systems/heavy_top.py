"""Heavy tops: a rigid body with one point fixed, under gravity (Section 4)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import checks, small
from lieint_jax.groups import so3
from lieint_jax.systems.potential_top import PotentialTop, potential_top
from lieint_jax.types import State, pytree, static


@pytree
class Linear:
    """Ṽ(Γ) = E·Γ: uniform gravity, E the weight times the centre of mass in the body."""

    weight: Array
    linear: bool = static(default=True)

    def __call__(self, Gamma: Array) -> Array:
        return small.dot(self.weight, Gamma)

    def discrete_gradient(self, a: Array, b: Array) -> Array:
        """E, whatever a and b."""
        del a, b
        return self.weight


def heavy_top(inertia: ArrayLike, weight: ArrayLike, axis: ArrayLike = (0.0, 0.0, 1.0)) -> PotentialTop:
    """A heavy rigid body with a fixed point: V = γ·ΛE.

    Args:
        inertia: about the fixed point: principal moments (3,) or a symmetric tensor (3, 3).
        weight: E in the body, shape (3,): weight times the vector from the fixed point to the centre of mass.
        axis: γ in space, shape (3,): upwards.

    Raises:
        ValueError: as `potential_top`.

    Example:
        >>> top = heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, 20.0])
        >>> float(top.energy(top.state(angular_velocity=[0.0, 0.0, 50.0])))
        1270.0
    """
    return potential_top(inertia, Linear(checks.real_array("weight", weight, (3,))), axis)


def lagrange() -> tuple[PotentialTop, State]:
    """The fast symmetric top of Simo & Wong 1991, Int. J. Numer. Methods Eng. 31: J = (5, 5, 1), Mgl = 20, spin 50."""
    top = heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, 20.0])
    return top, top.state(so3.exp(jnp.array([0.3, 0.0, 0.0])), angular_velocity=[0.0, 0.0, 50.0])


def kovalevskaya() -> tuple[PotentialTop, State]:
    """Kovalevskaya 1889, Acta Math. 12: J = (2, 2, 1), the centre of mass in the equator; a fourth integral."""
    top = heavy_top([2.0, 2.0, 1.0], [1.0, 0.0, 0.0])
    return top, top.state(so3.exp(jnp.array([0.4, 0.9, -0.2])), angular_velocity=[0.3, 0.7, 0.9])


def kovalevskaya_integral(top: PotentialTop, state: State) -> Array:
    """|(Ω₁ + iΩ₂)² − E₁(Γ₁ + iΓ₂)/J₃|², constant for J₁ = J₂ = 2J₃ and E = (E₁, 0, 0)."""
    Omega, Gamma = top.angular_velocity(state), top.Gamma(state)
    assert isinstance(top.potential, Linear)
    c = top.potential.weight[0] / small.symmetric(top.inertia)[2]
    real = Omega[0] ** 2 - Omega[1] ** 2 - c * Gamma[0]
    imaginary = 2 * Omega[0] * Omega[1] - c * Gamma[1]
    return real**2 + imaginary**2


def asymmetric() -> tuple[PotentialTop, State]:
    """A heavy body of three moments, its centre of mass off every axis: not integrable (Ziglin 1982), and chaotic here.

    Studied by Galgani, Giorgilli & Strelcyn 1981, Nuovo Cimento B 61.
    """
    top = heavy_top([1.0, 2.0, 3.0], [0.5, 0.4, 1.0])
    return top, top.state(so3.exp(jnp.array([1.2, 0.5, -0.2])), angular_velocity=[0.4, 0.9, 0.6])


def examples() -> dict[str, Any]:
    """Lagrange's top, Kovalevskaya's, and an asymmetric one."""
    return {
        "lagrange": (*lagrange(), 0.01),
        "kovalevskaya": (*kovalevskaya(), 0.05),
        "asymmetric_top": (*asymmetric(), 0.05),
    }
