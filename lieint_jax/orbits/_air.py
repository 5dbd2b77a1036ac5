"""The upper atmosphere of the Earth along an orbit, and what orbits around the Earth must satisfy."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, named, not_negative, positive
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import cross, norm
from lieint_jax.core import Converted, argument, callable_pytree, pytree
from lieint_jax.orbits._earth import EARTH_RADIUS, EARTH_RATE, equatorial
from lieint_jax.orbits._from_state import KeplerFromState
from lieint_jax.orbits._kepler import Kepler, kepler
from lieint_jax.orbits._secular import SecularJ2
from lieint_jax.orbits._table import Table

__all__ = ["Air", "atmosphere"]

_FAR = 100.0  # radii of the Earth: an orbit further away was given in another unit


@pytree
class Air:
    """The air along an orbit: ρ(r) = ρ₀ exp(−(r − R − h₀)/H), which rotates with the Earth.

    | h₀, km | 300 | 350 | 400 | 450 | 500 | 600 |
    |---|---|---|---|---|---|---|
    | ρ₀, kg/m³ | 2.418e-11 | 9.518e-12 | 3.725e-12 | 1.585e-12 | 6.967e-13 | 1.454e-13 |
    | H, km | 53.628 | 53.298 | 58.515 | 60.828 | 63.822 | 71.835 |

    At a given height the density varies by a factor of ten with the activity of the Sun. `air(t)` is the density and
    the velocity of the satellite relative to the air in space, (3,).

    Args:
        orbit: t ↦ (position, velocity) from the center in inertial axes, z to the pole. The torque of
            `torques.aerodynamic` has the units of this orbit: positions in meters for N m.
        density: ρ₀ > 0 at the height h₀.
        scale_height: H > 0.
        height: h₀ ≥ 0.
        radius: R in the orbit's unit of length; by default that of the Earth in km.
        rate: the rotation of the air, in radians per unit of time.

    Raises:
        ValueError: numbers are out of range, or the orbit is below the ground, in another unit of length than the
            radius, or in axes that are known to rotate or to have another z.

    Source: Vallado 2013, Fundamentals of Astrodynamics, table 8-4.
    """

    orbit: Converted[Any] = argument(converter=lambda orbit: callable_pytree(equatorial(orbit)))
    density: Converted[Array] = argument(converter=named(positive, "density"))
    scale_height: Converted[Array] = argument(converter=named(positive, "scale_height"))
    height: Converted[Array] = argument(converter=named(not_negative, "height"))
    _: dataclasses.KW_ONLY
    radius: Converted[Array] = argument(converter=named(positive, "radius"), default=EARTH_RADIUS)
    rate: Converted[Array] = argument(converter=named(_checks.real_array, "rate", ()), default=EARTH_RATE)

    def check_fields(self) -> None:
        """Raise ValueError if the orbit is below the ground or in another unit."""
        above_ground(self.orbit, self.radius)

    @property
    def distance(self) -> Array:
        """R + h₀."""
        return self.radius + self.height

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """The density, (), and v − ω × r in space, (3,)."""
        r, v = self.orbit(t)
        wind = jnp.stack(cross(jnp.stack([0 * self.rate, 0 * self.rate, self.rate]), r))
        height = norm(r) - self.distance
        return self.density * jnp.exp(-height / self.scale_height), v - wind


def above_ground(orbit: Any, radius: Array) -> None:
    """ValueError if an orbit is not a function, is below the ground at its start or periapsis, or has another unit."""
    _checks.orbit(orbit)
    if not concrete(orbit, radius):
        return
    lowest = _lowest(orbit)
    if lowest is None:
        return
    if not lowest >= 0.99 * float(radius):  # the poles are nearer to the center than the equator
        raise ValueError(
            f"the orbit is below the ground: it comes within {lowest:g} of the center, and the radius is "
            f"{float(radius):g}; both must have one unit of length"
        )
    if lowest > _FAR * float(radius):
        raise ValueError(
            f"the orbit is {lowest / float(radius):.3g} radii from the center: give the radius {float(radius):g} in "
            "the orbit's unit of length, such as radius=1000 * km for meters"
        )


def _lowest(orbit: Any) -> float | None:
    """The distance of the periapsis if the orbit has elements, otherwise the distance at its first time or at t = 0."""
    orbit = orbit.osculating if isinstance(orbit, SecularJ2) else orbit
    if isinstance(orbit, Kepler | KeplerFromState):
        return abs(float(orbit.semi_major_axis * (1 - orbit.eccentricity)))
    first = np.asarray(orbit.times)[0] if isinstance(orbit, Table) else 0.0
    with _checks.at_once():
        found = orbit(jnp.asarray(first))[0]
    return None if not concrete(found) else float(np.linalg.norm(np.asarray(found)))


atmosphere = Air


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    air = {"density": 0.3, "scale_height": 0.1, "height": 0.1, "radius": 0.8, "rate": 0.06}
    return {"atmosphere": partial(atmosphere, orbit=kepler(1.3, 1.2, 0.1, 0.7), **air)}
