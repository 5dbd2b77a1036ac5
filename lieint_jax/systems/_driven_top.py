"""A rigid body in a potential that is a given function of time: its axis moves, its strength changes, or both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Matrix3, MomentumMap, Scalar, Time, Vector3
from lieint_jax._xla import unfused
from lieint_jax.core import Converted, State, System, argument, callable_pytree, check_gradient, clock, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractDrivenTop
from lieint_jax.systems._heavy_top import LinearPotential
from lieint_jax.systems._potential_top import checked_axis
from lieint_jax.systems._rigid_body import WithFreeBody
from lieint_jax.systems._shared.body import TimedBody, as_inertia

__all__ = ["DrivenTop", "driven_top"]


class MovedBody(WithFreeBody, TimedBody, AbstractDrivenTop):
    """The methods of all driven tops, which differ in the origin of their potential and axis."""

    def axis_at(self, t: Time) -> Vector3:
        """γ(t) in space, shape (3,)."""
        if self.axis is None:
            raise ValueError("this potential has no axis γ: it is a function of Λ and t (see driven_top)")
        if not callable(self.axis):
            return self.axis
        # Without the barrier XLA works out an orbit again for each of a batch of bodies that share t: 6 times slower.
        return unfused(self.axis(t))

    def Gamma(self, state: State) -> Vector3:
        """Γ = Λᵀγ(t), the axis in the body, shape (3,)."""
        return so3.Ad_star(state.q, self.axis_at(clock(state)))

    def energy(self, state: State) -> Scalar:
        """½ Π·J⁻¹Π + V."""
        return self.kinetic_energy(state) + self.potential_energy(state.q, clock(state))

    def momentum(self, state: State) -> MomentumMap:
        """γ·π, shape (1,), if the axis is constant, so that rotations about it are a symmetry; otherwise shape (0,)."""
        moves = self.axis is None or callable(self.axis)
        return state.p[:0] if moves else vectors.dot(self.axis, state.p)[None]

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or has no time."""
        super().check(state)
        clock(state)


def _axis(given: Any, like: Array | None = None) -> Callable[[Array], Array] | Array | None:
    """γ, a function of time or constant."""
    if not callable(given):
        return checked_axis(given, like, "Λ and t")
    axis = callable_pytree(given)
    _checks.function("axis", axis, "t, the time", (3,), jnp.zeros((), None if like is None else like.dtype))
    return axis


@pytree
class DrivenTop(MovedBody):
    """A rigid body with a fixed point in a potential that is a given function of time.

    H = ½ Π·J⁻¹Π + V: Λ̇ = ΛΩ̂, π̇ = γ × ΛDṼ(Γ, t) with Γ = Λᵀγ(t) (4.2). Energy less work is conserved, with
    work = ∫∂V/∂t dt, and γ·π if the axis γ is constant.

    Args:
        inertia: about the fixed point: principal moments (3,) or a symmetric tensor (3, 3).
        potential: with an axis, Ṽ(Γ, t) of Γ = Λᵀγ(t), (3,), and the time; without one, V(Λ, t) of the rotation matrix
            (3, 3). A smooth JAX function with a scalar value; parameters to be differentiated or batched go into a
            `jax.tree_util.Partial`. It may provide its discrete gradient at a frozen time as a method
            `discrete_gradient(a, b, t)` (see `potential_top`).
        axis: γ in space: a smooth function of t with values (3,), or a constant of any length but 0; None for V(Λ, t).

    Raises:
        ValueError: bad inertia; the axis is not a vector, or zero; the potential is not a scalar function of both.

    Source: Lewis & Simo 1994, (4.2), with γ(t).

    Example: a heavy top whose support shakes up and down.

        >>> top = driven_top([1.0, 2.0, 3.0], lambda Gamma, t: (1 + 0.3 * jnp.sin(2 * t)) * Gamma[2])
        >>> state = top.state(angular_velocity=[0.1, 0.2, 1.0], t=0.0, work=0.0)
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    potential: Converted[Callable[[Array, Array], Array]] = argument(converter=callable_pytree)
    axis: Converted[Callable[[Array], Array] | Array | None] = argument(
        converter=_axis, like="inertia", default=(0.0, 0.0, 1.0)
    )

    def check_fields(self) -> None:
        """Raise ValueError if the potential is no function of Γ and t, or without an axis of Λ and t."""
        fixed = self.axis is None
        of = "(Λ, t), the rotation matrix (3, 3) and the time" if fixed else "(Γ, t), Γ = Λᵀγ (3,) and the time"
        if not callable(self.potential):
            raise ValueError(f"potential must be a function of {of}, got {self.potential!r}")
        dtype = self.inertia.dtype
        _checks.function("potential", self.potential_energy, of, (), jnp.zeros(4, dtype), jnp.zeros((), dtype))
        check_gradient(self.potential, dtype, driven=True)


def _swing(t: Time) -> Vector3:
    """A vertical that nutates and precesses."""
    return jnp.stack([0.3 * jnp.sin(0.7 * t), 0.2 * jnp.cos(1.1 * t), jnp.ones_like(t)])


def _pulse(Gamma: Vector3, t: Time) -> Scalar:
    """A nonlinear function of Γ, along a fixed axis, with oscillating strength."""
    return (1 + 0.4 * jnp.cos(0.9 * t)) * (0.5 * Gamma[0] + 0.3 * Gamma[2] ** 2 + 0.2 * jnp.sin(Gamma[1]))


def _wells(R: Matrix3, t: Time) -> Scalar:
    """Two potential wells that alternate in time."""
    return 0.3 * jnp.cos(0.8 * t) * (R[0, 0] + R[1, 2]) + 0.2 * R[2, 0] ** 2


driven_top = DrivenTop
PROPERTIES = SystemProperties(
    name="driven_top",
    models="a rigid body in a potential that is a given function of time",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy less work", "momentum (about an axis at rest)"),
    momentum="γ·π about a constant axis, or none",
    sizes=(1, 0),
    aliases=("parametrically driven top",),
    source="Lewis & Simo 1994, (4.2), with γ(t)",
)


def examples() -> dict[str, tuple[System, State, float]]:
    """A top whose vertical moves, one whose field changes its strength, and one without an axis."""
    J, attitude = [1.0, 2.0, 2.5], so3.exp(jnp.array([0.7, 0.5, -0.2]))
    tops = {
        "moving_axis": driven_top(J, LinearPotential(jnp.array([0.5, 0.4, 1.0])), _swing),
        "changing_strength": driven_top(J, _pulse),
        "two_wells": driven_top(J, _wells, None),
    }
    return {
        name: (top, top.state(attitude, angular_velocity=[0.4, 0.6, -0.3], t=0.4, work=0.0), 0.05)
        for name, top in tops.items()
    }
