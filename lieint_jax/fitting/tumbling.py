"""A free tumbling body for fits: its parameters, its mean periods, and random first guesses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.core import State
from lieint_jax.fitting._bounds import principal_inertia
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody

__all__ = ["mean_periods", "model", "random_guesses", "rotate", "rotation_between"]

_POOL, _NEAR = 50_000, 500  # number of random bodies, and of those used for a candidate
_SCATTER = 0.8  # standard deviation of the logarithms of second moments


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


def random_guesses(
    frequencies: np.ndarray, count: int, key: Array
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Random parameters of `model` whose mean precession and rotation frequencies are near given candidates.

    The inertia is that of random second moments; the directions of the body momentum and the attitudes are uniform.
    From a pool of such bodies, each candidate uses those with the nearest ratio of the two frequencies, and scales
    their rates to its frequencies. All candidates have the same number of guesses.

    Args:
        frequencies: 1/`mean_periods` of each candidate, (candidates, 2).
        count: the number of guesses.
        key: a random key.

    Returns:
        The parameters, with a leading axis; the reference attitudes, (count, 4); the candidate of each, (count,).
    """
    keys = jax.random.split(key, 4)
    J, Pi, of_pool = (np.asarray(x) for x in _pool(keys[:2]))
    ratio, wanted = of_pool[:, 1] / of_pool[:, 0], frequencies[:, 1] / frequencies[:, 0]
    near = np.argsort(np.abs(np.log(ratio[:, None] / wanted)), axis=0)[:_NEAR]
    which = np.arange(count) % len(frequencies)
    chosen = near[np.asarray(jax.random.randint(keys[2], (count,), 0, _NEAR)), which]
    speed = (frequencies[which] / of_pool[chosen]).mean(axis=1)
    rate = np.rad2deg(speed[:, None] * Pi[chosen] / J[chosen])
    begin = jax.jit(lambda key: jax.vmap(so3.normalize)(jax.random.normal(key, (count, 4))))(keys[3])
    return {"attitude": np.zeros((count, 3)), "inertia": J[chosen, :2], "rate": rate}, np.asarray(begin), which


@jax.jit
def _pool(keys: Array) -> tuple[Array, Array, Array]:
    """Random bodies: moments over the third, body momenta, and mean frequencies of precession and rotation."""
    J = jax.vmap(principal_inertia.inside)(_SCATTER * jax.random.normal(keys[0], (_POOL, 3)))
    J = J / J[:, 2:]
    Pi = jax.random.normal(keys[1], (_POOL, 3))

    def frequencies(J: Array, Pi: Array) -> Array:
        body = RigidBody(J)
        return 1 / mean_periods(body, body.state(body_momentum=Pi))

    return J, Pi, jax.vmap(frequencies)(J, Pi)
