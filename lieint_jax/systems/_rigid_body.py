"""The free rigid body: Euler's equations on T*SO(3) (Section 2.1.4)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _free_body
from lieint_jax._checks import all_plain
from lieint_jax._numerics import vectors
from lieint_jax._xla import compiled
from lieint_jax.core import Converted, State, argument, from_fields, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractFreeBody
from lieint_jax.systems._shared.body import Body, as_inertia

__all__ = ["RigidBody", "rigid_body", "tumbling_state"]


@pytree
class RigidBody(Body, AbstractFreeBody):
    """A free rigid body. Its motion conserves energy, the spatial momentum π, and |Π|².

    H = ½ Π·J⁻¹Π with Π = Λᵀπ (2.11); Λ̇ = ΛΩ̂, π̇ = 0 (2.12).

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

    inertia: Converted[Array] = argument(converter=as_inertia)

    def solution(self, state: State, t: Array | float) -> State:
        """The exact state after a time t of any size and sign, in Jacobi's elliptic functions; π is equal bit for bit.

        For many times, use `jax.vmap(body.solution, (None, 0))`. The formulas are in `_free_body`.
        """
        return State(_attitude(self.inertia, state.q, state.p, t)[0], state.p)


class WithFreeBody:
    """A body with something more than its inertia."""

    inertia: Array

    @property
    def free(self) -> RigidBody:
        """The free body of this inertia, without the potential or the rotor."""
        return from_fields(RigidBody, inertia=self.inertia)


_attitude = compiled(_free_body.attitude)


def tumbling_state(
    moments: ArrayLike,
    precession: ArrayLike,
    rotation: ArrayLike,
    pole: ArrayLike,
    *,
    long_axis: bool,
    phi: ArrayLike = 0.0,
    psi: ArrayLike = 0.0,
    toward: ArrayLike = (1.0, 0.0, 0.0),
) -> State:
    """The state of a free body that tumbles with given mean periods, as light curves and radar report them.

    A pure function, with derivatives: the inverse of `RigidBody.periods`, which defines the periods and both modes.

    Args:
        moments: principal moments about the body axes x, y, z, in ascending order, (3,). Only ratios count.
        precession: P_φ, that of the long axis x about the angular momentum.
        rotation: P_ψ, that of the angular momentum in the body. Where the mode has no motion with this ratio of
            periods, the state is NaN.
        pole: the direction of the angular momentum, a unit vector in space, (3,).
        long_axis: the mode: whether the angular momentum circles the axis of least or of greatest moment.
        phi: the angle in radians about the angular momentum from the direction `toward` to the long axis.
        psi: 2π times the part of P_ψ that has passed since Π lay between x and z, nearest to x.
        toward: a direction in space, not along the pole, (3,).

    Example:
        >>> moments = [0.55, 0.8, 1.0]
        >>> state = tumbling_state(moments, 20.0, 60.0, [0.0, 0.0, 1.0], long_axis=False, psi=0.3)
        >>> found = rigid_body(moments).periods(state)
        >>> round(float(found.precession), 9), round(float(found.rotation), 9), bool(found.long_axis)
        (20.0, 60.0, False)
    """
    all_plain(moments=moments, precession=precession, rotation=rotation, pole=pole)
    all_plain(phi=phi, psi=psi, toward=toward)
    J, P_phi, P_psi, along = (jnp.asarray(x) for x in (moments, precession, rotation, pole))
    unit, angle = _free_body.momentum_of_ratio(J, P_psi / P_phi, long_axis), jnp.asarray(phi)
    size = _free_body.periods(J, unit).precession / P_phi
    Pi = _free_body.momentum_at_phase(J, unit, jnp.asarray(psi))
    in_body = _orthonormal(Pi / vectors.norm(Pi), jnp.asarray([1.0, 0, 0]))
    x, y, z = _orthonormal(along, jnp.asarray(toward))
    across = jnp.cos(angle) * y + jnp.sin(angle) * z
    in_space = jnp.stack([x, across, jnp.stack(vectors.cross(x, across))])
    R = jnp.stack([sum(in_space[k, i] * in_body[k] for k in range(3)) for i in range(3)])
    return State(so3.from_matrix(R), size * along)


def _orthonormal(along: Array, near: Array) -> Array:
    """The unit vector `along`, the direction of `near` across it, and their cross product: rows of a rotation."""
    across = near - vectors.dot(near, along) * along
    across = across / vectors.norm(across)
    return jnp.stack([along, across, jnp.stack(vectors.cross(along, across))])


rigid_body = RigidBody
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
