"""A rigid body with one point fixed, in any potential (Section 4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Matrix3, MomentumMap, Scalar, Time, Vector3
from lieint_jax.core import Converted, PotentialWithGradient, State, argument, callable_pytree, check_gradient, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractTop
from lieint_jax.systems._rigid_body import WithFreeBody
from lieint_jax.systems._shared.body import Body, as_inertia

__all__ = ["PotentialTop", "QuadraticPotential", "clebsch_integral", "potential_top"]


@pytree
class QuadraticPotential(PotentialWithGradient):
    """Ṽ(Γ) = ½ Γ·SΓ: a field that grows linearly along γ, which is fixed in space, as in Brun's problem (S = εJ).

    The gravity gradient has this form too (S = 3n²J), but its γ points to the center of attraction and rotates along
    the orbit: this potential is that of a body at a fixed position, not of a satellite.
    """

    matrix: Array

    def __call__(self, Gamma: Vector3, t: Time | None = None) -> Scalar:
        del t  # there for driven tops
        return vectors.dot(Gamma, vectors.symmetric(self.matrix) @ Gamma) / 2

    def gradient(self, Gamma: Vector3, t: Time | None = None) -> Vector3:
        """SΓ."""
        del t
        return jnp.stack(vectors.symmetric(self.matrix) @ Gamma)

    def discrete_gradient(self, a: Vector3, b: Vector3, t: Time | None = None) -> Vector3:
        """S·½(a + b)."""
        return self.gradient((a + b) / 2, t)


def checked_axis(given: Any, like: Array | None = None, of: str = "Λ") -> Array | None:
    """γ, (3,); None for a potential `of` the rotation matrix."""
    if given is None:
        return None
    axis = _checks.real_array("axis", given, (3,), like=like)
    if concrete(given) and not np.any(np.asarray(given)):
        raise ValueError(f"axis must not be zero; without a symmetry axis give axis=None and a potential of {of}")
    return axis


@pytree
class PotentialTop(WithFreeBody, Body, AbstractTop):
    """A rigid body with a fixed point in a potential. Its motion conserves energy, and γ·π if there is an axis γ.

    H = ½ Π·J⁻¹Π + V: Λ̇ = ΛΩ̂, π̇ = γ × ΛDṼ(Γ) with Γ = Λᵀγ (4.2).

    Args:
        inertia: about the fixed point: principal moments (3,) or a symmetric tensor (3, 3).
        potential: with an axis, Ṽ(Γ) of Γ = Λᵀγ, (3,): any potential symmetric about γ. Without one, V(Λ) of the
            rotation matrix (3, 3). A smooth JAX function with a scalar value; parameters to be differentiated or
            batched go into a `jax.tree_util.Partial`. It may provide its discrete gradient D̄, symmetric and with
            D̄·(b − a) = Ṽ(b) − Ṽ(a), as a method `discrete_gradient(a, b)`, as `QuadraticPotential` does.
        axis: γ in space, shape (3,), of any length but 0; None for a V(Λ).

    Raises:
        ValueError: bad inertia; the axis is not a vector, or zero; the potential is not a scalar function.

    Source: Lewis & Simo 1994, (4.2).

    Example:
        >>> top = potential_top([1.0, 2.0, 3.0], lambda Gamma: Gamma[0] ** 4)
        >>> state = top.state(angular_velocity=[0.1, 0.2, 1.0])
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    potential: Converted[Callable[[Array], Array]] = argument(converter=callable_pytree)
    axis: Converted[Array | None] = argument(converter=checked_axis, like="inertia", default=(0.0, 0.0, 1.0))

    def check_fields(self) -> None:
        """Raise ValueError if the potential is no function of Γ, or without an axis of Λ."""
        of = "the rotation matrix Λ, shape (3, 3)" if self.axis is None else "Γ = Λᵀγ, shape (3,)"
        if not callable(self.potential):
            raise ValueError(f"potential must be a function of {of}, got {self.potential!r}")
        dtype = self.inertia.dtype
        _checks.function("potential", self.potential_energy, of, (), jax.ShapeDtypeStruct((4,), dtype))
        check_gradient(self.potential, dtype)

    def Gamma(self, state: State) -> Vector3:
        """Γ = Λᵀγ, the axis in the body, shape (3,)."""
        return so3.Ad_star(state.q, self._axis)

    @property
    def _axis(self) -> Vector3:
        if self.axis is None:
            raise ValueError("this potential has no axis γ: it is a function of Λ (see potential_top)")
        return self.axis

    def energy(self, state: State) -> Scalar:
        """½ Π·J⁻¹Π + V."""
        return self.kinetic_energy(state) + self.potential_energy(state.q)

    def momentum(self, state: State) -> MomentumMap:
        """γ·π, shape (1,): rotations about γ are a symmetry. Shape (0,) without an axis."""
        return state.p[:0] if self.axis is None else vectors.dot(self.axis, state.p)[None]


def brun() -> tuple[PotentialTop, State]:
    """Brun 1893, Öfvers. K. Vetensk. Akad.: V = (ε/2)Γ·JΓ, a body in a quadratic field.

    The system is integrable, with the further integral `clebsch_integral`.
    """
    J = jnp.array([1.0, 2.0, 3.0])
    top = potential_top(J, QuadraticPotential(0.8 * J), [0.0, 0.6, 0.8])
    return top, top.state(so3.exp(jnp.array([0.3, -0.8, 0.5])), angular_velocity=[0.4, 0.6, -0.3])


def clebsch_integral(top: PotentialTop, state: State, strength: float) -> Scalar:
    """|Π|² − ε det J Γ·J⁻¹Γ, constant for V = (ε/2)Γ·JΓ (Clebsch 1871)."""
    J, Pi, Gamma = vectors.symmetric(top.inertia), top.body_momentum(state), top.Gamma(state)
    return vectors.dot(Pi, Pi) - strength * J.det(J.adjugate) * vectors.dot(Gamma, J.solve(Gamma))


potential_top = PotentialTop
PROPERTIES = SystemProperties(
    name="potential_top",
    models="a rigid body with a fixed point, in any potential",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy", "momentum (with an axis)"),
    momentum="γ·π about the axis, or none",
    sizes=(1, 0),
    aliases=("Brun's problem", "Clebsch's case"),
    source="Lewis & Simo 1994, (4.2)",
)


def examples() -> dict[str, tuple[PotentialTop, State, float]]:
    """Brun's problem, a potential that has no axis, and one with a deep well."""
    tilted = potential_top([1.0, 2.0, 2.5], _three_wells, None)
    state = tilted.state(so3.exp(jnp.array([0.3, 0.1, 0.7])), angular_velocity=[0.2, 0.5, -0.4])
    return {"brun": (*brun(), 0.05), "three_wells": (tilted, state, 0.05), "attracted": (*_charged_body(), 0.02)}


def _charged_body() -> tuple[PotentialTop, State]:
    """A body with a charge on its third axis at distance 1 from the fixed point; an opposite one is in space at 1.2."""
    top = potential_top([1.0, 2.0, 2.5], _coulomb, [0.0, 0.0, 1.2])
    return top, top.state(so3.exp(jnp.array([1.6, 0.4, 0.0])), angular_velocity=[0.2, 0.3, 0.4])


def _coulomb(Gamma: Vector3) -> Scalar:
    return -1 / jnp.sqrt(1 + vectors.dot(Gamma, Gamma) - 2 * Gamma[2])


def _three_wells(R: Matrix3) -> Scalar:
    """A trace and a square of the rotation matrix: the misalignment of two frames, and a preferred axis."""
    return 0.3 * (3 - R[0, 0] - R[1, 1] - R[2, 2]) + 0.4 * R[2, 0] ** 2
