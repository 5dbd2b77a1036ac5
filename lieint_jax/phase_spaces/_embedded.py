"""The linear space around T*SO(3), of bodies whose attitude may leave SO(3)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import PhaseMatrix, PhaseVector, Scalar
from lieint_jax.core import State, pytree
from lieint_jax.groups import so3
from lieint_jax.phase_spaces._entries import ByEntries
from lieint_jax.phase_spaces._groups import CotangentGroup


@pytree
class EmbeddedRotations(ByEntries):
    """L(3) × ℝ³ around T*SO(3): a state is (Λ, π), Λ of shape (3, 3); a tangent vector is (δθ, δπ) as on T*SO(3).

    L(3) × ℝ³ has no symplectic form. So tangent vectors are projected to those of T*SO(3), and the form is (2.9). What
    the diagnostics report of the form is valid at states with Λ on SO(3). `defect` measures how far Λ has left SO(3).
    """

    @property
    def dim(self) -> int:
        """Dimension of T*SO(3), 6."""
        return 6

    @property
    def origin(self) -> State:
        """Λ = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros(3))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (6,): (exp(δθ̂) Λ, π + δπ)."""
        turn = so3.exp(delta[:3])
        turned = jax.vmap(lambda column: so3.Ad(turn, column), 1, 1)(state.q)
        return state._replace(q=turned, p=state.p + delta[3:])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (6,), of a tangent vector (δΛ, δπ): δθ = rot[δΛ Λ⁻¹], without the other components of δΛ."""
        transposed = vectors.matrix(state.q).T
        velocity = vectors.Matrix(transposed.solve(row) for row in tangent.q)  # δΛ Λ⁻¹
        return jnp.concatenate([so3.vee(velocity.array), tangent.p])

    def omega(self, state: State) -> PhaseMatrix:
        """[[π̂, 1], [−1, 0]], shape (6, 6) (2.9)."""
        return CotangentGroup(so3).omega(state)

    def defect(self, state: State) -> Scalar:
        """max|ΛᵀΛ − 1|."""
        C = vectors.matrix(state.q).gram()
        return jnp.max(jnp.abs(jnp.stack(C) - jnp.array([1, 1, 1, 0, 0, 0], state.q.dtype)))
