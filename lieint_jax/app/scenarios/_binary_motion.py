"""Measured motions of two bodies about one another: periods, librations, energies.

Positions are relative: d = x₂ − x₁, v = ẋ₂ − ẋ₁. Longitudes are angles about the total angular momentum L, which is
conserved.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.app.scenarios._runs import series
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run, integrate
from lieint_jax.systems import RigidBodies
from lieint_jax.types import State, Step, vectors

_MAX_ITERATIONS = 8  # of Newton's method for the speed
_TOLERANCE = 1e-5  # largest last correction over the change; the error that Newton's method leaves is its square


class Motion(NamedTuple):
    """Angles in rad at the saved times, (times, members); longitudes and librations are continuous in time.

    Attributes:
        distance: |d|.
        longitude: the longitude of d.
        spin_1, spin_2: the longitudes of the x axes of the two bodies.
        libration: the angle of the secondary's x axis from the line of centers, in its own equator.
        out_of_plane: the angle of the line of centers from the secondary's equator.
        obliquity_2: the angle of the secondary's z axis from the normal of the orbit.
        inclination: the angle of the normal of the orbit from L.
        node: the longitude of the normal of the orbit.
    """

    distance: np.ndarray
    longitude: np.ndarray
    spin_1: np.ndarray
    spin_2: np.ndarray
    libration: np.ndarray
    out_of_plane: np.ndarray
    obliquity_2: np.ndarray
    inclination: np.ndarray
    node: np.ndarray


class Energies(NamedTuple):
    """The parts of the energy H; all but `total` add up to it.

    Attributes:
        orbit: the energy of the relative motion of two points, ½μ|v|² − G m₁m₂/|d|.
        spin_1, spin_2: the kinetic energies of rotation, ½ Π·J⁻¹Π.
        shape: V₂ = V + G m₁m₂/|d|, the part of the potential that is due to their shapes.
        total: H.
    """

    orbit: Any
    spin_1: Any
    spin_2: Any
    shape: Any
    total: Any


def relative_motion(system: RigidBodies, state: State) -> tuple[Array, Array]:
    """The relative position d and the relative velocity v."""
    x, v = state.q[:, :3], state.p[:, :3] / system.masses[:, None]
    return x[1] - x[0], v[1] - v[0]


def measure_motion(run: Run) -> Motion:
    """The angles and distances of a run."""
    angles, rates = series(_motion_at, run)
    continued = {name: continue_angle(run.t, getattr(angles, name), rate) for name, rate in rates.items()}
    continued["libration"] = np.unwrap(angles.libration, axis=0)
    continued["node"] = np.unwrap(angles.node, axis=0)
    return angles._replace(**continued)


def continue_angle(t: np.ndarray | Array, angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Continue angles (times, …) over 2π; between two saves they must deviate from their first rate by less than π."""
    elapsed = (np.asarray(t) - t[0]).reshape(-1, *[1] * (angle.ndim - 1))
    return rate[0] * elapsed + np.unwrap(angle - rate[0] * elapsed, axis=0)


def _motion_at(system: RigidBodies, state: State) -> tuple[Motion, dict[str, Array]]:
    """The angles at one time, in (−π, π], and the rates of those that circulate."""
    d, v = relative_motion(system, state)
    normal = jnp.stack(vectors.cross(d, v))
    L = system.momentum(state)[3:]
    up = L / vectors.norm(L)
    attitudes, Omega = state.q[:, 3:], system.angular_velocities(state)
    x, z = (jax.vmap(so3.Ad, (0, None))(attitudes, axis) for axis in (jnp.eye(3)[0], jnp.eye(3)[2]))
    spins = jnp.sum(jax.vmap(so3.Ad)(attitudes, Omega) * up, axis=1)
    Gamma = so3.Ad_star(attitudes[1], d)
    about_up = partial(longitude, up)
    angles = Motion(
        distance=vectors.norm(d),  # pyright: ignore[reportArgumentType]
        longitude=about_up(d),
        spin_1=about_up(x[0]),
        spin_2=about_up(x[1]),
        libration=-jnp.arctan2(Gamma[1], Gamma[0]),  # pyright: ignore[reportArgumentType]
        out_of_plane=jnp.arcsin(Gamma[2] / vectors.norm(d)),  # pyright: ignore[reportArgumentType]
        obliquity_2=vectors.angle(z[1], normal),  # pyright: ignore[reportArgumentType]
        inclination=vectors.angle(up, normal),  # pyright: ignore[reportArgumentType]
        node=about_up(normal),
    )
    orbital = vectors.dot(normal, up) / vectors.dot(d, d)
    return angles, {"longitude": orbital, "spin_1": spins[0], "spin_2": spins[1]}


def longitude(up: Array, a: Array) -> Any:
    """The angle of `a` about the unit vector `up`."""
    e1, e2 = frame(up)
    return jnp.arctan2(vectors.dot(e2, a), vectors.dot(e1, a))


def energies(system: RigidBodies, state: State) -> Energies:
    """The parts of the energy at a state."""
    m, (d, v) = system.masses, relative_motion(system, state)
    points = system.potential.G * m[0] * m[1] / vectors.norm(d)  # pyright: ignore[reportFunctionMemberAccess]
    Pi = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:])
    spins = jnp.sum(Pi * system.angular_velocities(state), axis=1) / 2
    orbit = m[0] * m[1] / (m[0] + m[1]) * vectors.dot(v, v) / 2 - points
    return Energies(orbit, spins[0], spins[1], system.potential_energy(state.q) + points, system.energy(state))


def mean_rate(t: np.ndarray | Array, angle: Any) -> Any:
    """The mean rate of an angle (times, …): the slope of its least-squares line."""
    centered = t - t.mean()
    return (centered @ angle) / (centered @ centered)


def with_speed_change(system: RigidBodies, state: State, change: Array) -> State:
    """The state with `change` added to the speed of the relative motion, across the line of centers."""
    m, (d, v) = system.masses, relative_motion(system, state)
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
        angles = jax.vmap(lambda z: longitude(up, relative_motion(system, z)[0]))(run.state)
        return 2 * jnp.pi / mean_rate(run.t, jnp.unwrap(angles))

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
