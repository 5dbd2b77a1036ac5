"""What the Earth's torque does to a tumbling body in one flyby, as an order of magnitude.

The body passes on the hyperbola of a given least distance and speed at infinity. Neither its phase nor how the plane of
the passage lies to its angular momentum is used: the members of an ensemble take all of them.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import orbits, schemes, systems
from lieint_jax._integrate import integrate
from lieint_jax._numerics import vec3
from lieint_jax.app.studies._tumbling import mean_periods
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

MU = orbits.EARTH_GM * 86400.0**2  # km³/d²
AU = 149597870.7  # km
_EARTH_SPEED = 29.7847  # km/s, of a circular orbit of 1 au
_HALF, _STEPS = 12.0, 800  # days before and after the least distance; steps over both


class Flyby(NamedTuple):
    """The changes that a flyby makes, over an ensemble of phases and directions.

    Attributes:
        distance: the least distance, km.
        speed: at infinity, km/s.
        momentum: |Δπ|/|π|, (members,).
        pole: the angle by which the angular momentum turns, °, (members,).
        rates: change of the mean rates of precession and rotation, 360°/period, in °/d, (members, 2).
    """

    distance: float
    speed: float
    momentum: np.ndarray
    pole: np.ndarray
    rates: np.ndarray


def speed_at_infinity(semi_major_axis: float, eccentricity: float, inclination_deg: float) -> float:
    """The speed (km/s) at which an orbit about the Sun, with these elements in au, meets the Earth on a circular orbit.

    Source: Öpik 1951, Proc. R. Irish Acad. 54A: U² = 3 − 1/a − 2 √(a(1 − e²)) cos i, in units of the Earth's speed.
    """
    along = np.sqrt(semi_major_axis * (1 - eccentricity**2)) * np.cos(np.deg2rad(inclination_deg))
    return float(_EARTH_SPEED * np.sqrt(3 - 1 / semi_major_axis - 2 * along))


def hyperbola(distance: float, speed: float) -> orbits.Kepler:
    """The orbit about the Earth with this least distance (km), at t = 0, and speed at infinity (km/s); days, km."""
    square = (speed * 86400.0) ** 2
    return orbits.kepler(MU, -MU / square, 1 + distance * square / MU)


def passage(body: RigidBody, state: State, distance: float, speed: float, members: int, seed: int = 2004) -> Flyby:
    """The flyby of a free body, whose `state` gives its energy and momentum; the ensemble takes phase and direction.

    A member is the state after a random time, turned by a random rotation, 12 days before the least distance. After 24
    days it is compared with itself: torque-free nothing would have changed.
    """
    rng = np.random.default_rng(seed)
    times = jnp.asarray(rng.uniform(0, 1000, members))
    turns = rng.normal(size=(members, 4))
    turns = jnp.asarray(turns / np.linalg.norm(turns, axis=1, keepdims=True))
    orbit = hyperbola(distance, speed)

    def end(t: Array, turn: Array) -> tuple[Array, Array, Array]:
        before = State(so3.multiply(turn, body.solution(state, t).q), so3.Ad(turn, state.p))
        after = through(body, before, orbit)
        change = 360 / mean_periods(body, after) - 360 / mean_periods(body, before)
        size = jnp.linalg.norm(after.p - before.p) / jnp.linalg.norm(before.p)
        return size, jnp.rad2deg(vec3.angle(before.p, after.p)), change

    results = jax.jit(partial(jax.lax.map, lambda x: end(*x), batch_size=min(members, 64)))((times, turns))
    return Flyby(distance, speed, *(np.asarray(x) for x in results))


def through(body: RigidBody, before: State, orbit: orbits.Kepler) -> State:
    """The state 12 days after the least distance, from that 12 days before it."""
    step = schemes.splitting(systems.gravity_gradient(body.inertia, orbit))
    begin = State(before.q, before.p, jnp.asarray(-_HALF), jnp.zeros(()))
    run = integrate(step, begin, 2 * _HALF / _STEPS, _STEPS, save_every=_STEPS)
    return State(run.state.q[-1], run.state.p[-1])
