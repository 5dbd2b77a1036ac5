"""Incompressible pseudo-rigid bodies: homogeneous deformations at constant volume, on T*SL(3) (Sections 1.1, 6.1.1)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import Matrix3, Scalar, Vector3
from lieint_jax.core import Converted, State, StoredEnergy, argument, pytree
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractIncompressibleBody
from lieint_jax.systems._pseudo_rigid_body import DeformingBody, PseudoRigidBody, second_moments
from lieint_jax.systems._shared.arguments import explained
from lieint_jax.systems._shared.stored_energy import as_stored_energy, mooney_rivlin

__all__ = ["IncompressibleBody", "incompressible_body"]


@pytree
class IncompressibleBody(DeformingBody, AbstractIncompressibleBody):
    """An elastic body that deforms homogeneously at constant volume, about its center of mass: F in SL(3).

    H = ½⟨P, PE⁻¹⟩ + W(FᵀF), det F = 1; Ḟ = PE⁻¹, Ṗ = −2F∇W + pF⁻ᵀ. The pressure p enforces det F = 1:
    p tr(C⁻¹E⁻¹) = tr(SE⁻¹) + tr((F⁻¹Ḟ)²) with S = 2∇W(C).

    Energy and the angular momentum 2 rot[PFᵀ] are conserved. `schemes.additive(body, "incompressible")` conserves both
    and det F = 1 to round-off. Without elasticity, W = 0, this is the motion of an ideal fluid ellipsoid with a linear
    velocity and no gravity (Dirichlet's problem), a geodesic of SL(3).

    Args:
        inertia: E, as in `pseudo_rigid_body`.
        stored_energy: W, as in `pseudo_rigid_body`; its dependence on det C has no effect.

    Raises:
        ValueError: as in `pseudo_rigid_body`.

    Source: Lewis & Simo 1994, Sections 1.1 and 6.1.1; Arnold 1966 for W = 0.

    Example:
        >>> body = incompressible_body([2.0, 2.0, 2.0], mooney_rivlin(lam=2000.0, mu=6.0))
        >>> state = body.state(angular_velocity=[0.0, 0.0, 3.0])
        >>> float(body.energy(state))
        18.0
    """

    inertia: Converted[Array] = argument(converter=second_moments)
    stored_energy: Converted[StoredEnergy] = argument(converter=as_stored_energy)

    @property
    def compressible(self) -> PseudoRigidBody:
        """The same body without the constraint."""
        return PseudoRigidBody(self.inertia, self.stored_energy)

    @explained
    def state(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        deformation: ArrayLike | None = None,
        *,
        momentum: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
    ) -> State:
        """The state of a deformation and one of three ways to give the motion, as in `pseudo_rigid_body`.

        Args:
            deformation: F, shape (3, 3), det F = 1 to 1e-6; by default 1. It is divided by the cube root of det F.
            momentum: P = VE, shape (3, 3).
            velocity: V = Ḟ, shape (3, 3). V or P is projected to constant volume, orthogonally in the metric of the
                kinetic energy.
            angular_velocity: ω in space, shape (3,): V = ω̂F, a rigid rotation.

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or det F ≠ 1.
        """
        state = super().state(deformation, momentum=momentum, velocity=velocity, angular_velocity=angular_velocity)
        _volume("deformation", state.q)
        q = state.q / jnp.cbrt(jnp.linalg.det(state.q))
        space = self.phase_space
        return State(q, space.tangential(q, space.spatial_momentum(State(q, state.p))))

    def circulation(self, state: State) -> Vector3:
        """rot[FᵀP], shape (3,): the vorticity in the reference state, which a liquid of equal particles conserves.

        It is conserved where E and W depend on no direction in the body, as for `self_gravity` of a ball. The additive
        schemes conserve it to their order.
        """
        K = state.q.T @ state.p
        return jnp.stack([K[2, 1] - K[1, 2], K[0, 2] - K[2, 0], K[1, 0] - K[0, 1]])

    def volume_rate(self, state: State) -> Scalar:
        """tr(VF⁻¹), which is 0 on T*SL(3), and O(Δt²) after a step, see `schemes.additive`."""
        return jnp.trace(jnp.linalg.solve(state.q, self.velocity(state)))

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        super().check(state)
        _volume("state.q", state.q)


def _volume(name: str, F: Matrix3) -> None:
    if not concrete(F):
        return
    det, allowed = float(np.linalg.det(np.asarray(F, float))), _checks.UNIT_TOLERANCE
    if not abs(det - 1) <= allowed:
        raise ValueError(f"det {name} must be 1 to {allowed:g}, got {det:.9g}; divide {name} by its cube root")


incompressible_body = IncompressibleBody
PROPERTIES = SystemProperties(
    name="incompressible_body",
    models="an elastic body that deforms homogeneously at constant volume",
    phase_space="T*SL(3): F, P",
    conserves=("energy", "momentum", "volume"),
    momentum="Φ = rot[PFᵀ], half the angular momentum",
    sizes=(3,),
    aliases=("incompressible pseudo-rigid body", "Dirichlet–Riemann ellipsoid without gravity"),
    source="Lewis & Simo 1994, Sections 1.1 and 6.1.1",
)


def examples() -> dict[str, tuple[IncompressibleBody, State, float]]:
    """The ball of the paper's Figure 3, at constant volume, strained and spinning."""
    ball = incompressible_body(np.full(3, 2.0), mooney_rivlin(2000.0, 6.0))
    F = np.array([[1.25, 0.1, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 0.8]])
    return {"ball": (ball, ball.state(F, angular_velocity=np.array([0.3, 0.0, 1.0])), 0.02)}
