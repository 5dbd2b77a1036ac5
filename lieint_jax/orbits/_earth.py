"""The Earth: constants, days, and its rotation."""

from __future__ import annotations

import datetime
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import plain
from lieint_jax.dates import Epoch, epoch
from lieint_jax.types.shapes import Calls

__all__ = ["EARTH_GM", "EARTH_J2", "EARTH_RADIUS", "EARTH_RATE", "J2000", "earth_rotation_angle", "julian_date"]

EARTH_GM = 398600.4418  # the Earth's gravitational parameter in km³/s², IERS Conventions 2010
EARTH_RADIUS = 6378.137  # the equatorial radius in km, WGS 84
EARTH_J2 = 1.0826359e-3  # IERS Conventions 2010
EARTH_RATE = 7.292115e-5  # the rotation in rad/s, IERS Conventions 2010
J2000 = 2451545.0  # the Julian date of 2000 January 1, 12 h

_ORDINAL = 1721424.5  # the Julian date of day 0 of Python's count


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
    return days + _ORDINAL + float(plain("hours", hours)) / 24


def days_since_j2000(date: ArrayLike | Epoch | str, universal: bool = True) -> Any:
    """The days from J2000 to a date or to Julian dates; a float of Python, which has the digits, where it is one.

    Args:
        date: as in `li.dates.epoch`, or an array of Julian dates, which can be traced.
        universal: refuse a date that is not in UTC or UT1.
    """
    date = plain("date", date)
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


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {
        "earth_rotation_angle": partial(earth_rotation_angle, date=jnp.array(2451545.3)),
        "julian_date": partial(julian_date, year=2000, month=1, day=2, hours=3.5),
    }
