"""Several rigid bodies: free, in a potential of their positions and attitudes, or with dissipation between pairs."""

from __future__ import annotations

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax import potentials
from lieint_jax.capabilities._capability import Capability, equation
from lieint_jax.capabilities._forces import AbstractForcedSystem
from lieint_jax.capabilities._one_body import AbstractFreeBody
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentMotions
from lieint_jax.types import PhaseSpace, State, autodiff_gradient, pair_forces
from lieint_jax.types.shapes import Inertia, PoseMomenta, Poses, Positions, PyTree, Rotations
from lieint_jax.types.vectors import symmetric


class AbstractManyBodies(Capability):
    """N rigid bodies: ẋ = p/m, q̇ = ½ q Ω.

    A state is q (N, 7), position and quaternion of each, and p (N, 6), linear and spatial angular momentum.

    Attributes:
        masses: (N,).
        inertias: J, principal moments (N, 3) or tensors (N, 3, 3).
    """

    masses: Array
    inertias: Array

    @property
    def phase_space(self) -> PhaseSpace:
        return CotangentMotions(self.masses.shape[0])

    @equation
    def angular_velocities(self, state: State) -> Positions:
        """The body angular velocities Ω = J⁻¹Λᵀπ, (N, 3)."""
        Pi = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:])
        return jax.vmap(lambda J, Pi: jnp.stack(symmetric(J).solve(Pi)))(self.inertias, Pi)


class AbstractFreeBodies(AbstractManyBodies):
    """N free rigid bodies: ẋ = p/m, q̇ = ½ q Ω, ṗ = 0, π̇ = 0.

    A state is q (N, 7), position and quaternion of each, and p (N, 6), linear and spatial angular momentum.

    Attributes:
        masses: (N,).
        inertias: J, principal moments (N, 3) or tensors (N, 3, 3).
    """

    noun = "free rigid bodies (systems.rigid_bodies(...).free)"

    @abc.abstractmethod
    def single_body(self, inertia: Inertia) -> AbstractFreeBody:
        """A free body of this inertia."""

    @equation
    def vector_field(self, state: State) -> State:
        """ẋ = p/m, Λ̇ = ΛΩ̂, ṗ = 0, π̇ = 0."""
        turning = jax.vmap(so3.tangent)(state.q[:, 3:], self.angular_velocities(state))
        q_dot = jnp.concatenate([state.p[:, :3] / self.masses[:, None], turning], axis=1)
        return State(q_dot, jnp.zeros_like(state.p))


class AbstractRigidBodies(AbstractForcedSystem, AbstractManyBodies):
    """N rigid bodies in a potential: as `AbstractFreeBodies`, with forces and torques.

    Attributes:
        masses, inertias: as in `AbstractFreeBodies`.
        potential: (positions (N, 3), rotations (N, 3, 3)) ↦ V.
    """

    noun = "bodies that act on one another (systems.rigid_bodies)"
    potential: Callable[[Array, Array], Array]

    @equation
    def force(self, q: Poses) -> PoseMomenta:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)Λ)/∂δ in space, (N, 6)."""
        R = rotations(q)
        if hasattr(self.potential, "force"):
            return self.potential.force(q[:, :3], R)  # pyright: ignore
        along_x, along_R = autodiff_gradient(self.potential, (0, 1))(q[:, :3], R)
        return jnp.concatenate([-along_x, potentials.torques(R, along_R)], axis=1)


class AbstractDissipativeBodies(AbstractManyBodies):
    """N rigid bodies in a potential, with dissipative forces between pairs: as `AbstractRigidBodies`, plus these
    forces.

    H − W is conserved, with W the work of the dissipative forces, and so are both momenta if the potential is
    invariant.

    Attributes:
        masses, inertias, potential: as in `AbstractRigidBodies`.
        dissipation: a `PairLaw`, or a function (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j).
    """

    noun = "bodies with dissipation (systems.rigid_bodies)"
    potential: Callable[[Array, Array], Array]
    dissipation: Callable[..., PyTree]

    @property
    @abc.abstractmethod
    def conservative(self) -> AbstractRigidBodies:
        """The same bodies without the law."""

    @equation
    def dissipative_force(self, state: State) -> tuple[Array, Array]:
        """The forces and torques of the law in space, (N, 6), and the power dissipated."""
        omega = jax.vmap(so3.Ad)(state.q[:, 3:], self.angular_velocities(state))
        return pair_forces(self.dissipation, state.q[:, :3], state.p[:, :3] / self.masses[:, None], omega)

    @equation
    def vector_field(self, state: State) -> State:
        """The motion with the forces and torques of potential and dissipation, and the rate of the work."""
        moving, (force, lost) = self.conservative.vector_field(state), self.dissipative_force(state)
        return moving._replace(p=moving.p + force, work=-lost)


def rotations(q: Poses) -> Rotations:
    """The rotation matrices of the bodies, (N, 3, 3)."""
    return jax.vmap(so3.to_matrix)(q[:, 3:])
