"""A tumbling body that passes a planet: its members, their states from periods and phases, passages and derivatives.

Units: km for the orbit, h for times, rad for angles; the greatest moment of inertia is 1, only ratios count.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _free_body, orbits, systems
from lieint_jax.app.scenarios._body import direction, longitude_latitude
from lieint_jax.app.scenarios._kind import step_of as step_by
from lieint_jax.app.scenarios._runs import Numbers, angles, map_on_local_devices
from lieint_jax.groups import so3
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBody
from lieint_jax.types import State, Step, pytree, static, vectors

_TRIES = 16  # draws of a member's moments; the first for which the mode exists is used
_FREE_STEPS = 128  # of the torque-free motion, where it is differentiated


class Spin(NamedTuple):
    """A tumbling state before the passage; arrays of one shape.

    Both phases are those of the torque-free motion.
    """

    least: Numbers  # the principal moment about the body's x axis, over the greatest
    middle: Numbers  # that about its y axis, over the greatest
    precession: Numbers  # P_φ, the mean period of the long axis x about the angular momentum, in h
    rotation: Numbers  # P_ψ, the period of the angular momentum in the body, in h
    longitude: Numbers  # of the angular momentum
    latitude: Numbers  # of the angular momentum
    phi: Numbers  # at the perigee, the angle about the angular momentum from the line Earth–body to the long axis x
    psi: Numbers  # at the perigee, 2π times the part of P_ψ that has passed since Π lay between x and z, nearest to x


class Outcome(NamedTuple):
    """The invariants of a tumbling state, before or after a passage."""

    precession: Numbers  # P_φ, in h
    rotation: Numbers  # P_ψ, in h
    long_axis: Numbers  # whether it is a long-axis mode
    momentum: Numbers  # |π|
    rate: Numbers  # 2H/|π|, the effective spin rate
    excitation: Numbers  # 2H J₃/|π|², the energy over that of the principal-axis state of least energy
    pole: Numbers  # the direction of π, (3,)


@pytree
class GivenOrbit:
    """A Kepler orbit with the given elements, those of `orbits.kepler`. It has no leaves, so members with different
    bodies share it: its position is computed once per step, not once per member."""

    elements: tuple[float, ...] = static()

    @property
    def mu(self) -> Array:
        return jnp.asarray(self.elements[0])

    def __call__(self, t: Array) -> tuple[Array, Array]:
        return orbits.kepler(*self.elements)(t)


def moments(spin: Spin) -> Array:
    """Principal moments about x, y, z, (3,)."""
    return jnp.stack([spin.least, spin.middle, jnp.ones_like(spin.least)])


def state_at_perigee(spin: Spin, toward: Array, long_axis: bool) -> State:
    """The torque-free state at the perigee; `toward` is the direction of the body from the Earth there."""
    pole = direction(spin.longitude, spin.latitude)
    phases = {"phi": spin.phi, "psi": spin.psi, "toward": toward}
    return systems.tumbling_state(moments(spin), spin.precession, spin.rotation, pole, long_axis=long_axis, **phases)


def outcome(J: Array, state: State) -> Outcome:
    """The invariants of the free motion from a state."""
    body = RigidBody(J)
    found, size = body.periods(state), vectors.norm(state.p)
    double = 2 * body.energy(state)
    return Outcome(*found, size, double / size, double * jnp.max(J) / size**2, state.p / size)


def step_of(J: Array, orbit: orbits.Kepler | GivenOrbit, order: int) -> Step:
    """The symplectic step of a body on an orbit."""
    return step_by(systems.gravity_gradient(J, orbit), "splitting", order)


def step_and_state(
    spin: Spin, orbit: orbits.Kepler | GivenOrbit, t: Array, order: int, long_axis: bool
) -> tuple[Step, State]:
    """The step of one member, and its state at the time t, with work 0; the motion until then is free."""
    J, near = moments(spin), state_at_perigee(spin, orbit(jnp.zeros_like(t))[0], long_axis)
    state = RigidBody(J).solution(near, t)
    return step_of(J, orbit, order), state._replace(t=t, work=jnp.zeros_like(t))


def members(scenario: Any) -> tuple[Spin, np.ndarray]:
    """The members' spins, the nominal one first, and whether the mode exists for the first draw of each.

    A member is the same in ensembles of every size.
    """
    spin, seed = scenario.spin, jax.random.key(scenario.seed)
    known = np.array([[x.value, *x.sides()] for x in spin.measured().values()])
    known[:, 1:] /= scenario.sigmas
    phases = np.deg2rad([spin.precession_phase_deg, spin.rotation_phase_deg])
    spins, good = _draw_member(seed, jnp.arange(scenario.members), known, phases, spin.long_axis)
    good = np.asarray(good)
    if failed := int((~good.any(axis=1)).sum()):
        raise ValueError(f"{failed} members: none of {_TRIES} draws within the errors is a {spin.mode} mode")
    return spins, good[:, 0]


@partial(jax.jit, static_argnums=4)
@partial(jax.vmap, in_axes=(None, 0, None, None, None))
def _draw_member(seed: Array, k: Array, known: Array, phases: Array, long_axis: bool) -> tuple[Spin, Array]:
    """The k-th member, and whether the mode exists for each of its draws, (_TRIES,).

    `known` has a row for each key of `SpinValues`: value, standard deviations below and above.
    """
    key = jax.random.fold_in(seed, k)
    noise = jnp.where(k == 0, 0.0, jax.random.normal(key, (_TRIES, 6)))
    drawn = known[:, 0] + jnp.where(noise < 0, known[:, 1], known[:, 2]) * noise
    least, middle, precession, rotation = drawn.T[:4]
    ordered = (least > 0) & (least < middle) & (middle < 1)
    J = jnp.stack([jnp.where(ordered, least, 0.5), jnp.where(ordered, middle, 0.75), jnp.ones_like(least)], axis=1)
    exists = jax.vmap(lambda J, ratio: _free_body.mode_exists(J, ratio, long_axis))(J, rotation / precession)
    good = ordered & exists
    first = jnp.argmax(good)
    longitude, latitude = _along_great_circle(*jnp.deg2rad(known[4:, 0]), *jnp.deg2rad(drawn[0, 4:] - known[4:, 0]))
    uniform = jax.random.uniform(jax.random.fold_in(key, 1), (2,)) * 2 * jnp.pi
    phi, psi = jnp.where(k == 0, phases, uniform)
    return Spin(least[first], middle[first], precession[first], rotation[first], longitude, latitude, phi, psi), good


def _along_great_circle(longitude: Array, latitude: Array, east: Array, north: Array) -> tuple[Array, Array]:
    """The longitude and latitude at the end of an arc (east, north) of a great circle, rad."""
    pole = direction(longitude, latitude)
    to_east = jnp.stack([-jnp.sin(longitude), jnp.cos(longitude), jnp.zeros_like(longitude)])
    to_north = direction(longitude, latitude + jnp.pi / 2)
    away = east * to_east + north * to_north
    x, y, z = so3.Ad(so3.exp(jnp.stack(vectors.cross(pole, away))), pole)
    return jnp.arctan2(y, x), jnp.arcsin(z)


class SpinChange(NamedTuple):
    """The changes of the members' spins by a passage."""

    momentum: np.ndarray  # |π| after, over that before
    rate: np.ndarray  # 2H/|π| after, over that before
    pole_angle: np.ndarray  # the angle between the poles before and after, in degrees
    longitude: np.ndarray  # the change of the pole's longitude, in degrees
    latitude: np.ndarray  # the change of the pole's distance from the ecliptic, in degrees
    same_mode: np.ndarray  # whether the mode is the same


class Passage(NamedTuple):
    """The passages of members."""

    before: Outcome  # their spins before
    after: Outcome  # those after
    q: Array  # the attitudes at the end
    converged: Array  # whether every step converged

    @property
    def change(self) -> SpinChange:
        """The changes of the spins."""
        before, after = self.before, self.after
        longitudes, latitudes = np.asarray(longitude_latitude(np.stack([before.pole, after.pole]))).transpose(2, 0, 1)
        return SpinChange(
            after.momentum / before.momentum,
            after.rate / before.rate,
            np.rad2deg(angles(before.pole, after.pole)),
            (longitudes[1] - longitudes[0] + 180) % 360 - 180,
            abs(latitudes[1]) - abs(latitudes[0]),
            after.long_axis == before.long_axis,
        )


@cache
def passages(order: int, long_axis: bool) -> Callable[..., Passage]:
    """The function (spins, elements of the orbit, times (N + 1,) of steps) ↦ passages of many members."""

    def passage(spin: Spin, elements: Array, times: Array) -> Passage:
        start = step_and_state(spin, orbits.kepler(*elements), times[0], order, long_axis)
        return _integrate_passage(moments(spin), *start, times)

    return _map_over_members(passage)


def _map_over_members(function: Callable[..., Any]) -> Callable[..., Any]:
    """Map a function (spin, elements, times) of one member over many, on all devices, for arrays of the host."""
    mapped = map_on_local_devices(function, (0, None, None))
    return lambda spins, *given: jax.tree.map(np.asarray, mapped(spins, *map(jnp.asarray, given)))


def _integrate_passage(J: Array, step: Step, state: State, times: Array) -> Passage:
    run = integrate(step, state, times=times, save_every=times.shape[0] - 1)
    last = jax.tree.map(lambda x: x[-1], run.state)
    return Passage(outcome(J, state), outcome(J, last), last.q, jnp.all(run.info.converged))


@cache
def slopes(order: int, long_axis: bool) -> Callable[..., dict[str, np.ndarray]]:
    """As `passages`, ↦ derivatives of (P_φ, P_ψ, 2H/|π|, angle of the pole) after passages, each (members, 4).

    They are those by each part of `Spin`, by its name, and by the distance of the "perigee" at constant energy of the
    orbit, in forward mode through all steps.
    """

    def spin_after(spin: Spin, perigee: Array, elements: Array, times: Array) -> Array:
        mu, a, _, *others = elements
        orbit = orbits.kepler(mu, a, 1 - perigee / a, *others)
        J = moments(spin)
        near = state_at_perigee(spin, orbit(jnp.zeros_like(times[0]))[0], long_axis)
        # by steps: with tangents of `solution` the program takes half as long again to compile
        free = step_by(RigidBody(J), "so3_midpoint", order)
        run = integrate(free, near, times[0] / _FREE_STEPS, _FREE_STEPS, save_every=_FREE_STEPS)
        state = jax.tree.map(lambda x: x[-1], run.state)
        state = state._replace(t=times[0], work=jnp.zeros_like(times[0]))
        found = _integrate_passage(J, step_of(J, orbit, order), state, times)
        pole_angle = vectors.angle(found.before.pole, found.after.pole)
        return jnp.stack([found.after.precession, found.after.rotation, found.after.rate, pole_angle])

    def slopes_of_member(spin: Spin, elements: Array, times: Array) -> dict[str, Array]:
        perigee = elements[1] * (1 - elements[2])
        by_spin, by_perigee = jax.jacfwd(spin_after, argnums=(0, 1))(spin, perigee, elements, times)
        return by_spin._asdict() | {"perigee": by_perigee}

    return _map_over_members(slopes_of_member)
