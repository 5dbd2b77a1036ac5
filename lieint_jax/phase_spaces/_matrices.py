"""T*GL⁺(3) and T*SL(3): phase spaces of homogeneous deformations (Section 6)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import DualVector, Matrix3, PhaseMatrix, PhaseVector, Scalar
from lieint_jax.core import State, pytree, static
from lieint_jax.groups import MatrixGroup
from lieint_jax.phase_spaces._entries import ByEntries
from lieint_jax.phase_spaces._groups import ByPerturbation, CotangentGroup


@pytree
class CotangentMatrices(ByEntries):
    """T*GL⁺(3) = GL⁺(3) × L(3), canonical: a state is (F, P), a tangent vector (δF, δP), row by row (6.1)."""

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 18."""
        return 18

    @property
    def origin(self) -> State:
        """F = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros((3, 3)))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """(F + δF, P + δP) for δ = (δF, δP), shape (18,)."""
        return state._replace(q=state.q + delta[:9].reshape(3, 3), p=state.p + delta[9:].reshape(3, 3))

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δF, δP), shape (18,)."""
        return jnp.concatenate([tangent.q.ravel(), tangent.p.ravel()])

    def omega(self, state: State) -> PhaseMatrix:
        """[[0, 1], [−1, 0]], shape (18, 18): ω(δ₁, δ₂) = ⟨δP₂, δF₁⟩ − ⟨δP₁, δF₂⟩ (6.1)."""
        one = jnp.eye(9, dtype=state.p.dtype)
        return jnp.block([[0 * one, one], [-one, 0 * one]])

    def defect(self, state: State) -> Scalar:
        """0 where det F > 0, 1 where F has left GL⁺(3) (an open set, from which no distance is defined)."""
        return jnp.where(vectors.matrix(state.q).det() > 0, 0, 1).astype(state.q.dtype)


@pytree
class CotangentUnimodular(ByPerturbation):
    """T*SL(3) as pairs (F, P) with det F = 1 and tr(PE⁻¹F⁻¹) = 0, the velocities PE⁻¹ being those of constant volume.

    Its coordinates are those of `CotangentGroup(SL(3))`: δF = δθ̂F, and δπ of π_i = ⟨P, e_i F⟩ for a basis e_i of
    sl(3).

    Attributes:
        inertia: E, (3,) or (3, 3).
        group: SL(3), of dimension 8, as a `groups.matrix.MatrixGroup`.
    """

    inertia: Array
    group: MatrixGroup = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 16."""
        return 16

    @property
    def origin(self) -> State:
        """F = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros((3, 3)))

    def spatial_momentum(self, state: State) -> DualVector:
        """π_i = ⟨P, e_i F⟩, shape (8,)."""
        return jnp.tensordot(self._basis(state), state.p @ state.q.T, 2)

    def tangential(self, q: Matrix3, pi: DualVector) -> Matrix3:
        """The P = ωFE, (3, 3), with ω in sl(3) and spatial momentum π at F."""
        E = jnp.diag(self.inertia) if self.inertia.ndim == 1 else self.inertia
        e = jnp.asarray(self.group.basis, q.dtype)
        carried = jnp.einsum("iab,bc->iac", e, q @ E @ q.T)
        M = jnp.einsum("iab,jab->ij", carried, e)
        return jnp.tensordot(jnp.linalg.solve(M, pi), e, 1) @ q @ E

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (16,): (exp(δθ̂)F, P); the normal part of P is unchanged."""
        pi, q = self.spatial_momentum(state), self.group.multiply(self.group.exp(delta[:8]), state.q)
        rest = state.p - self.tangential(state.q, pi)
        return state._replace(q=q, p=self.tangential(q, pi + delta[8:]) + rest)

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The δ, shape (16,), with perturb(start, δ) = end, of the least δθ."""
        turn = self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))
        return jnp.concatenate([turn, self.spatial_momentum(end) - self.spatial_momentum(start)])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (16,), of a tangent vector (δF, δP)."""
        change = jnp.tensordot(self._basis(state), tangent.p @ state.q.T + state.p @ tangent.q.T, 2)
        return jnp.concatenate([self.group.spatial_velocity(state.q, tangent.q), change])

    def omega(self, state: State) -> PhaseMatrix:
        """The symplectic form of T*SL(3) as a matrix, shape (16, 16) (5.9)."""
        return CotangentGroup(self.group).omega(State(state.q, self.spatial_momentum(state)))

    def defect(self, state: State) -> Scalar:
        """det F − 1."""
        return vectors.matrix(state.q).det() - 1

    def _basis(self, state: State) -> Array:
        return jnp.asarray(self.group.basis, state.q.dtype)
