"""T*S² (Section 1)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import PhaseMatrix, PhaseVector, Scalar, Vector3
from lieint_jax.core import State, pytree
from lieint_jax.groups import so3
from lieint_jax.phase_spaces._entries import ByEntries


@pytree
class CotangentSphere(ByEntries):
    """T*S²: a state is (q, π) with |q| = 1 and q·π = 0 (1.3), π = m q × q̇; a tangent vector has four coordinates.

    The coordinates refer to an orthonormal, right-handed frame e₁, e₂, q: δq = a₁e₁ + a₂e₂ and
    δπ = b₁e₁ + b₂e₂ − (π·δq) q, so that q·δπ + π·δq = 0.
    """

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 4."""
        return 4

    @property
    def origin(self) -> State:
        """q = e₃, at rest."""
        return State(jnp.array([0.0, 0.0, 1.0]), jnp.zeros(3))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (a, b), shape (4,), on T*S²: q and π + δπ rotated by exp(θ̂), θ = q × δq."""
        e1, e2 = frame(state.q)
        turn = so3.exp(delta[0] * e2 - delta[1] * e1)
        return state._replace(q=so3.Ad(turn, state.q), p=so3.Ad(turn, state.p + delta[2] * e1 + delta[3] * e2))

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement, projected on T*S²."""
        end = super().displaced(start, displacement)
        q = end.q / vectors.norm(end.q)
        return end._replace(q=q, p=end.p - vectors.dot(q, end.p) * q)

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(a, b), shape (4,), of a tangent vector given in the coordinates of `State`."""
        e1, e2 = frame(state.q)
        return jnp.stack([vectors.dot(e, v) for v in (tangent.q, tangent.p) for e in (e1, e2)])

    def omega(self, state: State) -> PhaseMatrix:
        """ω(δ₁, δ₂) = q·(δq₁ × δπ₂ + δπ₁ × δq₂), shape (4, 4): the inverse of 𝒥 (1.4), the same in every frame."""
        turn = jnp.array([[0, 1], [-1, 0]], state.p.dtype)
        return jnp.block([[0 * turn, turn], [turn, 0 * turn]])

    def defect(self, state: State) -> Scalar:
        """The larger of ||q|² − 1| and |q·π| over the largest component of π."""
        size = vectors.max_abs(state.p)
        tilt = jnp.abs(vectors.dot(state.q, state.p)) / jnp.where(size > 0, size, 1)
        return jnp.maximum(jnp.abs(vectors.dot(state.q, state.q) - 1), tilt)


def frame(q: Vector3) -> tuple[Vector3, Vector3]:
    """Unit vectors e₁, e₂ with e₁ × e₂ = q, for a unit vector q (Duff et al. 2017, J. Comput. Graph. Tech. 6)."""
    x, y, z = q
    sign = jnp.where(z < 0, -1, 1).astype(q.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])
