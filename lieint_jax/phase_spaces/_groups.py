"""T*G and G: phase spaces of motions on a Lie group (Sections 2.1.3, 5.1.5)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import PhaseMatrix, PhaseVector, Scalar
from lieint_jax._xla import materialized
from lieint_jax.core import Group, State, pytree, static


class ByPerturbation:
    """A phase space in which a displacement is the δ of `perturb`."""

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement."""
        return self.perturb(start, displacement)  # pyright: ignore[reportAttributeAccessIssue]


@pytree
class CotangentGroup(ByPerturbation):
    """T*G in the spatial (right) trivialization: a state is (q, π), a tangent vector (δθ, δπ) ∈ 𝔤 × 𝔤*.

    δq = δθ q, so on SO(3) δΛ = δθ̂Λ as in (2.8); δπ is the plain variation of the spatial momentum.
    """

    group: Group = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 2 dim G."""
        return 2 * self.group.dim

    @property
    def origin(self) -> State:
        """The identity, at rest."""
        return State(jnp.asarray(self.group.identity, float), jnp.zeros(self.group.dim))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (2d,): (exp(δθ) q, π + δπ)."""
        d = self.group.dim
        q = self.group.multiply(self.group.exp(delta[:d]), state.q)
        q = jnp.stack(materialized(q.ravel())).reshape(q.shape)  # a step from here would compute it again and again
        return state._replace(q=q, p=state.p + delta[d:])

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """(δq, δπ) in the coordinates of `State`, δq = δθ q."""
        d = self.group.dim
        return self.group.spatial_tangent(state.q, delta[:d]), delta[d:]

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The δ, shape (2d,), with perturb(start, δ) = end, of the least δθ."""
        turn = self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))
        return jnp.concatenate([turn, end.p - start.p])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (2d,), of a tangent vector given in the coordinates of `State`."""
        return jnp.concatenate([self.group.spatial_velocity(state.q, tangent.q), tangent.p])

    def omega(self, state: State) -> PhaseMatrix:
        """The symplectic form as a matrix [[α, 1], [−1, 0]], shape (2d, 2d), αξ = ad*_ξ π: (2.9), (5.9)."""
        d = self.group.dim
        one, zero = jnp.eye(d, dtype=state.p.dtype), jnp.zeros((d, d), state.p.dtype)
        alpha = jax.vmap(self.group.ad_star, in_axes=(1, None), out_axes=1)(one, state.p)
        return jnp.block([[alpha, one], [-one, zero]])

    def defect(self, state: State) -> Scalar:
        """The distance of q from the group: |q|² − 1 for unit quaternions."""
        return self.group.defect(state.q)


@pytree
class ConfigurationGroup(ByPerturbation):
    """A Lie group G itself, without momenta: a state is q, with p of shape (0,), a tangent vector δθ with δq = δθ q.

    It has no symplectic form.
    """

    group: Group = static()

    @property
    def dim(self) -> int:
        """Dimension of the group."""
        return self.group.dim

    @property
    def origin(self) -> State:
        """The identity."""
        return State(jnp.asarray(self.group.identity, float), jnp.zeros(0))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δθ, shape (d,): exp(δθ) q."""
        return state._replace(q=self.group.multiply(self.group.exp(delta), state.q))

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """δq = δθ q, and no δp."""
        return self.group.spatial_tangent(state.q, delta), jnp.zeros_like(state.p)

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The least δθ, shape (d,), with perturb(start, δθ) = end."""
        return self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """δθ, shape (d,), of a tangent vector δq."""
        return self.group.spatial_velocity(state.q, tangent.q)

    def omega(self, state: State) -> PhaseMatrix:
        """Raises ValueError: there is no form."""
        raise ValueError("a motion with given rates has neither momenta nor a symplectic form")

    def defect(self, state: State) -> Scalar:
        """The distance of q from the group: |q|² − 1 for unit quaternions."""
        return self.group.defect(state.q)
