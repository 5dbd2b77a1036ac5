"""Potentials and stored energies that have their derivatives in closed form, and those of any others."""

from __future__ import annotations

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from lieint_jax._checks import closed_form
from lieint_jax._numerics.arrays import Matrix3, Scalar, Time, Vector3
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax._numerics.vectors import Symmetric

__all__ = ["PotentialWithGradient", "StoredEnergy", "check_gradient", "gradient"]


class PotentialWithGradient(abc.ABC):
    """A potential Ṽ(Γ) or Ṽ(Γ, t) of tops with its gradient in closed form, which costs far less than autodiff.

    Attributes:
        linear: whether it is linear in Γ, so that its gradient is constant.
    """

    linear: bool = False

    @abc.abstractmethod
    def __call__(self, Gamma: Vector3, t: Time | None = None) -> Scalar: ...

    @abc.abstractmethod
    def gradient(self, Gamma: Vector3, t: Time | None = None) -> Vector3:
        """∇Ṽ, shape (3,)."""


def gradient(potential: Callable[..., Array], Gamma: Vector3, *t: Array) -> Array:
    """∇Ṽ(Γ) or ∇Ṽ(Γ, t), shape (3,), of any potential of tops."""
    known = isinstance(potential, PotentialWithGradient)
    return potential.gradient(Gamma, *t) if known else autodiff_gradient(potential)(Gamma, *t)


def check_gradient(potential: Callable[..., Array], dtype: DTypeLike, driven: bool = False) -> None:
    """Raise ValueError if the gradient that a user's potential has in closed form is not that of its values."""
    if not isinstance(potential, PotentialWithGradient):
        return

    def arguments() -> list[Array]:
        return [jnp.array([0.48, -0.6, 0.64], dtype), *[jnp.zeros((), dtype)] * driven]

    closed_form(
        potential, "gradient", lambda: potential.gradient(*arguments()), lambda: jax.grad(potential)(*arguments())
    )


class StoredEnergy(abc.ABC):
    """W(C), an energy, of the right Cauchy–Green tensor C = FᵀF, shape (3, 3).

    Symmetric tensors are tuples of six entries (xx, yy, zz, yz, xz, xy) with operators, see `_numerics.vectors`.
    """

    @abc.abstractmethod
    def __call__(self, C: Matrix3) -> Scalar: ...

    @abc.abstractmethod
    def stress(self, C: Symmetric) -> tuple[Array, ...]:
        """S = 2∇W(C)."""

    @abc.abstractmethod
    def mean_stress(self, C: Symmetric, D: Symmetric) -> tuple[Array, ...]:
        """S̄ with ½ S̄:D = W(C + D) − W(C)."""
