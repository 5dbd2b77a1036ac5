"""The free rigid body: Euler's equations on T*SO(3) (Section 2.1.4)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import checks, free_body, small
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup
from lieint_jax.types import State, pytree

_PHASE_SPACE = CotangentGroup(so3)


@pytree
class RigidBody:
    """H = ½ Π·J⁻¹Π with Π = Λᵀπ (2.11); Λ̇ = ΛΩ̂, π̇ = 0 (2.12). Made by `rigid_body`.

    Attributes:
        inertia: J in the body frame, principal moments (3,) or a symmetric tensor (3, 3).
    """

    inertia: Array

    @property
    def phase_space(self) -> CotangentGroup:
        return _PHASE_SPACE

    def state(
        self,
        attitude: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        *,
        angular_velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
    ) -> State:
        """The state of an attitude and one of three ways to give the motion.

        Args:
            attitude: unit quaternion (w, x, y, z) or rotation matrix (3, 3), body to space. A quaternion within 1e-6
                of unit length is normalised.
            angular_velocity: body angular velocity Ω, radians per unit time, shape (3,).
            body_momentum: Π = JΩ, shape (3,).
            spatial_momentum: π = ΛΠ, shape (3,).

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or an attitude that is no rotation.
        """
        q = _attitude(attitude)
        given = {
            "angular_velocity": angular_velocity,
            "body_momentum": body_momentum,
            "spatial_momentum": spatial_momentum,
        }
        given = {name: checks.real_array(name, value, (3,)) for name, value in given.items() if value is not None}
        if len(given) != 1:
            raise ValueError(
                "give exactly one of angular_velocity (body), body_momentum, spatial_momentum; got "
                f"{' and '.join(given) or 'none'}"
            )
        [(name, value)] = given.items()
        if name == "angular_velocity":
            value = jnp.stack(small.apply(small.symmetric(self.inertia), value))
        p = value if name == "spatial_momentum" else so3.Ad(q, value)
        dtype = jnp.result_type(q, p)
        return State(q.astype(dtype), checks.real_array("the spatial momentum", p.astype(dtype)))

    def rotation_matrix(self, state: State) -> Array:
        """Λ, body to space, shape (3, 3)."""
        return so3.to_matrix(state.q)

    def body_momentum(self, state: State) -> Array:
        """Π = Λᵀπ, shape (3,)."""
        return so3.Ad_star(state.q, state.p)

    def angular_velocity(self, state: State) -> Array:
        """The body angular velocity Ω = J⁻¹Π, shape (3,)."""
        return jnp.stack(small.solve_symmetric(small.symmetric(self.inertia), self.body_momentum(state)))

    def energy(self, state: State) -> Array:
        """½ Π·J⁻¹Π (2.11)."""
        return small.dot(self.body_momentum(state), self.angular_velocity(state)) / 2

    def momentum(self, state: State) -> Array:
        """The momentum map of rotations in space (2.13): π itself, shape (3,)."""
        return state.p

    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q Ω, 0) (2.12)."""
        return State(so3.tangent(state.q, self.angular_velocity(state)), jnp.zeros_like(state.p))

    def solution(self, state: State, t: Array | float) -> State:
        """The exact state after time t, of any size and sign, without stepping; π bit for bit.

        In Jacobi's elliptic functions, see `free_body`. For many times, `jax.vmap(body.solution, (None, 0))`.
        """
        return State(free_body.attitude(self.inertia, state.q, state.p, t)[0], state.p)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        checks.unit_quaternion("state.q", state.q)
        checks.real_array("state.p", state.p, (3,))


def rigid_body(inertia: ArrayLike) -> RigidBody:
    """A free rigid body.

    Args:
        inertia: principal moments, shape (3,), or a symmetric tensor in body axes, shape (3, 3). Any unit; only ratios
            matter to the attitude.

    Raises:
        ValueError: not positive definite, not symmetric, a wrong shape, NaN or inf. Moments that break the triangle
            inequality only warn.

    Example:
        >>> body = rigid_body([1.0, 2.0, 3.0])
        >>> state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
        >>> float(body.energy(state))
        1.52
    """
    return RigidBody(checks.inertia(inertia))


def examples() -> dict[str, tuple[RigidBody, State, float]]:
    """The two bodies of the paper's Figures 1 and 2, a body turned from its principal axes, and a flipping one."""
    turn = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
    bodies: dict[str, Any] = {
        "asymmetric": ([1.0, 2.0, 3.0], [0.2, 0.0, 1.0]),
        "symmetric": ([1.0, 1.0, 2.0], [0.2, 0.0, 1.0]),
        "full_tensor": (turn @ jnp.diag(jnp.array([1.0, 2.0, 2.5])) @ turn.T, [0.3, -0.4, 0.8]),
        "intermediate_axis": ([1.0, 2.0, 3.0], [1e-3, 1.0, 0.0]),
    }
    made = {name: (rigid_body(J), Omega) for name, (J, Omega) in bodies.items()}
    return {name: (body, body.state(angular_velocity=Omega), 0.05) for name, (body, Omega) in made.items()}


def _attitude(attitude: ArrayLike) -> Array:
    if np.shape(attitude) == (3, 3):
        return so3.from_matrix(checks.rotation_matrix("attitude", attitude))
    if np.shape(attitude) != (4,):
        raise ValueError(
            f"attitude must be a quaternion (4,) or a rotation matrix (3, 3), got shape {np.shape(attitude)}; "
            "use jax.vmap for batches"
        )
    return so3.normalise(checks.unit_quaternion("attitude", attitude))
