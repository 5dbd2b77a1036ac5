"""One free rigid body whose attitude may leave SO(3)."""

from __future__ import annotations

import jax.numpy as jnp

from lieint_jax._numerics.arrays import Matrix3, Vector3
from lieint_jax._numerics.vectors import matrix, vector
from lieint_jax.core import State
from lieint_jax.phase_spaces import EmbeddedRotations
from lieint_jax.systems._equations.equation import equation
from lieint_jax.systems._equations.one_body import AbstractRotatingBody

_PHASE_SPACE = EmbeddedRotations()


class AbstractEmbeddedBody(AbstractRotatingBody):
    """A free rigid body whose attitude Λ may leave SO(3), on L(3) × ℝ³: Λ̇ = ΛΩ̂, π̇ = 0 with JΩ = Π = Λ⁻¹π (2.12).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
    """

    noun = "free rigid bodies with an attitude in L(3) (systems.embedded_body)"

    @property
    def phase_space(self) -> EmbeddedRotations:
        return _PHASE_SPACE

    def rotation_matrix(self, state: State) -> Matrix3:
        """Λ itself, shape (3, 3): a rotation if the state is on T*SO(3)."""
        return state.q

    @equation
    def body_momentum(self, state: State) -> Vector3:
        """Π = Λ⁻¹π, shape (3,)."""
        return jnp.stack(matrix(state.q).solve(state.p))

    @equation
    def vector_field(self, state: State) -> State:
        """(Λ̇, π̇) = (ΛΩ̂, 0) (2.12)."""
        Omega = self.angular_velocity(state)
        return State(matrix(state.q).times_hat(vector(Omega)).array, jnp.zeros_like(state.p))
