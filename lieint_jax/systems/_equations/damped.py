"""One rigid body with internal friction."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.vectors import cross, dot
from lieint_jax.core import State
from lieint_jax.groups import so3
from lieint_jax.systems._equations.equation import equation
from lieint_jax.systems._equations.one_body import AbstractRotatingBody
from lieint_jax.torques import internal_friction


class AbstractDampedBody(AbstractRotatingBody):
    """A rigid body on T*SO(3) with internal friction: q̇ = ½ q (Ω + α Π × Ω), π̇ = 0 with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        friction: α, an inverse angular momentum.
    """

    noun = "rigid bodies with internal friction (systems.damped_body)"
    friction: Array

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q (Ω + αΠ × Ω), 0), and −α|Π × Ω|² as the rate of the work."""
        Pi, Omega = self.body_momentum(state), self.angular_velocity(state)
        more = jnp.stack(internal_friction(self.friction, Pi, Omega))
        slip = cross(Pi, Omega)
        q_dot = so3.tangent(state.q, Omega + more)
        return State(q_dot, jnp.zeros_like(state.p), work=-self.friction * dot(slip, slip))
