"""The change of a tumbling body's spin by the Earth's torque in one flyby, as an order of magnitude.

The body passes on the hyperbola of a given least distance and speed at infinity. The phase of its rotation and the
orientation of its angular momentum relative to the orbit are unknown: the members of an ensemble have random ones.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import orbits, schemes, systems
from lieint_jax.fitting.tumbling import mean_periods
from lieint_jax.groups import so3
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBody
from lieint_jax.types import State, vectors

MU = orbits.EARTH_GM * 86400.0**2  # km³/d²
AU = 149597870.7  # km
EARTH_SPEED = 29.7847  # km/s, of a circular orbit of 1 au
_HALF, _STEPS = 12.0, 800  # days before and after the least distance; number of steps over both


class Flyby(NamedTuple):
    """The changes of spin in a flyby, over an ensemble of phases and directions."""

    distance: float  # the least distance, km
    speed: float  # the speed at infinity, km/s
    momentum: np.ndarray  # relative change |Δπ|/|π| of the angular momentum, (members,)
    pole: np.ndarray  # the angle between the angular momenta before and after, °, (members,)
    rates: np.ndarray  # the changes of the mean rates of precession and rotation, 360°/period, in °/d, (members, 2)


def passage(body: RigidBody, state: State, distance: float, speed: float, members: int) -> Flyby:
    """Integrate an ensemble of flybys of a free body whose energy and momentum are those of `state`.

    A member begins, 12 days before the least distance, with the state after a random time, rotated at random. Its
    momentum and mean periods are compared with those 24 days later: in torque-free motion they are equal.
    """
    rng = np.random.default_rng(2004)
    times = jnp.asarray(rng.uniform(0, 1000, members))
    rotations = rng.normal(size=(members, 4))
    rotations = jnp.asarray(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))
    orbit = orbits.hyperbola(MU, distance, speed * 86400.0)  # days, km

    def member_changes(t: Array, rotation: Array) -> tuple[Array, Array, Array]:
        before = State(so3.multiply(rotation, body.solution(state, t).q), so3.Ad(rotation, state.p))
        after = state_after_flyby(body, before, orbit)
        change = 360 / mean_periods(body, after) - 360 / mean_periods(body, before)
        size = jnp.linalg.norm(after.p - before.p) / jnp.linalg.norm(before.p)
        return size, jnp.rad2deg(vectors.angle(before.p, after.p)), change

    mapped = partial(jax.lax.map, lambda x: member_changes(*x), batch_size=min(members, 64))
    results = jax.jit(mapped)((times, rotations))
    return Flyby(distance, speed, *(np.asarray(x) for x in results))


def state_after_flyby(body: RigidBody, before: State, orbit: orbits.Kepler) -> State:
    """The state 12 days after the least distance, from the state 12 days before it."""
    step = schemes.splitting(systems.gravity_gradient(body.inertia, orbit))
    begin = State(before.q, before.p, jnp.asarray(-_HALF), jnp.zeros(()))
    run = integrate(step, begin, 2 * _HALF / _STEPS, _STEPS, save_every=_STEPS)
    return State(run.state.q[-1], run.state.p[-1])
