"""Bodies that deform homogeneously: elastic, viscous, or of constant volume (Section 6)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Matrix3, Scalar
from lieint_jax._numerics.vectors import Matrix, Symmetric, matrix, symmetric
from lieint_jax.core import PhaseSpace, State, StoredEnergy
from lieint_jax.groups import special_linear
from lieint_jax.phase_spaces import CotangentMatrices, CotangentUnimodular
from lieint_jax.systems._equations.equation import Equations, equation

_PHASE_SPACE = CotangentMatrices()


class AbstractDeformingBody(Equations):
    """An elastic body that deforms homogeneously, on T*GL⁺(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) (6.3).

    Attributes:
        inertia: E, the second moments of mass, (3,) or (3, 3).
        stored_energy: W.
    """

    inertia: Array
    stored_energy: StoredEnergy

    @property
    def phase_space(self) -> PhaseSpace:
        return _PHASE_SPACE

    @equation
    def velocity(self, state: State) -> Matrix3:
        """V = Ḟ = PE⁻¹, shape (3, 3)."""
        E = symmetric(self.inertia)
        return Matrix(E.solve(row) for row in state.p).array

    @equation
    def vector_field(self, state: State) -> State:
        """(Ḟ, Ṗ) = (PE⁻¹, −F S), S = 2∇W(FᵀF) (6.3)."""
        F = matrix(state.q)
        S = Symmetric(self.stored_energy.stress(F.gram()))
        return State(self.velocity(state), -(F @ S).array)


class AbstractElasticBody(AbstractDeformingBody):
    """A body that deforms homogeneously, on T*GL⁺(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) (6.3).

    Attributes:
        inertia: E, the second moments of mass, (3,) or (3, 3).
        stored_energy: W.
    """

    noun = "elastic bodies (systems.pseudo_rigid_body without viscosity)"


class AbstractViscousBody(AbstractDeformingBody):
    """A viscous body that deforms homogeneously: as `AbstractElasticBody`, with Ṗ = −F(2∇W(C) + νĊ), C = FᵀF.

    H − W is conserved, with the work W = −∫½ν|Ċ|² dt of the viscous stress.

    Attributes:
        inertia, stored_energy: as in `AbstractElasticBody`.
        viscosity: ν ≥ 0, an energy times a time.
    """

    noun = "viscous bodies (systems.pseudo_rigid_body)"
    viscosity: Array

    @equation
    def vector_field(self, state: State) -> State:
        """(PE⁻¹, −F(S + νĊ)), and the rate of the work, −½ν|Ċ|²."""
        elastic = super().vector_field(state)
        change = state.q.T @ elastic.q
        C_dot = change + change.T
        force = self.viscosity * (state.q @ C_dot)
        return elastic._replace(p=elastic.p - force, work=-self.viscosity * jnp.sum(C_dot * C_dot) / 2)


class AbstractIncompressibleBody(AbstractDeformingBody):
    """A body that deforms homogeneously at constant volume, on T*SL(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) + p F⁻ᵀ, det F = 1.

    The pressure p is such that tr(ḞF⁻¹) = 0. A state is (F, P) as in `AbstractElasticBody`, with tr(PE⁻¹F⁻¹) = 0.

    Attributes:
        inertia: E, as in `AbstractElasticBody`.
        stored_energy: W.
    """

    noun = "incompressible bodies (systems.incompressible_body)"

    @property
    def phase_space(self) -> CotangentUnimodular:
        return CotangentUnimodular(self.inertia, special_linear(3))

    @equation
    def pressure(self, state: State) -> Scalar:
        """p, in units of energy: d²/dt² det F = 0."""
        E = jnp.diag(self.inertia) if self.inertia.ndim == 1 else self.inertia
        inverse, weight = jnp.linalg.inv(state.q), jnp.linalg.inv(E)
        rate = inverse @ self.velocity(state)
        S = -inverse @ super().vector_field(state).p
        return (jnp.trace(S @ weight) + jnp.trace(rate @ rate)) / jnp.trace(inverse @ inverse.T @ weight)

    @equation
    def vector_field(self, state: State) -> State:
        """(Ḟ, Ṗ) = (PE⁻¹, −2F∇W + pF⁻ᵀ)."""
        free = super().vector_field(state)
        return State(free.q, free.p + self.pressure(state) * jnp.linalg.inv(state.q).T)
