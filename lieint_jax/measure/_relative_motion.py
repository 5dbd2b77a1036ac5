"""The motion of two bodies about one another: distances, librations, apsides, parts of the energy.

Positions are relative: d = x₂ − x₁, v = ẋ₂ − ẋ₁. Longitudes are angles about the total angular momentum L.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.capabilities import AbstractManyBodies
from lieint_jax.groups import so3
from lieint_jax.measure._series import mean_rate, unwrapped
from lieint_jax.measure._spectrum import line
from lieint_jax.measure._states import angular_momentum, count_bodies, longitude, series_of, times_of
from lieint_jax.runs import Run
from lieint_jax.types import State, Step, vectors

__all__ = [
    "Apsides",
    "Librations",
    "PairEnergies",
    "RelativeMotion",
    "apsides",
    "librations",
    "pair_energies",
    "relative_motion",
]


class RelativeMotion(NamedTuple):
    """The motion of a second body about a first one; arrays (times,) or (times, members), angles in radians.

    Attributes:
        t: the times, (times,).
        distance: |d|.
        longitude: of d about L, continuous in time.
        spin_1, spin_2: the longitudes of the x axes of the two bodies about L, continuous in time.
        libration: the angle of the second body's x axis from the line of centers, in its equator, continuous in time.
        out_of_plane: the angle of the line of centers from the equator of the second body.
        obliquity: the angle of the second body's z axis from the normal of the orbit.
        inclination: the angle of the normal of the orbit from L.
        node: the longitude of the normal of the orbit about L, continuous in time.
    """

    t: np.ndarray
    distance: np.ndarray
    longitude: np.ndarray
    spin_1: np.ndarray
    spin_2: np.ndarray
    libration: np.ndarray
    out_of_plane: np.ndarray
    obliquity: np.ndarray
    inclination: np.ndarray
    node: np.ndarray


def relative_motion(run: Run, first: int = 0, second: int = 1) -> RelativeMotion:
    """How one of several bodies moves about another: orbit, spins, libration, and the plane of the orbit.

    Between two saves the longitudes must deviate from their initial rates, and the other angles from their last value,
    by less than π.

    Args:
        run: of two bodies or more.
        first, second: the numbers of the bodies, from 0.

    Raises:
        ValueError: the run is not of several bodies, has no bodies of these numbers, or is a batch whose step has its
            own time.
    """
    first, second = _two(run, first, second)
    found, rates = series_of(run, _motion_at, first, second)
    t = times_of(run)
    continued = {name: unwrapped(t, found[name], rate[0]) for name, rate in rates.items()}
    continued |= {name: unwrapped(t, found[name]) for name in ("libration", "node")}
    return RelativeMotion(t, **(found | continued))


def _two(run: Run, first: int, second: int) -> tuple[int, int]:
    """The checked numbers of two bodies."""
    count = count_bodies(run)
    if not (0 <= first < count and 0 <= second < count and first != second):
        raise ValueError(f"first and second must be two of the numbers 0 to {count - 1}, got {first} and {second}")
    return int(first), int(second)


def _relative(system: AbstractManyBodies, state: State, first: Array | int, second: Array | int) -> tuple[Array, Array]:
    """d and v."""
    x, v = state.q[:, :3], state.p[:, :3] / system.masses[:, None]
    return x[second] - x[first], v[second] - v[first]


def _motion_at(first: Array, second: Array, step: Step, state: State) -> tuple[dict[str, Array], dict[str, Array]]:
    """The angles at one time, in (−π, π], and the rates of those that circulate."""
    system, (d, v) = step.system, _relative(step.system, state, first, second)  # pyright: ignore[reportArgumentType]
    normal = jnp.stack(vectors.cross(d, v))
    L = angular_momentum(step, state)
    up = L / vectors.norm(L)
    q, Omega = (a[jnp.stack([first, second])] for a in (state.q[:, 3:], system.angular_velocities(state)))  # pyright: ignore[reportAttributeAccessIssue]
    x, z = (jax.vmap(so3.Ad, (0, None))(q, axis) for axis in jnp.eye(3, dtype=state.q.dtype)[jnp.array([0, 2])])
    spins = jnp.sum(jax.vmap(so3.Ad)(q, Omega) * up, axis=1)
    Gamma = so3.Ad_star(q[1], d)
    about_up = partial(longitude, up)
    found = {
        "distance": vectors.norm(d),
        "longitude": about_up(d),
        "spin_1": about_up(x[0]),
        "spin_2": about_up(x[1]),
        "libration": -jnp.arctan2(Gamma[1], Gamma[0]),
        "out_of_plane": jnp.arctan2(Gamma[2], vectors.norm(Gamma[:2])),
        "obliquity": vectors.angle(z[1], normal),
        "inclination": vectors.angle(up, normal),
        "node": about_up(normal),
    }
    orbital = vectors.dot(normal, up) / vectors.dot(d, d)
    return found, {"longitude": orbital, "spin_1": spins[0], "spin_2": spins[1]}


class Apsides(NamedTuple):
    """Periods and apsides of an orbit; scalars or arrays (members,).

    Attributes:
        period: 2π over the mean rate of the longitude, > 0.
        anomalistic_period: the period of the distance, from apsis to apsis.
        eccentricity: the amplitude of the distance at that period over its mean, e to first order in e.
        precession_rate: the mean rate of the line of apsides about L, in radians per unit of time.
    """

    period: np.ndarray
    anomalistic_period: np.ndarray
    eccentricity: np.ndarray
    precession_rate: np.ndarray


def apsides(motion: RelativeMotion) -> Apsides:
    """The mean orbit of a relative motion: periods, eccentricity, precession of the apsides.

    Args:
        motion: `relative_motion(run)` of a run that is saved at even times.

    Returns:
        `Apsides`; NaN where the run has less than one revolution, and all but the period where it is too short to
        resolve the line of the distance.

    Raises:
        ValueError: the times are not evenly spaced.
    """
    revolutions = abs(motion.longitude[-1] - motion.longitude[0]) / (2 * np.pi)
    rate = np.where(revolutions > 1, mean_rate(motion.t, motion.longitude), np.nan)[()]
    frequency, size = _anomalistic(motion, rate)
    precession = rate - np.sign(rate) * 2 * np.pi * frequency
    return Apsides(2 * np.pi / abs(rate), 1 / frequency, size / motion.distance.mean(axis=0), precession)


def _anomalistic(motion: RelativeMotion, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The frequency and the amplitude of the line of the distance near the orbit's mean rate."""
    f = abs(rate) / (2 * np.pi)
    return line(motion.t, motion.distance, 0.9 * f, 1.1 * f)


class Librations(NamedTuple):
    """Lines of the libration of the second body; scalars or arrays (members,).

    Attributes:
        forced: the amplitude at the anomalistic frequency, which the orbit forces, in radians.
        free: the amplitude of the strongest line between 0.4 of the orbit's frequency and the anomalistic one.
        free_period: the period of that line.
    """

    forced: np.ndarray
    free: np.ndarray
    free_period: np.ndarray


def librations(motion: RelativeMotion) -> Librations:
    """The forced and the free libration of the second body, which keeps its x axis toward the first.

    Args:
        motion: `relative_motion(run)` of a run that is saved at even times.

    Returns:
        `Librations`; NaN where the run is too short to resolve the lines.

    Raises:
        ValueError: the times are not evenly spaced.
    """
    t, angle = motion.t, motion.libration
    with np.errstate(divide="ignore"):
        resolved = 2 / abs(t[-1] - t[0])  # half the width of a line under the window
    rate = mean_rate(t, motion.longitude)
    anomalistic = _anomalistic(motion, np.asarray(rate))[0]
    forced = line(t, angle, anomalistic - resolved / 2, anomalistic + resolved / 2).amplitude
    free = line(t, angle, 0.4 * abs(rate) / (2 * np.pi), anomalistic - resolved)
    return Librations(forced, free.amplitude, 1 / free.frequency)


class PairEnergies(NamedTuple):
    """The parts of the energy H of two bodies under gravity; all but `total` add up to it.

    Attributes:
        orbit: the energy of the relative motion of two points, ½μ|v|² − G m₁m₂/|d|.
        spin_1, spin_2: the kinetic energies of rotation, ½ Π·J⁻¹Π.
        shape: V + G m₁m₂/|d|, the part of the potential that is due to the shapes of the bodies.
        total: H.
    """

    orbit: np.ndarray
    spin_1: np.ndarray
    spin_2: np.ndarray
    shape: np.ndarray
    total: np.ndarray


def pair_energies(run: Run) -> PairEnergies:
    """How two bodies exchange energy between orbit, spins and shapes.

    Args:
        run: of two bodies under gravity, with a potential that has the constant `G`.

    Returns:
        `PairEnergies` of arrays (times,) or (times, members). The kinetic energy of the barycenter is left out of the
        parts: they add up if it is at rest.

    Raises:
        ValueError: the run is not of two bodies, or its potential has no `G`.
    """
    bodies, potential = count_bodies(run), getattr(run.system, "potential", None)
    if bodies != 2 or not hasattr(potential, "G"):
        raise ValueError(
            "pair_energies needs a run of two bodies under gravity, such as potentials.maccullagh(G, …), got "
            f"{bodies} in {potential!r}"
        )
    return series_of(run, _energies_at)


def _energies_at(step: Step, state: State) -> PairEnergies:
    system = step.system
    m, (d, v) = system.masses, _relative(system, state, 0, 1)  # pyright: ignore
    points = system.potential.G * m[0] * m[1] / vectors.norm(d)  # pyright: ignore
    Pi = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:])
    spins = jnp.sum(Pi * system.angular_velocities(state), axis=1) / 2  # pyright: ignore
    orbit = m[0] * m[1] / (m[0] + m[1]) * vectors.dot(v, v) / 2 - points
    shape = system.potential_energy(state.q) + points  # pyright: ignore
    return PairEnergies(orbit, spins[0], spins[1], shape, system.energy(state))  # pyright: ignore
