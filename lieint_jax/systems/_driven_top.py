"""A rigid body in a potential that is a given function of time: its axis moves, its strength changes, or both."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, capabilities
from lieint_jax._checks import concrete
from lieint_jax._xla import unfused
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._heavy_top import LinearPotential
from lieint_jax.systems._rigid_body import RigidBody
from lieint_jax.systems._shared.body import TimedBody
from lieint_jax.types import State, System, callable_pytree, check_gradient, clock, pytree, vectors
from lieint_jax.types.shapes import Matrix3, MomentumMap, Scalar, Time, Vector3

__all__ = ["DrivenTop", "driven_top"]


class MovedBody(TimedBody, capabilities.AbstractDrivenTop):
    """The methods of all driven tops, which differ in the origin of their potential and axis."""

    @property
    def free(self) -> RigidBody:
        """The free body of this inertia, without the potential."""
        return RigidBody(self.inertia)

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


@pytree
class DrivenTop(MovedBody):
    """H = ½ Π·J⁻¹Π + V: Λ̇ = ΛΩ̂, π̇ = γ × ΛDṼ(Γ, t) with Γ = Λᵀγ(t) (4.2). Made by `driven_top`.

    Energy is not conserved; energy less work is, with work = ∫∂V/∂t dt.
    """

    inertia: Array
    potential: Callable[[Array, Array], Array]
    axis: Callable[[Array], Array] | Array | None


def driven_top(
    inertia: ArrayLike,
    potential: Callable[[Array, Array], Array],
    axis: ArrayLike | Callable[[Array], Array] | None = (0.0, 0.0, 1.0),
) -> DrivenTop:
    """A rigid body with a fixed point in a potential that is a given function of time.

    Energy less work is conserved, and γ·π if the axis γ is constant.

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
    inertia = _checks.inertia(inertia)
    if not callable(potential):
        raise ValueError(f"potential must be a function of {_argument(axis)}, got {potential!r}")
    if callable(axis):
        axis = callable_pytree(axis)
        _checks.function("axis", axis, "t, the time", (3,), jnp.zeros((), inertia.dtype))
    elif axis is not None:
        given, axis = axis, _checks.real_array("axis", axis, (3,), like=inertia)
        if concrete(given) and not np.any(np.asarray(given)):
            raise ValueError("axis must not be zero; without a symmetry axis give axis=None and a potential of Λ and t")
    made = DrivenTop(inertia, callable_pytree(potential), axis)
    q, t = jnp.zeros(4, inertia.dtype), jnp.zeros((), inertia.dtype)
    _checks.function("potential", made.potential_energy, _argument(axis), (), q, t)
    check_gradient(made.potential, inertia.dtype, driven=True)
    return made


def _argument(axis: object) -> str:
    return "(Λ, t), the rotation matrix (3, 3) and the time" if axis is None else "(Γ, t), Γ = Λᵀγ (3,) and the time"


def _swing(t: Time) -> Vector3:
    """A vertical that nutates and precesses."""
    return jnp.stack([0.3 * jnp.sin(0.7 * t), 0.2 * jnp.cos(1.1 * t), jnp.ones_like(t)])


def _pulse(Gamma: Vector3, t: Time) -> Scalar:
    """A nonlinear function of Γ, along a fixed axis, with oscillating strength."""
    return (1 + 0.4 * jnp.cos(0.9 * t)) * (0.5 * Gamma[0] + 0.3 * Gamma[2] ** 2 + 0.2 * jnp.sin(Gamma[1]))


def _wells(R: Matrix3, t: Time) -> Scalar:
    """Two potential wells that alternate in time."""
    return 0.3 * jnp.cos(0.8 * t) * (R[0, 0] + R[1, 2]) + 0.2 * R[2, 0] ** 2


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
