"""The Earth: constants, days, its rotation, its magnetic dipole and its upper atmosphere along an orbit."""

from __future__ import annotations

import datetime
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, positive
from lieint_jax.types import callable_pytree, pytree
from lieint_jax.types.vectors import cross, dot, norm

EARTH_GM = 398600.4418  # the Earth's gravitational parameter in km³/s², IERS Conventions 2010
EARTH_RADIUS = 6378.137  # the equatorial radius in km, WGS 84
EARTH_J2 = 1.0826359e-3  # IERS Conventions 2010
EARTH_RATE = 7.292115e-5  # the rotation in rad/s, IERS Conventions 2010
J2000 = 2451545.0  # the Julian date of 2000 January 1, 12 h

_DIPOLE_RADIUS = 6371.2  # km, of the coefficients of IGRF
_YEARS = np.array([2000.0, 2005.0, 2010.0, 2015.0, 2020.0, 2025.0, 2030.0])
_DIPOLE = np.array(  # g₁¹, h₁¹, g₁⁰ in nT, IGRF-14 (IAGA Working Group V-MOD 2024); 2030 by its secular variation
    [
        [-1728.2, 5186.1, -29619.4],
        [-1669.05, 5077.99, -29554.63],
        [-1586.42, 4944.26, -29496.57],
        [-1501.77, 4795.99, -29441.46],
        [-1451.37, 4653.35, -29403.41],
        [-1410.3, 4545.5, -29350.0],
        [-1410.3 + 50.0, 4545.5 - 107.5, -29350.0 + 63.0],
    ]
)
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


def earth_rotation_angle(date: ArrayLike) -> Array:
    """The angle of the Earth's rotation at a Julian date (UT1), in radians from 0 to 2π.

    Source: Capitaine, Guinot & McCarthy 2000, Astron. Astrophys. 355; IERS Conventions 2010, equation 5.15.
    """
    days = jnp.asarray(date) - J2000
    turns = 0.7790572732640 + 0.00273781191135448 * days + jnp.mod(days, 1)
    return 2 * jnp.pi * jnp.mod(turns, 1)


@pytree
class EarthField:
    """The dipole of the Earth's magnetic field along an orbit: `field(t)` is b in space. Made by `earth_field`.

    Attributes:
        orbit: t ↦ (position, velocity).
        coefficients: (g₁¹, h₁¹, g₁⁰), in axes that rotate with the Earth, (3,).
        radius: the radius of the sphere of reference.
        angle: the angle of the Earth's rotation at t = 0.
        rate: its rate.
    """

    orbit: Any
    coefficients: Array
    radius: Array
    angle: Array
    rate: Array

    def __call__(self, t: ArrayLike) -> Array:
        """b = (R/r)³ (3 r̂ (r̂·G) − G), with G of the coefficients in space, (3,)."""
        r, _ = self.orbit(t)
        angle = self.angle + self.rate * t
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y, z = self.coefficients
        G = jnp.stack([c * x - s * y, s * x + c * y, z])
        square = dot(r, r)
        size = self.radius / jnp.sqrt(square)
        return size * size * size * (3 * dot(r, G) / square * r - G)


def earth_field(
    orbit: Any,
    date: float,
    coefficients: Any = None,
    radius: ArrayLike = _DIPOLE_RADIUS,
    *,
    rate: ArrayLike = EARTH_RATE,
) -> EarthField:
    """The Earth's magnetic field along an orbit, as a tilted dipole that rotates with the Earth, in tesla.

    The dipole is the first degree of IGRF-14; the higher degrees are 10 to 20 percent of the field in a low orbit. For
    all of IGRF, put the values of a package such as ppigrf into `vector_table`.

    Args:
        orbit: t ↦ (position, velocity) from the Earth's center in inertial axes, z to the pole; t in seconds.
        date: the Julian date at t = 0 (`julian_date`), in UT.
        coefficients: (g₁¹, h₁¹, g₁⁰), (3,), in the unit of the returned field; by default IGRF-14 at this date, from
            2000 to 2030, in tesla.
        radius: 6371.2 km in the orbit's unit of length.
        rate: the rate of the Earth's rotation, in radians per unit of time.

    Returns:
        A function t ↦ b in space, (3,).

    Raises:
        ValueError: the orbit is below the ground or in another unit of length than the radius, or IGRF-14 has no dipole
            for the date.

    Source: Alken et al. 2021, Earth Planets Space 73 (IGRF); IAGA Working Group V-MOD 2024, IGRF-14 coefficients.
    """
    R = positive("radius", radius)
    above_ground(orbit, R)
    G = _dipole_of(date) if coefficients is None else coefficients
    angle = _checks.real_array("date", earth_rotation_angle(date), ())
    return EarthField(
        callable_pytree(orbit),
        _checks.real_array("coefficients", G, (3,)),
        R,
        angle,
        _checks.real_array("rate", rate, ()),
    )


def _dipole_of(date: float) -> np.ndarray:
    """(g₁¹, h₁¹, g₁⁰) in tesla at a Julian date, linear between the epochs of IGRF."""
    year = _decimal_year(float(date))
    if not _YEARS[0] <= year <= _YEARS[-1]:
        raise ValueError(
            f"the built-in dipole is that of IGRF-14 from 2000 to 2030, got the Julian date {date}, year {year:.1f}; "
            "give coefficients=(g11, h11, g10), in tesla"
        )
    return 1e-9 * np.array([np.interp(year, _YEARS, column) for column in _DIPOLE.T])


def _decimal_year(date: float) -> float:
    """The year of a Julian date, 2025.0 at the beginning of January 1."""
    year = datetime.date.fromordinal(int(date - _ORDINAL)).year
    first, next_ = julian_date(year, 1, 1), julian_date(year + 1, 1, 1)
    return year + (date - first) / (next_ - first)


@pytree
class Air:
    """The air along an orbit: `air(t)` is its density and the velocity relative to it. Made by `atmosphere`.

    Attributes:
        orbit: t ↦ (position, velocity).
        density: the density at the distance `distance` from the center.
        distance: that distance.
        scale_height: the height over which the density falls to 1/e.
        rate: the angular velocity of the air about the axis z.
    """

    orbit: Any
    density: Array
    distance: Array
    scale_height: Array
    rate: Array

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """The density, (), and v − ω × r in space, (3,)."""
        r, v = self.orbit(t)
        wind = jnp.stack(cross(jnp.stack([0 * self.rate, 0 * self.rate, self.rate]), r))
        height = norm(r) - self.distance
        return self.density * jnp.exp(-height / self.scale_height), v - wind


def atmosphere(
    orbit: Any,
    density: ArrayLike,
    scale_height: ArrayLike,
    height: ArrayLike,
    *,
    radius: ArrayLike = EARTH_RADIUS,
    rate: ArrayLike = EARTH_RATE,
) -> Air:
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
    R = positive("radius", radius)
    above_ground(orbit, R)
    h0 = _checks.not_negative("height", height)
    return Air(
        callable_pytree(orbit),
        positive("density", density),
        R + h0,
        positive("scale_height", scale_height),
        _checks.real_array("rate", rate, ()),
    )


def above_ground(orbit: Any, radius: Array) -> None:
    """ValueError if an orbit is not a function, is below the ground at its start or periapsis, or has another unit."""
    _checks.function("orbit", lambda t: orbit(t)[0], "the time t, with (position, velocity)", (3,), jnp.zeros(()))
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
