"""States of free rigid bodies by numpy, so that no program is compiled to make them."""

import jax.numpy as jnp
import numpy as np
from paper import exp

from lieint_jax.core import State

Q = np.array([1.0, 2, -1, 0.5]) / 2.5
TURN = exp(np.array([0.3, -0.5, 0.4]))


def turned(moments):
    """The full tensor of these principal moments in other axes."""
    return jnp.array(TURN @ np.diag(moments) @ TURN.T)


def rows(w, x, y, z):
    """Λᵀ of a unit quaternion: what takes π to Π. In any arithmetic."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def with_momentum(Pi):
    """The state at Q of body momentum Π."""
    return State(jnp.array(Q), jnp.array(np.array(rows(*Q)).T @ np.asarray(Pi, float)))


def moving(J, Omega=(0.3, 0.6, 0.8)):
    """The state at Q of body velocity Ω, for an inertia J (3,) or (3, 3)."""
    J, Omega = np.asarray(J, float), np.asarray(Omega, float)
    return with_momentum(J @ Omega if J.ndim == 2 else J * Omega)


def angle(a, b):
    """The angle between attitudes, largest over batches."""
    a, b = np.asarray(a), np.asarray(b)
    return 4 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)) / 2).max()
