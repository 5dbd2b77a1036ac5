"""A free tumbling body for fits: its parameters and its mean periods."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import State


def model(params: dict[str, Array], attitude: Array) -> tuple[RigidBody, State]:
    """The body and its state, from the parameters of a fit.

    Args:
        params: `attitude`, a rotation vector in space (°) by which the given one is rotated; `inertia`, moments about
            body x and y over that about z, (2,); `rate`, body rate (° per unit of time).
        attitude: the reference attitude, a unit quaternion, (4,).
    """
    body = RigidBody(jnp.append(params["inertia"], 1.0))
    return body, body.state(rotate(params["attitude"], attitude), angular_velocity=jnp.deg2rad(params["rate"]))


def rotate(vector: Array, q: Array) -> Array:
    """Rotate the attitude q, (4,), in space by a rotation vector in degrees, (3,)."""
    return so3.multiply(so3.exp(jnp.deg2rad(vector)), q)


def rotation_between(q: Array, origin: Array) -> Array:
    """The rotation vector in space, in degrees, that rotates the attitude `origin` to q."""
    return jnp.rad2deg(so3.log(so3.multiply(q, so3.inverse(origin))))


def mean_periods(body: RigidBody, state: State) -> Array:
    """Mean precession and rotation period, (2,), in units of time, with derivatives.

    The precession is that of the axis which the angular momentum circles in the body, in the period of rotation.
    """
    found = body.periods(state)
    return jnp.stack([found.of_circled_axis, found.rotation])
