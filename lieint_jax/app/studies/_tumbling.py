"""A free tumbling body, as studies fit it: its parameters, mean periods, and the direction of its momentum."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import State


def model(params: dict[str, Array], attitude: Array) -> tuple[RigidBody, State]:
    """The body and its state.

    Args:
        params: `attitude`, a rotation vector in space (°) that rotates the given one; `inertia`, moments about body x
            and y over that about z, (2,); `rate`, body rate (° per unit of time).
        attitude: the attitude to begin with, a unit quaternion.
    """
    body = RigidBody(jnp.append(params["inertia"], 1.0))
    return body, body.state(rotated(params["attitude"], attitude), angular_velocity=jnp.deg2rad(params["rate"]))


def rotated(turn: Array, q: Array) -> Array:
    """The attitude q rotated in space by a rotation vector in degrees."""
    return so3.multiply(so3.exp(jnp.deg2rad(turn)), q)


def rotation_between(q: Array, origin: Array) -> Array:
    """The rotation vector in space, in degrees, that rotates the attitude `origin` to q."""
    return jnp.rad2deg(so3.log(so3.multiply(q, so3.inverse(origin))))


def mean_periods(body: RigidBody, state: State) -> Array:
    """Mean precession and rotation period, (2,), in units of time, with derivatives.

    The rotation is that of Π about an axis in the body, of least or of greatest moment, and the precession that of this
    axis about Π. `RigidBody.periods` has the precession of the long axis in both modes; the short axis goes faster, by
    one turn in each rotation. `scenarios.rigid_body.mean_periods` measures them on a trajectory.
    """
    precession, rotation, long_axis = body.periods(state)
    return jnp.stack([jnp.where(long_axis, precession, 1 / (1 / precession + 1 / rotation)), rotation])


def direction(p: Array) -> Array:
    """Longitude in [0, 360) and latitude of a vector (..., 3), in degrees, (..., 2)."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    return jnp.rad2deg(jnp.stack([jnp.arctan2(y, x) % (2 * jnp.pi), jnp.arctan2(z, jnp.hypot(x, y))], axis=-1))
