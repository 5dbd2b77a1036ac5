"""A Kepler orbit whose node, periapsis and mean anomaly drift because of the oblateness of the center."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import cross
from lieint_jax.core import pytree, static
from lieint_jax.orbits._earth import EARTH_J2, EARTH_RADIUS
from lieint_jax.orbits._kepler import Kepler, kepler

__all__ = ["SecularJ2", "secular_j2"]


@pytree
class SecularJ2:
    """A Kepler ellipse with the secular rates of J₂: `orbit(t)` is position and velocity. Made by `secular_j2`.

    Attributes:
        osculating: the ellipse at the time of periapsis.
        J2: the coefficient of oblateness.
        radius: the equatorial radius that J₂ belongs to.
        frame: the axes, such as "TEME" of the elements of a TLE; "" if they are not named.
    """

    osculating: Kepler
    J2: Array
    radius: Array
    frame: str = static(default="")

    @property
    def mu(self) -> Array:
        """The gravitational parameter."""
        return self.osculating.mu

    @property
    def mean_motion(self) -> Array:
        """n of the ellipse, in radians per unit of time."""
        return self.osculating.mean_motion

    @property
    def rates(self) -> tuple[Array, Array, Array]:
        """The rates of the node, of the periapsis, and of the mean anomaly, in radians per unit of time."""
        e, n = self.osculating.eccentricity, self.mean_motion
        cosine = jnp.cos(self.osculating.inclination)
        rest = 1 - e * e
        unit = 0.75 * self.J2 * (self.radius / (self.osculating.semi_major_axis * rest)) ** 2 * n
        square = cosine * cosine
        return -2 * unit * cosine, unit * (5 * square - 1), n + unit * jnp.sqrt(rest) * (3 * square - 1)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and its exact derivative, the velocity (3,), at time t."""
        orbit, since = self.osculating, t - self.osculating.periapsis_time
        node_rate, periapsis_rate, anomaly_rate = self.rates
        drift = anomaly_rate / self.mean_motion  # of the clock of the ellipse
        node, periapsis = orbit.node + node_rate * since, orbit.periapsis + periapsis_rate * since
        moved = dataclasses.replace(orbit, node=node, periapsis=periapsis, periapsis_time=jnp.zeros_like(since))
        r, v = moved(drift * since)
        i = orbit.inclination
        normal = jnp.stack([jnp.sin(i) * jnp.sin(node), -jnp.sin(i) * jnp.cos(node), jnp.cos(i)])
        rotation = periapsis_rate * normal + node_rate * jnp.asarray([0.0, 0.0, 1.0], normal.dtype)
        return r, drift * v + jnp.stack(cross(rotation, r))


def secular_j2(
    mu: ArrayLike,
    semi_major_axis: ArrayLike,
    eccentricity: ArrayLike,
    inclination: ArrayLike,
    *,
    node: ArrayLike = 0.0,
    periapsis: ArrayLike = 0.0,
    periapsis_time: ArrayLike = 0.0,
    J2: ArrayLike = EARTH_J2,
    radius: ArrayLike = EARTH_RADIUS,
) -> SecularJ2:
    """An ellipse about an oblate center: node, periapsis and mean anomaly drift at their secular rates, to first order.

    With p = a(1 − e²), n = √(μ/a³) and U = ¾J₂(R/p)²n

        node −2U cos i,    periapsis U(5cos²i − 1),    mean anomaly n + U√(1−e²)(3cos²i − 1)

    The periodic variations, about J₂(R/p)² of the radius (10 km for a satellite near the Earth), are omitted.

    The mean motion of a TLE is not this n: it contains the drift of the mean anomaly already, and its a from Kepler's
    law is off by about a kilometer. `files.read_tle(…).secular_j2()` takes it out: it iterates a = (μ(1 + D)²/n²)^(1/3)
    from D = 0, with D = ¾J₂(R/p)²√(1−e²)(3cos²i − 1).

    Args:
        mu, semi_major_axis, eccentricity, inclination, node, periapsis, periapsis_time: as in `kepler`, the mean
            elements of an ellipse at the time of periapsis. The pole of the center is the axis z.
        J2: by default that of the Earth.
        radius: the equatorial radius R in the orbit's unit of length; by default that of the Earth in km.

    Raises:
        ValueError: the elements are not those of an ellipse, the radius is not positive, or the periapsis is below the
            ground.

    Source: Brouwer 1959, Astron. J. 64; Kozai 1959, Astron. J. 64; Vallado 2013, Fundamentals of Astrodynamics, 9.6.
    """
    orbit = kepler(
        mu, semi_major_axis, eccentricity, inclination, node=node, periapsis=periapsis, periapsis_time=periapsis_time
    )
    if concrete(orbit) and not float(orbit.eccentricity) < 1:
        raise ValueError(f"secular rates are those of an ellipse, got eccentricity = {float(orbit.eccentricity):g}")
    R, j2 = _checks.positive("radius", radius), _checks.real_array("J2", J2, ())
    if concrete(orbit, R):
        lowest = float(orbit.semi_major_axis * (1 - orbit.eccentricity))
        if lowest < float(R):
            raise ValueError(
                f"the periapsis is below the ground: {lowest:g} from the center, whose radius is {float(R):g}; "
                "give the radius in the orbit's unit of length"
            )
    dtype = orbit.mu.dtype
    return SecularJ2(orbit, j2.astype(dtype), R.astype(dtype))


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    elements = {"mu": 1.3, "semi_major_axis": 1.1, "eccentricity": 0.1, "inclination": 0.7}
    angles = {"node": 0.4, "periapsis": 0.2, "periapsis_time": 0.1}
    return {"secular_j2": partial(secular_j2, **elements, **angles, J2=0.1, radius=0.3)}
