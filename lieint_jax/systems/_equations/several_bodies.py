"""Several rigid bodies: free, in a potential of their positions and attitudes, or with dissipation and given forces."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax import potentials
from lieint_jax._numerics.arrays import Inertia, PoseMomenta, Poses, Positions, PyTree, Rotations, Scalar, Time
from lieint_jax._numerics.vectors import symmetric
from lieint_jax.core import ChainLaw, PhaseSpace, State, clock, pair_forces
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentMotions
from lieint_jax.systems._equations.equation import Equations, equation
from lieint_jax.systems._equations.forces import AbstractForcedSystem
from lieint_jax.systems._equations.one_body import AbstractFreeBody


class AbstractManyBodies(Equations):
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
    default_drift = "exact"

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
        return potentials.force(self.potential, q[:, :3], rotations(q))


class AbstractDissipativeBodies(AbstractManyBodies):
    """N rigid bodies in a potential, with dissipative forces between pairs, with given forces, or with both: as
    `AbstractRigidBodies`, plus these forces.

    H − W is conserved, with W their work, which given forces may raise. Dissipation conserves both momenta if the
    potential is invariant.

    Attributes:
        masses, inertias, potential: as in `AbstractRigidBodies`.
        dissipation: a `PairLaw`, a function (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j), a `ChainLaw`, or None.
        forces: a function (t, x, Λ, v, ω) ↦ (forces (N, 3), torques (N, 3)), or None; a system with it has a time.
    """

    noun = "bodies with dissipation or given forces (systems.rigid_bodies)"
    potential: Callable[[Array, Array], Array]
    dissipation: Callable[..., PyTree] | ChainLaw | None
    forces: Callable[..., PyTree] | None

    @property
    @abc.abstractmethod
    def conservative(self) -> AbstractRigidBodies:
        """The same bodies without dissipation and given forces."""

    def at(self, t: Time | None) -> AbstractRigidBodies:
        """The conservative bodies in the potential as it is at the time t."""
        return dataclasses.replace(self.conservative, potential=potentials.at_time(self.potential, t))  # pyright: ignore

    @equation
    def applied_force(self, t: Time | None, q: Poses, v: Positions, omega: Positions) -> tuple[PoseMomenta, Scalar]:
        """The forces and torques of dissipation and of `forces`, (N, 6), and their power; all in space."""
        force, power = jnp.zeros((q.shape[0], 6), q.dtype), jnp.zeros((), q.dtype)
        if isinstance(self.dissipation, ChainLaw):
            force, power = self.dissipation.act(t, q[:, :3], rotations(q), v, omega)
        elif self.dissipation is not None:
            force, lost = pair_forces(self.dissipation, q[:, :3], v, omega)
            power = -lost
        if self.forces is not None:
            pushes, turns = (jnp.asarray(x, q.dtype) for x in self.forces(t, q[:, :3], rotations(q), v, omega))
            force = force + jnp.concatenate([pushes, turns], axis=1)
            power = power + jnp.sum(pushes * v + turns * omega)
        return force, power

    @equation
    def vector_field(self, state: State) -> State:
        """The motion with all forces and torques, and the rate of the work."""
        omega = jax.vmap(so3.Ad)(state.q[:, 3:], self.angular_velocities(state))
        v = state.p[:, :3] / self.masses[:, None]
        moving, (force, power) = self.at(state.t).vector_field(state), self.applied_force(state.t, state.q, v, omega)
        if potentials.is_driven(self.potential):
            power += jax.jvp(lambda t: self.at(t).energy(state), (clock(state),), (jnp.ones_like(power),))[1]
        return moving._replace(p=moving.p + force, work=power)


def rotations(q: Poses) -> Rotations:
    """The rotation matrices of the bodies, (N, 3, 3)."""
    return jax.vmap(so3.to_matrix)(q[:, 3:])
