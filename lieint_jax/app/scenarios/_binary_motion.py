"""The effect of a change of the relative speed of two bodies on their orbital period, as of an impact."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.measure import mean_rate
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBodies
from lieint_jax.types import State, Step, vectors

_MAX_ITERATIONS = 8  # of Newton's method for the speed
_TOLERANCE = 1e-5  # largest last correction over the change; the error that Newton's method leaves is its square


def relative_state(system: RigidBodies, state: State) -> tuple[Array, Array]:
    """The relative position d and the relative velocity v."""
    x, v = state.q[:, :3], state.p[:, :3] / system.masses[:, None]
    return x[1] - x[0], v[1] - v[0]


def with_speed_change(system: RigidBodies, state: State, change: Array) -> State:
    """The state with `change` added to the speed of the relative motion, across the line of centers."""
    m, (d, v) = system.masses, relative_state(system, state)
    across = v - d * (vectors.dot(d, v) / vectors.dot(d, d))
    push = m[0] * m[1] / (m[0] + m[1]) * change * across / vectors.norm(across)
    return state._replace(p=state.p.at[:, :3].add(jnp.stack([-push, push])))


@partial(jax.jit, static_argnames=("num_steps", "save_every"))
def orbital_period(
    step: Step, state: State, dt: float, num_steps: int, save_every: int, change: Array
) -> tuple[Array, Array]:
    """The orbital period after a change of the initial speed, and its derivative by that change.

    The derivative is that of the whole model, by a tangent vector along the run, not of Kepler's formula.
    """

    def period_after(change: Array) -> Array:
        system: Any = step.system
        run = integrate(step, with_speed_change(system, state, change), dt, num_steps, save_every=save_every)
        L = system.momentum(state)[3:]
        up = L / vectors.norm(L)
        e1, e2 = frame(up)

        def longitude(state: State) -> Array:
            d, _ = relative_state(system, state)
            return jnp.arctan2(vectors.dot(e2, d), vectors.dot(e1, d))

        angles = jax.vmap(longitude)(run.state)
        return jnp.asarray(2 * jnp.pi / mean_rate(run.t, jnp.unwrap(angles)))

    return jax.jvp(period_after, (change,), (jnp.ones_like(change),))


def speed_change_for(target: float, measure: Callable[[Array], tuple[Array, Array]]) -> float:
    """The change of speed that gives the orbital period `target`, by Newton's method; nan if it fails to converge.

    `measure` returns the period and its derivative for a change of speed, as `orbital_period` does.
    """
    change = 0.0
    for _ in range(_MAX_ITERATIONS):
        found, slope = measure(jnp.asarray(change))
        correction = (target - float(found)) / float(slope)
        change += correction
        if abs(correction) <= _TOLERANCE * abs(change):
            return change
    return float("nan")


def kepler_speed(mu: float, r: float, period: float) -> float:
    """The speed at the distance r, an apsis, of an orbit of two points with this period."""
    a = (mu * (period / (2 * np.pi)) ** 2) ** (1 / 3)
    return float(np.sqrt(mu * (2 / r - 1 / a)))
