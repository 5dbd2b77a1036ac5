"""The minima of a tumbling body's light: events of the time derivative of its magnitude, with derivatives."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import schemes
from lieint_jax.groups import so3
from lieint_jax.integrate import Event, events
from lieint_jax.studies._facets import Facets, magnitude
from lieint_jax.studies._satellite_sky import directions
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

_STEP = 0.1  # min: shorter than the light takes to turn, so that no two changes of sign are in one step
_BESIDE = 0.02  # min, on either side of a minimum: where it must be brighter


class Minima(NamedTuple):
    """The minima of the light in a session.

    Attributes:
        t: their times (min), (minima,).
        magnitude: there, (minima,).
        slope: the time derivative of the magnitude there: 0 but for rounding (1/min), (minima,).
        rise: by how many magnitudes the light is brighter a moment before and after, the less of the two, (minima,).
    """

    t: np.ndarray
    magnitude: np.ndarray
    slope: np.ndarray
    rise: np.ndarray


def light(facets: Facets, sky: dict[str, float], q: Array, t: ArrayLike) -> Array:
    """The magnitude at an attitude and a time."""
    return magnitude(facets, q, *directions(sky, jnp.asarray(t)))


def slope(body: RigidBody, facets: Facets, sky: dict[str, float], state: State) -> Array:
    """The time derivative of the magnitude along the motion."""
    t = jnp.asarray(state.t)
    moving = so3.tangent(state.q, body.angular_velocity(state)), jnp.ones_like(t)
    return jax.jvp(lambda q, t: light(facets, sky, q, t), (state.q, t), moving)[1]


def minima(body: RigidBody, state: State, facets: Facets, sky: dict[str, float], until: float, count: int) -> Event:
    """The first `count` minima of the light before the time `until`, as events; differentiable in body and state."""
    return events(
        schemes.preprocessed(body, 6),
        state._replace(t=jnp.zeros(())),
        _STEP,
        lambda state: slope(body, facets, sky, state),
        int(until / _STEP),
        count,
        direction=-1,
    )


def judged(body: RigidBody, facets: Facets, sky: dict[str, float], found: Event) -> Minima:
    """The minima that the events found, with what shows that they are minima."""
    step, moments = schemes.preprocessed(body, 6), (-_BESIDE, _BESIDE)

    @jax.jit
    @jax.vmap
    def look(state: State) -> tuple[Array, ...]:
        assert state.t is not None
        here = light(facets, sky, state.q, state.t)
        before, after = (step(state, dt)[0] for dt in moments)
        beside = jnp.maximum(
            *(light(facets, sky, s.q, state.t + dt) for s, dt in zip((before, after), moments, strict=True))
        )
        return state.t, here, slope(body, facets, sky, state), here - beside

    there = np.asarray(found.found)
    return Minima(*(np.asarray(x) for x in look(jax.tree.map(lambda x: x[there], found.state))))
