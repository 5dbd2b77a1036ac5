"""Phase spaces: how to perturb a state, how to read a tangent vector, and the symplectic form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.types import Group, State, pytree, static


@pytree
class CotangentGroup:
    """T*G in the spatial (right) trivialisation: a state is (q, π), a tangent vector (δθ, δπ) ∈ 𝔤 × 𝔤*.

    δq = δθ q, so on SO(3) δΛ = δθ̂Λ as in (2.8); δπ is the plain variation of the spatial momentum.
    """

    group: Group = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 2 dim G."""
        return 2 * self.group.dim

    def perturb(self, state: State, delta: Array) -> State:
        """The state moved by δ = (δθ, δπ), shape (2d,): (exp(δθ) q, π + δπ)."""
        d = self.group.dim
        return State(self.group.multiply(self.group.exp(delta[:d]), state.q), state.p + delta[d:])

    def trivialise(self, state: State, tangent: State) -> Array:
        """(δθ, δπ), shape (2d,), of a tangent vector given in the coordinates of `State`."""
        return jnp.concatenate([self.group.spatial_velocity(state.q, tangent.q), tangent.p])

    def omega(self, state: State) -> Array:
        """The symplectic form as a matrix [[α, 1], [−1, 0]], shape (2d, 2d), αξ = ad*_ξ π: (2.9), (5.9)."""
        d = self.group.dim
        one, zero = jnp.eye(d, dtype=state.p.dtype), jnp.zeros((d, d), state.p.dtype)
        alpha = jax.vmap(self.group.ad_star, in_axes=(1, None), out_axes=1)(one, state.p)
        return jnp.block([[alpha, one], [-one, zero]])

    def defect(self, state: State) -> Array:
        """By how much q leaves the group: |q|² − 1 for unit quaternions."""
        return self.group.defect(state.q)
