"""Motions on T*G with an invariant metric: geodesics, and those in a potential (Section 5)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import AlgebraVector, DualVector, SquareMatrix
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax._numerics.small_linalg import sharp
from lieint_jax.core import Group, State
from lieint_jax.phase_spaces import CotangentGroup
from lieint_jax.systems._equations.equation import Equations, equation
from lieint_jax.systems._equations.forces import AbstractForcedSystem


class AbstractMetricSystem(Equations):
    """A motion on T*G with the kinetic energy of a left-invariant metric: q̇ = qΩ̂ with mΩ = Π = Ad*_q π.

    Attributes:
        group: the group G.
        metric: m, principal (d,) or full (d, d).
    """

    group: Group
    metric: Array

    @property
    def phase_space(self) -> CotangentGroup:
        return CotangentGroup(self.group)

    @equation
    def body_momentum(self, state: State) -> DualVector:
        """Π = Ad*_q π, shape (d,)."""
        return self.group.Ad_star(state.q, state.p)

    @equation
    def velocity(self, state: State) -> AlgebraVector:
        """The body velocity Ω = m⁻¹Π, shape (d,)."""
        return sharp(self.metric, self.body_momentum(state))


class AbstractGeodesicFlow(AbstractMetricSystem):
    """Geodesics of a left-invariant metric on T*G, without potential: q̇ = qΩ̂, π̇ = 0 with mΩ = Π = Ad*_q π (5.14).

    Attributes:
        group: the group G.
        metric: m, principal (d,) or full (d, d).
    """

    noun = "geodesics on groups (systems.euler)"

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (qΩ̂, 0) (5.14)."""
        return State(self.group.tangent(state.q, self.velocity(state)), jnp.zeros_like(state.p))


class AbstractRightGeodesicFlow(AbstractMetricSystem):
    """Geodesics of a right-invariant metric on T*G, without potential: q̇ = ω̂q, π̇ = −ad*_ω π with mω = π.

    q⁻¹ moves by the left-invariant metric m, with body momentum −π and spatial momentum −Π (end of Section 5.1.7).

    Attributes:
        group: the group G.
        metric: m, as in `AbstractGeodesicFlow`.
    """

    noun = "geodesics of right-invariant metrics (systems.euler)"

    @equation
    def velocity(self, state: State) -> AlgebraVector:
        """The spatial velocity ω = m⁻¹π, shape (d,)."""
        return sharp(self.metric, state.p)

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (ω̂q, −ad*_ω π), so that Π̇ = 0."""
        omega = self.velocity(state)
        return State(self.group.spatial_tangent(state.q, omega), -self.group.ad_star(omega, state.p))


class AbstractMechanicalSystem(AbstractForcedSystem, AbstractMetricSystem):
    """A left-invariant metric and a potential V(q) on T*G: q̇ = qΩ̂, π̇ = −T*R dV(q) with mΩ = Ad*_q π (5.41).

    Attributes:
        group: the group G.
        metric: m, as in `AbstractGeodesicFlow`.
        potential: V.
    """

    noun = "a metric and a potential on a group (systems.group_potential)"
    potential: Callable[[Array], Array]

    @equation
    def force(self, q: SquareMatrix) -> DualVector:
        """−T*R dV, shape (d,): the force of the potential in π̇. Its i-th component is −d/dε V(exp(εeᵢ)q)."""
        return spatial_force(self.group, self.potential, q)

    @equation
    def body_force(self, q: SquareMatrix) -> DualVector:
        """−T*L dV = Ad*_q of `force`, shape (d,): its i-th component is −d/dε V(q exp(εeᵢ))."""
        zero = jnp.zeros(self.group.dim, q.dtype)
        _, pull = jax.vjp(lambda Omega: self.group.tangent(q, Omega), zero)
        return -pull(autodiff_gradient(self.potential)(q))[0]


def spatial_force(group: Group, potential: Callable[[Array], Array], q: SquareMatrix) -> DualVector:
    """−T*R dV of a potential, shape (d,)."""
    _, pull = jax.vjp(lambda theta: group.spatial_tangent(q, theta), jnp.zeros(group.dim, q.dtype))
    return -pull(autodiff_gradient(potential)(q))[0]
