"""The Earth: constants, days, and its rotation."""

from __future__ import annotations

import datetime
import math
import re
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls
from lieint_jax.dates import Epoch, are_julian_dates, epoch, julian_dates

__all__ = ["EARTH_GM", "EARTH_J2", "EARTH_RADIUS", "EARTH_RATE", "J2000", "earth_rotation_angle", "julian_date"]

EARTH_GM = 398600.4418  # the Earth's gravitational parameter in km³/s², IERS Conventions 2010
EARTH_RADIUS = 6378.137  # the equatorial radius in km, WGS 84
EARTH_J2 = 1.0826359e-3  # IERS Conventions 2010
EARTH_RATE = 7.292115e-5  # the rotation in rad/s, IERS Conventions 2010
J2000 = 2451545.0  # the Julian date of 2000 January 1, 12 h

_SIDEREAL_RATE = 7.2921158553e-5  # rad/s, of mean sidereal time in 2000
_OF_DATE = re.compile(r"(TEME|TOD|MOD)(?![A-Z])|TEMEOF(DATE|EPOCH)|(TRUE|MEAN) .*EQUINOX OF DATE")  # with the equinox
_OTHER_POLE = re.compile(r"ECLIP|GALACTIC|B1950|FK4|NODE|MCI|MOON|(MOE|TOE)(?![A-Z])")  # or an epoch that is not named
_ORDINAL = 1721424.5  # the Julian date of day 0 of Python's count


def julian_date(year: int, month: int, day: int, hours: float = 0.0) -> float:
    """The Julian date of a day of the Gregorian calendar, as a number of days; its rounding is 4e-5 s.

    Args:
        year, month, day: the day in the Gregorian calendar, from year 1 on.
        hours: hours since midnight, such as 12 + 30/60, in the same time scale (UTC for what rotates with the Earth).

    Raises:
        ValueError: the day does not exist, or the hours are not finite.

    Example:
        >>> julian_date(2000, 1, 1, 12.0)
        2451545.0
    """
    try:
        days = datetime.date(year, month, day).toordinal()
    except (TypeError, ValueError) as error:
        raise ValueError(f"year, month, day must be a day of the calendar, got {year}, {month}, {day}") from error
    if not math.isfinite(_checks.plain("hours", hours)):
        raise ValueError(f"hours must be a finite number, got {hours}")
    return days + _ORDINAL + float(hours) / 24


def days_since_j2000(date: ArrayLike | Epoch | str, universal: bool = True) -> Any:
    """The days from J2000 to a date or to Julian dates, with the digits of float64 where it is not traced.

    Args:
        date: as in `li.dates.epoch`, or Julian dates, which can be traced: one that is not from year 1 to 9999 is then
            NaN.
        universal: refuse a date that is not in UTC or UT1.

    Raises:
        ValueError: no date, or a number that is no Julian date, such as a modified one.
    """
    if not _checks.concrete(date):
        return jnp.where(are_julian_dates(date), jnp.asarray(date) - J2000, jnp.nan)
    if isinstance(date, int | float | np.number | np.ndarray | Array | list | tuple) and not isinstance(date, bool):
        days = julian_dates(date) - J2000
        return days if days.ndim else days.item()
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


def mean_sidereal_time(date: ArrayLike | Epoch | str) -> Array:
    """Greenwich mean sidereal time at a date in UT1 or UTC, in radians from 0 to 2π: the rotation of the Earth in TEME.

    Source: Aoki et al. 1982, Astron. Astrophys. 105 (IAU 1982); Vallado et al. 2006, AIAA 2006-6753, appendix C.
    """
    days = days_since_j2000(date)
    T = days / 36525
    seconds = 67310.54841 + (8640184.812866 + (0.093104 - 6.2e-6 * T) * T) * T  # and a turn each day
    turns = days % 1 + seconds / 86400
    return jnp.asarray(2 * jnp.pi * (turns % 1))


def equatorial(orbit: Any, frame: str | None = None) -> Any:
    """The orbit; ValueError if its axes, or those of the name `frame`, rotate or have another z than the pole."""
    name = axes_of(orbit, frame)
    if _checks.rotates(name) or _OTHER_POLE.search(name):
        what = "an orbit must be in inertial axes with z to the Earth's pole, such as GCRF, EME2000, TOD or TEME"
        raise ValueError(f"{what}, got {_checks.printable(getattr(orbit, 'frame', '') if frame is None else frame)}")
    return orbit


def axes_of(orbit: Any, frame: str | None) -> str:
    """The name of the axes of an orbit in capitals, or the one that is given; "" if it is not known."""
    found = getattr(orbit, "frame", "") if frame is None else frame
    return found.strip().upper() if isinstance(found, str) else ""


def rotation_of_earth(orbit: Any, date: ArrayLike | Epoch | str, frame: str | None) -> tuple[Array, float]:
    """The angle of the Earth's rotation at a date and its rate in rad/s, in the axes of an orbit around the Earth.

    Args:
        orbit: of which attributes `frame` and `center` name the axes and the center, if it has them.
        date: as in `earth_rotation_angle`.
        frame: the axes, in place of the orbit's.

    Raises:
        ValueError: axes that rotate or whose z is not the Earth's pole, another center, or a date in another scale.
    """
    center = getattr(orbit, "center", "")
    if center and ("EARTH" not in center.upper() or "BARY" in center.upper()):
        raise ValueError(f"orbit must be about the Earth's center, got one about {_checks.printable(center)}")
    if _OF_DATE.match(axes_of(equatorial(orbit, frame), frame)):
        return mean_sidereal_time(date), _SIDEREAL_RATE
    return earth_rotation_angle(date), EARTH_RATE
