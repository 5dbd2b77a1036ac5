"""The Earth: constants, days, its rotation, and its upper atmosphere along an orbit."""

from __future__ import annotations

import dataclasses
import datetime
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, named, not_negative, positive
from lieint_jax.dates import Epoch, epoch
from lieint_jax.types import argument, callable_pytree, pytree
from lieint_jax.types.vectors import cross, norm

EARTH_GM = 398600.4418  # the Earth's gravitational parameter in km³/s², IERS Conventions 2010
EARTH_RADIUS = 6378.137  # the equatorial radius in km, WGS 84
EARTH_J2 = 1.0826359e-3  # IERS Conventions 2010
EARTH_RATE = 7.292115e-5  # the rotation in rad/s, IERS Conventions 2010
J2000 = 2451545.0  # the Julian date of 2000 January 1, 12 h

_ORDINAL = 1721424.5  # the Julian date of day 0 of Python's count
_FAR = 100.0  # radii of the Earth: an orbit further away was given in another unit


def julian_date(year: int, month: int, day: int, hours: float = 0.0) -> float:
    """The Julian date of a day of the Gregorian calendar, as a number of days; its rounding is 4e-5 s.

    Args:
        year, month, day: the day in the Gregorian calendar, from year 1 on.
        hours: hours since midnight, such as 12 + 30/60, in the same time scale (UTC for what rotates with the Earth).

    Raises:
        ValueError: the day does not exist.

    Example:
        >>> julian_date(2000, 1, 1, 12.0)
        2451545.0
    """
    try:
        days = datetime.date(year, month, day).toordinal()
    except (TypeError, ValueError) as error:
        raise ValueError(f"year, month, day must be a day of the calendar, got {year}, {month}, {day}") from error
    return days + _ORDINAL + float(hours) / 24


def days_since_j2000(date: ArrayLike | Epoch | str, universal: bool = True) -> Any:
    """The days from J2000 to a date or to Julian dates; a float of Python, which has the digits, where it is one.

    Args:
        date: as in `li.dates.epoch`, or an array of Julian dates, which can be traced.
        universal: refuse a date that is not in UTC or UT1.
    """
    if isinstance(date, np.ndarray | np.generic | Array | list | tuple) and not isinstance(date, float):
        return jnp.asarray(date) - J2000
    found = epoch(date)  # pyright: ignore[reportArgumentType]  # which refuses what is no date
    return (found if found.scale == "UT1" or not universal else found.to("UTC")).julian_date - J2000


def earth_rotation_angle(date: ArrayLike | Epoch | str) -> Array:
    """The angle of the Earth's rotation at a date, in radians from 0 to 2π.

    Args:
        date: a date in UT1 or UTC as in `li.dates.epoch`, such as "2026-03-01 UTC", or Julian dates. UTC is within
            0.9 s of UT1, which is 7e-5 rad.

    Raises:
        ValueError: a date in another scale, such as TT.

    Source: Capitaine, Guinot & McCarthy 2000, Astron. Astrophys. 355; IERS Conventions 2010, equation 5.15.
    """
    days = days_since_j2000(date)
    turns = 0.7790572732640 + 0.00273781191135448 * days + days % 1
    return jnp.asarray(2 * jnp.pi * (turns % 1))


@pytree
class Air:
    """The air along an orbit: ρ(r) = ρ₀ exp(−(r − R − h₀)/H), which rotates with the Earth.

    | h₀, km | 300 | 350 | 400 | 450 | 500 | 600 |
    |---|---|---|---|---|---|---|
    | ρ₀, kg/m³ | 2.418e-11 | 9.518e-12 | 3.725e-12 | 1.585e-12 | 6.967e-13 | 1.454e-13 |
    | H, km | 53.628 | 53.298 | 58.515 | 60.828 | 63.822 | 71.835 |

    At a given height the density varies by a factor of ten with the activity of the Sun.

    Args:
        orbit: t ↦ (position, velocity) from the center in inertial axes, z to the pole. The torque of
            `torques.aerodynamic` has the units of this orbit: positions in meters for N m.
        density: ρ₀ > 0 at the height h₀.
        scale_height: H > 0.
        height: h₀ ≥ 0.
        radius: R in the orbit's unit of length; by default that of the Earth in km.
        rate: the rotation of the air, in radians per unit of time.

    Returns:
        t ↦ (density, velocity of the satellite relative to the air, (3,), in space).

    Raises:
        ValueError: numbers are out of range, or the orbit is below the ground or in another unit of length than the
            radius.

    Source: Vallado 2013, Fundamentals of Astrodynamics, table 8-4.
    """

    orbit: Any = argument(converter=callable_pytree)
    density: Array = argument(converter=named(positive, "density"))
    scale_height: Array = argument(converter=named(positive, "scale_height"))
    height: Array = argument(converter=named(not_negative, "height"))
    _: dataclasses.KW_ONLY
    radius: Array = argument(converter=named(positive, "radius"), default=EARTH_RADIUS)
    rate: Array = argument(converter=named(_checks.real_array, "rate", ()), default=EARTH_RATE)

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
    orbit = getattr(orbit, "osculating", orbit)
    if hasattr(orbit, "semi_major_axis"):
        return abs(float(orbit.semi_major_axis * (1 - orbit.eccentricity)))
    first = np.asarray(orbit.times)[0] if hasattr(orbit, "times") else 0.0
    with _checks.at_once():
        found = orbit(jnp.asarray(first))[0]
    return None if not concrete(found) else float(np.linalg.norm(np.asarray(found)))


atmosphere = Air
