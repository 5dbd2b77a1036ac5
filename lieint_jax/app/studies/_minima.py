"""The minima of a tumbling body's light: events of the time derivative of its magnitude, with derivatives."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import schemes
from lieint_jax.app.studies._facets import Facets, magnitude
from lieint_jax.app.studies._satellite_sky import Scene, closed_form, directions
from lieint_jax.groups import so3
from lieint_jax.runs import Event, events
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

_STEP = 0.1  # min: short enough for at most one minimum or maximum of the light in a step
_OFFSET = 0.02  # min, before and after a minimum, where the light must be brighter


class Minima(NamedTuple):
    """The minima of the light in an observing session.

    Attributes:
        t: their times (min), (minima,).
        magnitude: the magnitudes at these times, (minima,).
        slope: the time derivatives of the magnitude at these times: 0 but for rounding (1/min), (minima,).
        rise: the smaller of the differences in magnitude to 0.02 min before and after, (minima,).
    """

    t: np.ndarray
    magnitude: np.ndarray
    slope: np.ndarray
    rise: np.ndarray


def slope(body: RigidBody, facets: Facets, sky: dict[str, float], state: State) -> Array:
    """The time derivative of the magnitude along the motion."""
    t = jnp.asarray(state.t)
    moving = so3.tangent(state.q, body.angular_velocity(state)), jnp.ones_like(t)
    return jax.jvp(lambda q, t: magnitude(facets, q, *directions(sky, t)), (state.q, t), moving)[1]


def minima(body: RigidBody, state: State, facets: Facets, sky: dict[str, float], until: float, count: int) -> Event:
    """The first `count` minima of the light before the time `until`, as events; differentiable in body and state."""
    return events(
        schemes.preprocessed(body, 6),
        state._replace(t=jnp.zeros(())),
        _STEP,
        lambda state: slope(body, facets, sky, state),
        max_steps=int(until / _STEP),
        count=count,
        direction=-1,
    )


def scene_minima(scene: Scene, until: float, count: int) -> Minima:
    """The first `count` minima of the light of a scene, with the slopes and magnitudes that verify them.

    The times and slopes are computed by the scheme, the magnitudes by the closed form.
    """

    @jax.jit
    def find_minima(body: RigidBody, state: State) -> tuple[Event, Array]:
        found = minima(body, state, scene.facets, scene.sky, until, count)
        return found, jax.vmap(lambda state: slope(body, scene.facets, scene.sky, state))(found.state)

    found, slopes = find_minima(scene.body, scene.state)
    t, slopes = (np.asarray(x)[np.asarray(found.found)] for x in (found.t, slopes))
    times = np.concatenate([t - _OFFSET, t, t + _OFFSET])
    before, there, after = np.asarray(closed_form(scene, times)[1]).reshape(3, -1)
    return Minima(t, there, slopes, there - np.maximum(before, after))
