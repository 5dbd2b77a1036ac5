"""Frames that move with a satellite: axes for a controller to point to."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import cross, dot, norm
from lieint_jax.core import Converted, argument, callable_pytree, pytree
from lieint_jax.groups import so3
from lieint_jax.orbits._from_state import KeplerFromState
from lieint_jax.orbits._kepler import Kepler, kepler

__all__ = ["LocalFrame", "lvlh"]


@pytree
class LocalFrame:
    """The frame local vertical, local horizontal (LVLH): z to the center, y opposite to the orbit's normal, x = y × z.

    A body at q = frame(t) points its z axis to the nadir. x points forward; on a circular orbit, along the velocity.

    Args:
        orbit: t ↦ (position, velocity) from the center of attraction, such as `kepler(…)`; JAX must be able to
            differentiate it by t.

    Raises:
        ValueError: `orbit` is not such a function.
    """

    orbit: Converted[Any] = argument(converter=lambda orbit: callable_pytree(_checks.orbit(orbit)))

    def __call__(self, t: ArrayLike) -> Array:
        """The attitude of the frame at time t: the unit quaternion (4,) from its axes to those of space, q₀ ≥ 0."""
        q = so3.from_matrix(self.matrix(t))
        return jnp.where(q[0] < 0, -q, q)

    def matrix(self, t: ArrayLike) -> Array:
        """The axes of the frame in space, as columns, (3, 3)."""
        r, v = self.orbit(t)
        h = jnp.stack(cross(r, v))
        down, across = -r / norm(r), -h / norm(h)
        return jnp.stack([jnp.stack(cross(across, down)), across, down], axis=1)

    def angular_velocity(self, t: ArrayLike) -> Array:
        """The angular velocity of the frame in its own axes, (3,), for any orbit, including perturbed ones.

        It is −|h|/r² about y, and −r(v̇·ĥ)/|h| about z, because the plane of a perturbed orbit rotates.
        """
        t = jnp.asarray(t)
        if isinstance(self.orbit, Kepler | KeplerFromState):
            r, v = self.orbit(t)
            acceleration = self.orbit.acceleration(r)
        else:
            (r, v), (_, acceleration) = jax.jvp(self.orbit, (t,), (jnp.ones_like(t),))
        h = jnp.stack(cross(r, v))
        size, square = norm(h), dot(r, r)
        tilt = jnp.sqrt(square) * dot(acceleration, h) / (size * size)
        return jnp.stack([jnp.zeros_like(size), -size / square, -tilt])


lvlh = LocalFrame


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"lvlh": partial(lvlh, orbit=kepler(1.3, 1.2, 0.1, 0.7))}
