"""Pseudo-rigid bodies: homogeneous deformations of an elastic body, on T*GL⁺(3) (Section 6.1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import overload

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Matrix3, MomentumMap, Scalar, Vector3
from lieint_jax.core import State, StoredEnergy, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractDeformingBody, AbstractElasticBody, AbstractViscousBody
from lieint_jax.systems._shared.arguments import check_counts, explained, timed
from lieint_jax.systems._shared.stored_energy import (
    MooneyRivlin,
    NeoHookean,
    SaintVenantKirchhoff,
    as_stored_energy,
    mooney_rivlin,
    neo_hookean,
    saint_venant_kirchhoff,
)

__all__ = [
    "MooneyRivlin",
    "NeoHookean",
    "PseudoRigidBody",
    "SaintVenantKirchhoff",
    "StoredEnergy",
    "ViscousBody",
    "mooney_rivlin",
    "neo_hookean",
    "pseudo_rigid_body",
    "saint_venant_kirchhoff",
]


class DeformingBody(AbstractDeformingBody):
    """The methods of all bodies that deform homogeneously, which create and evaluate states."""

    _clock = None  # the time and the work of a state that is given none

    @explained
    def state(
        self,
        deformation: ArrayLike | None = None,
        *,
        momentum: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
        t: ArrayLike | None = None,
        work: ArrayLike | None = None,
    ) -> State:
        """The state of a deformation and one of three ways to give the motion.

        Args:
            deformation: F, shape (3, 3), det F > 0; by default 1.
            momentum: P = VE, shape (3, 3).
            velocity: V = Ḟ, shape (3, 3).
            angular_velocity: ω in space, shape (3,): V = ω̂F, a rigid rotation. With E = 2·1 and F = 1, as in the
                paper's figures, P = 2ω̂ and the paper's momentum is Φ = 2ω.
            t: the time; by default 0 for a viscous body, otherwise None.
            work: the work done on the body so far; by default 0 for a viscous body, whose losses are negative work,
                otherwise None.

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or det F ≤ 0.
        """
        F = jnp.eye(3) if deformation is None else _checks.real_array("deformation", deformation, (3, 3))
        _orientation("deformation", F)
        name, given = _checks.one_of(momentum=momentum, velocity=velocity, angular_velocity=angular_velocity)
        P = _checks.real_array(name, given, (3,) if name == "angular_velocity" else (3, 3))
        if name == "angular_velocity":
            P = so3.hat(P) @ F
        if name != "momentum":
            P = P @ (jnp.diag(self.inertia) if self.inertia.ndim == 1 else self.inertia)
        dtype = jnp.result_type(F, P)
        state = State(F.astype(dtype), P.astype(dtype))
        t, work = self._clock if t is None else t, self._clock if work is None else work
        return state if t is None and work is None else timed(state, 0.0 if t is None else t, work)

    def strain(self, state: State) -> Matrix3:
        """C = FᵀF, shape (3, 3)."""
        return vectors.matrix(state.q).gram().rows.array

    def energy(self, state: State) -> Scalar:
        """½⟨P, PE⁻¹⟩ + W(FᵀF) (6.2)."""
        return jnp.sum(state.p * self.velocity(state)) / 2 + self.stored_energy(self.strain(state))

    def momentum(self, state: State) -> MomentumMap:
        """Φ = rot[PFᵀ] (6.4), shape (3,), the paper's momentum map of rotations in space: ξ·Φ = ½⟨P, ξ̂F⟩."""
        return so3.vee((vectors.matrix(state.p) @ vectors.matrix(state.q).T).array)

    def angular_momentum(self, state: State) -> Vector3:
        """∫ρ x × ẋ = 2 rot[PFᵀ], shape (3,): the physical angular momentum, twice the paper's (6.4)."""
        return 2 * self.momentum(state)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or the system is a batch of systems."""
        _checks.of_one_system("inertia", self.inertia)
        _orientation("state.q", _checks.real_array("state.q", state.q, (3, 3)))
        _checks.real_array("state.p", state.p, (3, 3))
        check_counts(state)


@pytree
class PseudoRigidBody(DeformingBody, AbstractElasticBody):
    """H = ½⟨P, PE⁻¹⟩ + W(FᵀF) (6.2); Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) (6.3). Made by `pseudo_rigid_body`."""

    inertia: Array
    stored_energy: StoredEnergy


@pytree
class ViscousBody(DeformingBody, AbstractViscousBody):
    """A `PseudoRigidBody` with the stress 2∇W(C) + νĊ, C = FᵀF. Made by `pseudo_rigid_body`."""

    inertia: Array
    stored_energy: StoredEnergy
    viscosity: Array
    _clock = 0.0


@overload
def pseudo_rigid_body(
    inertia: ArrayLike, stored_energy: StoredEnergy | Callable[[Array], Array], viscosity: None = None
) -> PseudoRigidBody: ...
@overload
def pseudo_rigid_body(
    inertia: ArrayLike, stored_energy: StoredEnergy | Callable[[Array], Array], viscosity: ArrayLike
) -> ViscousBody: ...
def pseudo_rigid_body(
    inertia: ArrayLike, stored_energy: StoredEnergy | Callable[[Array], Array], viscosity: ArrayLike | None = None
) -> PseudoRigidBody | ViscousBody:
    """A pseudo-rigid body: an elastic body that deforms homogeneously, x = F X, about its center of mass.

    Args:
        inertia: E, the second moments of mass in the reference placement: principal (3,) or a symmetric (3, 3), or a
            Shape. For a ball of mass m and radius r it is (m r²/5)·1. (The inertia of the rigid body is tr(E) 1 − E.)
        stored_energy: `mooney_rivlin(lam, mu)`, `neo_hookean`, `saint_venant_kirchhoff`, or any callable W(C) of
            C = FᵀF, shape (3, 3).
        viscosity: ν ≥ 0, an energy times a time: a stress νĊ, which dissipates the power ½ν|Ċ|². `schemes.additive`
            with its rule "average" conserves the momentum of such a body and H − W, where W, `State.work`, is minus the
            energy lost. By default the body is elastic.

    Raises:
        ValueError: E not positive definite or not symmetric, a wrong shape, W not callable or not a scalar, ν < 0.

    Source: Cohen & Muncaster 1988, The Theory of Pseudo-rigid Bodies; Lewis & Simo 1994, Section 6.

    Example:
        >>> body = pseudo_rigid_body([2.0, 2.0, 2.0], mooney_rivlin(lam=2000.0, mu=6.0))
        >>> state = body.state(angular_velocity=[0.0, 0.0, 3.0])
        >>> float(body.energy(state))
        18.0
    """
    E, W = second_moments(inertia), as_stored_energy(stored_energy)
    if viscosity is None:
        return PseudoRigidBody(E, W)
    nu = _checks.real_array("viscosity", viscosity, ())
    if concrete(nu) and not float(nu) >= 0:
        raise ValueError(f"viscosity must be ≥ 0, got {float(nu):g}")
    return ViscousBody(E, W, nu)


def second_moments(value: ArrayLike) -> Array:
    """E of an elastic body, (3,) or (3, 3): as given, or that of a Shape, whose `inertia` is tr(E) 1 − E."""
    return _checks.positive_definite("inertia", _checks.of_shape("inertia", value, "second"))


def _orientation(name: str, F: Matrix3) -> None:
    if concrete(F) and not np.linalg.det(np.asarray(F, float)) > 0:
        raise ValueError(f"det {name} must be positive (a body cannot be inverted), got\n{np.asarray(F)}")


PROPERTIES = SystemProperties(
    name="pseudo_rigid_body",
    models="an elastic body that deforms homogeneously",
    phase_space="T*GL⁺(3): F, P",
    conserves=("energy (elastic)", "energy less work", "momentum"),
    momentum="Φ = rot[PFᵀ], half the angular momentum",
    sizes=(3,),
    aliases=("homogeneous elasticity", "Dirichlet's problem with elasticity"),
    source="Cohen & Muncaster 1988; Lewis & Simo 1994, Section 6",
)


def examples() -> dict[str, tuple[PseudoRigidBody | ViscousBody, State, float]]:
    """The ball of the paper's Figure 3b, and a viscous one."""
    ball = pseudo_rigid_body(np.full(3, 2.0), mooney_rivlin(2000.0, 6.0))
    dough = pseudo_rigid_body(np.full(3, 2.0), mooney_rivlin(2000.0, 6.0), viscosity=0.5)
    spin = np.array([0.0, 0.0, 1.0])
    return {
        "ball": (ball, ball.state(angular_velocity=spin), 0.005),
        "dough": (dough, dough.state(angular_velocity=spin), 0.005),
    }
