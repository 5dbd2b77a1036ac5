"""One rigid body with a fixed point in a potential of its attitude, constant in time or driven."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Quaternion, Scalar, Time, Vector3
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax._numerics.gradients import discrete_gradient as by_quadrature
from lieint_jax._numerics.vectors import cross
from lieint_jax.core import gradient
from lieint_jax.groups import so3
from lieint_jax.systems._equations.equation import equation
from lieint_jax.systems._equations.forces import AbstractDrivenSystem, AbstractForcedSystem
from lieint_jax.systems._equations.one_body import AbstractRotatingBody


class AbstractTop(AbstractForcedSystem, AbstractRotatingBody):
    """A rigid body in a potential Ṽ(Γ) of an axis, Γ = Λᵀγ: q̇ = ½ q Ω, π̇ = γ × Λ∇Ṽ(Γ) (4.2).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        potential: Ṽ; a function of Λ, (3, 3), if there is no axis.
        axis: γ in space, (3,), or None.
    """

    noun = "rigid bodies in a potential with an axis (systems.heavy_top, systems.potential_top)"
    potential: Callable[[Array], Array]
    axis: Array | None

    @equation
    def potential_energy(self, q: Quaternion) -> Scalar:
        """V, a scalar, at an attitude."""
        if self.axis is None:
            return self.potential(so3.to_matrix(q))
        return self.potential(so3.Ad_star(q, self.axis))

    @equation
    def force(self, q: Quaternion) -> Vector3:
        """The torque of the potential in space, shape (3,). With an axis, γ × ΛDṼ(Γ) (4.1)."""
        if self.axis is None:
            return _spatial_torque(self.potential_energy, q)
        slope = gradient(self.potential, so3.Ad_star(q, self.axis))
        return jnp.stack(cross(self.axis, so3.Ad(q, slope)))


class AbstractDrivenTop(AbstractDrivenSystem, AbstractRotatingBody):
    """A rigid body in a potential Ṽ(Γ, t) of an axis that may move: (4.2) with Γ = Λᵀγ(t).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        potential: Ṽ, a function of Γ and t; of Λ, (3, 3), and t, if there is no axis.
        axis: γ, a function of time with values (3,) in space, a constant (3,), or None.
    """

    noun = "driven tops with an axis (systems.driven_top, systems.gravity_gradient)"
    potential: Any
    axis: Any

    @abc.abstractmethod
    def axis_at(self, t: Time, /) -> Vector3:
        """γ(t), shape (3,)."""

    @equation
    def potential_energy(self, q: Quaternion, t: Time) -> Scalar:
        """V, a scalar, at an attitude and a time."""
        if self.axis is None:
            return self.potential(so3.to_matrix(q), t)
        return self.potential(so3.Ad_star(q, self.axis_at(t)), t)

    @equation
    def force(self, q: Quaternion, t: Time) -> Vector3:
        """The torque of the potential in space, shape (3,). With an axis, γ × ΛDṼ(Γ, t) (4.1)."""
        if self.axis is None:
            return _spatial_torque(lambda turned: self.potential_energy(turned, t), q)
        axis = self.axis_at(t)
        slope = gradient(self.potential, so3.Ad_star(q, axis), t)
        return jnp.stack(cross(axis, so3.Ad(q, slope)))

    @equation
    def power(self, q: Quaternion, t: Time) -> Scalar:
        """∂V/∂t, a scalar: the rate of the energy due to the explicit time dependence of the potential."""
        return jax.jvp(lambda t: self.potential_energy(q, t), (t,), (jnp.ones_like(t),))[1]


def discrete_gradient(
    potential: Callable[..., Array], a: Vector3, b: Vector3, *, apart: float, at: tuple[Array, ...] = ()
) -> Vector3:
    """D̄ with D̄·(b − a) = Ṽ(b) − Ṽ(a) and D̄(a, b) = D̄(b, a), shape (3,), at a time if the potential has one.

    It is the potential's own, or else by quadrature, corrected above |b − a|² = `apart` |a|².
    """
    own = getattr(potential, "discrete_gradient", None)
    return by_quadrature(potential, a, b, apart, *at) if own is None else own(a, b, *at)


def _spatial_torque(potential: Callable[[Array], Array], q: Quaternion) -> Vector3:
    """The torque in space of a potential V(q), shape (3,): its i-th component is −d/dε V(exp(εeᵢ)q)."""
    return -autodiff_gradient(lambda theta: potential(so3.multiply(so3.exp(theta), q)))(jnp.zeros_like(q[:3]))
