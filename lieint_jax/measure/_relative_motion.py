"""The motion of two bodies about one another: distances, librations, apsides, parts of the energy.

Positions are relative: d = x₂ − x₁, v = ẋ₂ − ẋ₁. Longitudes are angles about the total angular momentum L.

The ellipse of an instant is the one on which two points would go on from d and v. Its long axis is Laplace's vector
e = v × (d × v)/μ − d/|d|, μ = G(m₁ + m₂), which is constant in Kepler's motion (Laplace 1799; Runge and Lenz).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Vector3
from lieint_jax.core import State, Step
from lieint_jax.groups import so3
from lieint_jax.measure._revolutions import mean_ellipse
from lieint_jax.measure._series import unwrapped
from lieint_jax.measure._spectrum import line
from lieint_jax.measure._states import angular_momentum, count_bodies, longitude, series_of, times_of
from lieint_jax.phase_spaces import frame
from lieint_jax.potentials import PolyhedronGravity, SumPotential
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractManyBodies

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
        eccentricity: of the ellipse of the instant, |e|.
        pericenter: the longitude of its pericenter, in (−π, π]. An inclined orbit is first rotated about its line of
            nodes into the plane normal to L.
        mean_longitude: that of the pericenter and the mean anomaly, continuous in time. It grows evenly on an ellipse.

    The last three are NaN if the potential has no constant of gravity `G`, and the mean longitude for e ≥ 1.
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
    eccentricity: np.ndarray
    pericenter: np.ndarray
    mean_longitude: np.ndarray


def relative_motion(run: Run, first: int = 0, second: int = 1) -> RelativeMotion:
    """How one of several bodies moves about another: orbit, spins, libration, and the plane of the orbit.

    Between two saves the rotation of each body must deviate from its initial rate by less than π, the mean longitude
    from its initial rate too, and the other angles from their last value. The longitude follows the mean longitude,
    however eccentric the orbit; where there is none, it must not deviate from its initial rate by π.

    Args:
        run: of two bodies or more.
        first, second: the numbers of the bodies, from 0.

    Raises:
        ValueError: the run is not of several bodies, has no bodies of these numbers, or is a batch whose step has its
            own time.
    """
    first, second = _two(run, first, second)
    found, in_plane, rates = series_of(run, _motion_at, first, second)
    t = times_of(run)
    continued = {name: unwrapped(t, found[name], rate[0]) for name, rate in rates.items()}
    continued |= {name: unwrapped(t, found[name]) for name in ("libration", "node")}
    along = continued["mean_longitude"]
    for angle in (in_plane, found["longitude"]):  # each less than π from the one before
        along = along + np.remainder(angle - along + np.pi, 2 * np.pi) - np.pi
    bound = np.isfinite(along).all(axis=0)
    continued["longitude"] = np.where(bound, along, continued["longitude"])
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


def _gravity(potential: object) -> Array | None:
    """The constant of gravity of a potential, or of the one term of a sum that has one; None if it has none."""
    if isinstance(potential, SumPotential):
        found = [G for G in map(_gravity, potential.terms) if G is not None]
        return found[0] if len(found) == 1 else None
    owner = potential.polyhedron if isinstance(potential, PolyhedronGravity) else potential
    return getattr(owner, "G", None)


def _motion_at(
    first: Array, second: Array, step: Step, state: State
) -> tuple[dict[str, Array], Array, dict[str, Array]]:
    """The angles at one time, in (−π, π], that of d in the orbit's plane, and the rates of those that circulate."""
    system, (d, v) = step.system, _relative(step.system, state, first, second)  # pyright: ignore[reportArgumentType]
    normal = jnp.stack(vectors.cross(d, v))
    L = angular_momentum(step, state)
    up = L / vectors.norm(L)
    q, Omega = (a[jnp.stack([first, second])] for a in (state.q[:, 3:], system.angular_velocities(state)))  # pyright: ignore[reportAttributeAccessIssue]
    x, z = (jax.vmap(so3.Ad, (0, None))(q, axis) for axis in jnp.eye(3, dtype=state.q.dtype)[jnp.array([0, 2])])
    spins = jnp.sum(jax.vmap(so3.Ad)(q, Omega) * up, axis=1)
    Gamma = so3.Ad_star(q[1], d)
    about_up = partial(longitude, up)
    G = _gravity(system.potential)  # pyright: ignore[reportAttributeAccessIssue]
    mu = (jnp.nan if G is None else G) * (system.masses[first] + system.masses[second])  # pyright: ignore
    ellipse, in_plane, mean_motion = _ellipse(mu, d, v, normal, up)
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
        **ellipse,
    }
    orbital = vectors.dot(normal, up) / vectors.dot(d, d)
    rates = {"longitude": orbital, "spin_1": spins[0], "spin_2": spins[1], "mean_longitude": mean_motion}
    return found, in_plane, rates


def _ellipse(mu: Array, d: Vector3, v: Vector3, normal: Vector3, up: Vector3) -> tuple[dict[str, Array], Array, Array]:
    """The ellipse of an instant, the longitude of d after the rotation of its plane, and the mean motion.

    The mean longitude is computed without e and the pericenter, of which a circle has none: λ = θ − (ν − E) − e sin E,
    with tan ½(ν − E) = e sin E/(1 + √(1 − e²) − e cos E).
    """
    sense = jnp.where(vectors.dot(normal, up) < 0, -1, 1).astype(d.dtype)
    size, r = vectors.norm(normal), vectors.norm(d)
    n = sense * normal / size
    axis, cosine = jnp.stack(vectors.cross(up, n)), vectors.dot(up, n)  # of the least rotation from up to n

    def tilted(a: Vector3) -> Vector3:
        change = jnp.stack(vectors.cross(axis, a))
        return a + change + jnp.stack(vectors.cross(axis, change)) / (1 + cosine)

    e1, e2 = map(tilted, frame(up))

    def in_plane(a: Vector3) -> Array:
        return jnp.arctan2(vectors.dot(e2, a), vectors.dot(e1, a))

    e = jnp.stack(vectors.cross(v, normal)) / mu - d / r
    inverse = 2 / r - vectors.dot(v, v) / mu  # 1/a, > 0 of an ellipse
    a = jnp.where(inverse > 0, 1 / jnp.where(inverse > 0, inverse, 1), jnp.nan)
    root = jnp.sqrt(mu * a)
    along, across = 1 - r / a, vectors.dot(d, v) / root  # e cos E, e sin E
    theta = in_plane(d)
    mean = theta - sense * (2 * jnp.arctan2(across, 1 + size / root - along) + across)
    return (
        {"eccentricity": vectors.norm(e), "pericenter": in_plane(e), "mean_longitude": mean},
        theta,
        sense * root / a**2,
    )


class Apsides(NamedTuple):
    """The mean ellipse of an orbit; scalars or arrays (members,), times in the run's unit.

    Attributes:
        period: 2π over the mean rate of the longitude, > 0.
        anomalistic_period: the mean time from pericenter to pericenter, > 0.
        eccentricity: the length of Laplace's vector, averaged over revolutions in axes that follow it.
        precession_rate: the mean rate of the pericenter about L, in radians per unit of time.
        eccentricity_error, precession_error: their standard errors.
    """

    period: np.ndarray
    anomalistic_period: np.ndarray
    eccentricity: np.ndarray
    precession_rate: np.ndarray
    eccentricity_error: np.ndarray
    precession_error: np.ndarray


def apsides(motion: RelativeMotion) -> Apsides:
    """How fast the line of apsides precesses, with its standard error, and the mean periods: by Laplace's vector.

    The vector is averaged over each revolution from pericenter to pericenter (by Hann's windows, two revolutions wide),
    and the argument of these means is fitted by a line. So all that repeats with the orbit drops out, at any
    eccentricity: an oblate body forces a vector that rotates with the orbit, and may be longer than the one that
    precesses. The rate must be less than half a revolution per revolution.

    The standard errors are those of the scatter of the means about the fit, as it is correlated over up to √n of n
    revolutions: noise, sparse saves, other lines. They do not include terms of longer periods, of which a run shows
    only a part, nor the errors of the scheme, nor of G. From fewer than about 12 revolutions they are too small, by a
    factor of 2 to 5 from 6.

    Args:
        motion: `relative_motion(run)`, saved at any times: several a revolution, or one in each for Kepler's motion.

    Returns:
        `Apsides`; NaN if the run has less than one revolution, is of no ellipse, or its potential has no `G`. In less
        than four revolutions all but the period are NaN. A circle has no pericenter: where the mean vector is shorter
        than the scatter of the means, or than round-off, precession and anomalistic period are NaN.

    Source: Hann's windows and the argument as in Laskar 1993, Physica D 67, 257; the errors: Newey & West 1987,
    Econometrica 55, 703.
    """
    columns = [np.asarray(x, float) for x in (motion.mean_longitude, motion.eccentricity, motion.pericenter)]
    rounding = float(np.finfo(motion.eccentricity.dtype).eps)
    t = np.asarray(motion.t, float)
    members = zip(*(x.reshape(len(t), -1).T for x in columns), strict=True)
    found = np.array([mean_ellipse(t, along, e * np.exp(1j * angle), rounding) for along, e, angle in members])
    rate, e, precession, *errors = found.reshape(-1, 5).T.reshape(5, *columns[0].shape[1:])
    with np.errstate(divide="ignore"):
        periods = (2 * np.pi / abs(x) for x in (rate, rate - precession))
        return Apsides(*(x[()] for x in (*periods, e, precession, *errors)))


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
    t, angle, orbit = motion.t, motion.libration, apsides(motion)
    with np.errstate(divide="ignore"):
        resolved = 2 / abs(t[-1] - t[0])  # half the width of a line under the window
    anomalistic = 1 / orbit.anomalistic_period
    forced = line(t, angle, anomalistic - resolved / 2, anomalistic + resolved / 2).amplitude
    free = line(t, angle, 0.4 / orbit.period, anomalistic - resolved)
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
    if bodies != 2 or _gravity(potential) is None:
        raise ValueError(
            "pair_energies needs a run of two bodies under gravity, such as potentials.maccullagh(G, …), got "
            f"{bodies} in {potential!r}"
        )
    return series_of(run, _energies_at)


def _energies_at(step: Step, state: State) -> PairEnergies:
    system = step.system
    m, (d, v) = system.masses, _relative(system, state, 0, 1)  # pyright: ignore
    points = _gravity(system.potential) * m[0] * m[1] / vectors.norm(d)  # pyright: ignore
    Pi = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:])
    spins = jnp.sum(Pi * system.angular_velocities(state), axis=1) / 2  # pyright: ignore
    orbit = m[0] * m[1] / (m[0] + m[1]) * vectors.dot(v, v) / 2 - points
    shape = system.potential_energy(state.q) + points  # pyright: ignore
    return PairEnergies(orbit, spins[0], spins[1], shape, system.energy(state))  # pyright: ignore
