"""The free rigid body: Euler's equations on T*SO(3) (Section 2.1.4)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, _free_body
from lieint_jax._xla import compiled
from lieint_jax.capabilities import AbstractFreeBody
from lieint_jax.groups import so3
from lieint_jax.systems._shared.body import Body
from lieint_jax.systems._shared.properties import SystemProperties
from lieint_jax.types import State, pytree

__all__ = ["RigidBody", "rigid_body"]


@pytree
class RigidBody(Body, AbstractFreeBody):
    """H = ½ Π·J⁻¹Π with Π = Λᵀπ (2.11); Λ̇ = ΛΩ̂, π̇ = 0 (2.12). Made by `rigid_body`."""

    inertia: Array

    def solution(self, state: State, t: Array | float) -> State:
        """The exact state after a time t of any size and sign, in Jacobi's elliptic functions; π is equal bit for bit.

        For many times, use `jax.vmap(body.solution, (None, 0))`. The formulas are in `_free_body`.
        """
        return State(_attitude(self.inertia, state.q, state.p, t)[0], state.p)


_attitude = compiled(_free_body.attitude)


def rigid_body(inertia: ArrayLike) -> RigidBody:
    """A free rigid body. Its motion conserves energy, the spatial momentum π, and |Π|².

    Args:
        inertia: principal moments, shape (3,), or a symmetric tensor in body axes, shape (3, 3), in any unit: the
            motion of the attitude depends on ratios only.

    Raises:
        ValueError: not positive definite, not symmetric, a wrong shape, NaN or inf. Moments that violate the triangle
            inequality cause a warning only.

    Source: Euler 1758; Lewis & Simo 1994, (2.12).

    Example:
        >>> body = rigid_body([1.0, 2.0, 3.0])
        >>> state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
        >>> float(body.energy(state))
        1.52
    """
    return RigidBody(_checks.inertia(inertia))


PROPERTIES = SystemProperties(
    name="rigid_body",
    models="a free rigid body",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy", "momentum", "Casimirs"),
    momentum="π in space",
    sizes=(3,),
    aliases=("Euler top", "Euler–Poinsot motion"),
    source="Lewis & Simo 1994, (2.12); Euler 1758",
)


def examples() -> dict[str, tuple[RigidBody, State, float]]:
    """The bodies of the paper's Figures 1 and 2, a body with a full inertia tensor, and one that flips."""
    turn = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
    bodies: dict[str, tuple[ArrayLike, list[float]]] = {
        "asymmetric": ([1.0, 2.0, 3.0], [0.2, 0.0, 1.0]),
        "symmetric": ([1.0, 1.0, 2.0], [0.2, 0.0, 1.0]),
        "full_tensor": (turn @ jnp.diag(jnp.array([1.0, 2.0, 2.5])) @ turn.T, [0.3, -0.4, 0.8]),
        "intermediate_axis": ([1.0, 2.0, 3.0], [1e-3, 1.0, 0.0]),
    }
    made = {name: (rigid_body(J), Omega) for name, (J, Omega) in bodies.items()}
    return {name: (body, body.state(angular_velocity=Omega), 0.05) for name, (body, Omega) in made.items()}
