"""Dates: the epoch that is the zero of time of a run, an orbit or a file.

    >>> start = epoch("2024-03-01T12:00:00.5 TDB")
    >>> print(start + 86400.0)
    2024-03-02T12:00:00.5 TDB
    >>> epoch("2024-03-02 12:00 TDB") - start
    86399.5

Days of UTC and UT1 have 86 400 seconds here: no leap second is counted, so a difference of two dates in UTC is wrong by
the leap seconds between them (none since 2017). Between TT, TAI, GPS and TDB dates are converted, TDB to 2 ms; for
exact conversions from UTC give an astropy `Time` in the scale that is needed, such as `Time("2024-03-01").tdb`.
"""

from __future__ import annotations

import calendar
import dataclasses
import datetime
import math
import re
from fractions import Fraction
from typing import Protocol, SupportsFloat, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax._checks import host_array

__all__ = ["SCALES", "Epoch", "epoch"]

SCALES = ("UTC", "UT1", "TAI", "TT", "TDB", "GPS")
_AFTER_TAI = {"TAI": Fraction(0), "TT": Fraction(32184, 1000), "TDB": Fraction(32184, 1000), "GPS": Fraction(-19)}
_DAY, _UNIX = 86400, 719163  # seconds; the day 1970-01-01
_JULIAN = Fraction(3442849, 2)  # 1721424.5, the Julian date of day 0 of Python's count
_ISO = re.compile(
    r"(\d{4})-(?:(\d{3})|(\d{1,2})-(\d{1,2}))"  # a day of the year, or a month and a day
    r"(?:[T ](\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?)?"
    r"\s*(Z|[A-Za-z][A-Za-z0-9]*)?"
)


@dataclasses.dataclass(frozen=True, order=False)
class Epoch:
    """A date of a time scale: a day and the second of the day, exact to the digits that were given. See `epoch`.

    Attributes:
        day: the day, as `datetime.date.toordinal` counts.
        second: seconds since midnight, 0 ≤ second < 86 400.
        scale: one of `SCALES`.
    """

    day: int
    second: Fraction
    scale: str

    @property
    def julian_date(self) -> float:
        """The Julian date in the epoch's own scale, rounded to 4e-5 s."""
        return float(self.day + _JULIAN + self.second / _DAY)

    def to(self, scale: str) -> Epoch:
        """The same instant in another scale of TAI, TT, TDB and GPS; TDB is taken as TT, which is right to 2 ms.

        Raises:
            ValueError: one of the scales is UTC or UT1 and the other is not: that needs leap seconds.
        """
        scale = _scale(scale)
        if scale == self.scale:
            return self
        if not {scale, self.scale} <= set(_AFTER_TAI):
            raise ValueError(
                f"{self.scale} to {scale} needs the table of leap seconds: give the date in {scale}, such as "
                f"astropy's Time(…).{scale.lower()}"
            )
        return dataclasses.replace(self._later(_AFTER_TAI[scale] - _AFTER_TAI[self.scale]), scale=scale)

    def __add__(self, seconds: float) -> Epoch:
        """The epoch so many seconds later; ValueError if they are not finite."""
        if not math.isfinite(seconds):
            raise ValueError(f"the seconds that are added to a date must be finite, got {seconds}")
        return self._later(Fraction(float(seconds)))

    def _later(self, seconds: Fraction) -> Epoch:
        days, second = divmod(self.second + seconds, _DAY)
        return Epoch(self.day + int(days), second, self.scale)

    def __sub__(self, other: Epoch) -> float:
        """The seconds from another epoch to this one; ValueError as in `to`."""
        other = other.to(self.scale)
        return float((self.day - other.day) * _DAY + self.second - other.second)

    def iso(self, digits: int = 9) -> str:
        """The date as 2024-03-01T12:00:00.5, rounded to so many digits of the second, without the scale."""
        if not 1 <= self.day < datetime.date.max.toordinal():
            raise ValueError(f"a date with a year below 1 or above 9999 cannot be written; its day is {self.day}")
        unit = Fraction(1, 10**digits)
        ticks = round(self.second / unit)
        rounded = Epoch(self.day, Fraction(0), self.scale)._later(ticks * unit)
        minutes, second = divmod(rounded.second, 60)
        hour, minute = divmod(int(minutes), 60)
        whole = int(second)
        part = f"{int((second - whole) / unit):0{digits}d}".rstrip("0") if digits else ""
        day = datetime.date.fromordinal(rounded.day).isoformat()
        return f"{day}T{hour:02d}:{minute:02d}:{whole:02d}{'.' if part else ''}{part}"

    def datetimes(self, seconds: ArrayLike) -> np.ndarray:
        """The dates so many seconds later as `numpy.datetime64`.

        They are in nanoseconds if all are from 1678 to 2262, otherwise in microseconds; NaN is no date, NaT.

        Raises:
            ValueError: a date that is further than 290 000 years away.
        """
        t = host_array("seconds", seconds, np.float64)
        start = (self.day - _UNIX) * _DAY + self.second
        whole = np.floor(t)
        far = np.nanmax(np.abs(whole), initial=0.0) + abs(float(start))
        if far > 9.2e12:
            raise ValueError(f"{far / 3.15576e7:.3g} years from 1970 are too far for a date of numpy")
        unit, ticks = ("ns", 10**9) if far < 9.2e9 else ("us", 10**6)
        known = np.isfinite(t)
        later = np.where(known, whole, 0).astype(np.int64) * ticks
        rest = np.rint((np.where(known, t, 0) - np.where(known, whole, 0)) * ticks + float(start % 1 * ticks))
        dates = (later + rest.astype(np.int64) + math.floor(start) * ticks).astype(f"datetime64[{unit}]")
        return np.where(known, dates, np.datetime64("NaT", unit))

    def __str__(self) -> str:
        return f"{self.iso()} {self.scale}"


@runtime_checkable
class _AstropyTime(Protocol):
    @property
    def jd1(self) -> SupportsFloat: ...
    @property
    def jd2(self) -> SupportsFloat: ...
    @property
    def scale(self) -> str: ...


DateLike = str | float | datetime.datetime | Epoch | _AstropyTime


def epoch(date: DateLike, scale: str | None = None) -> Epoch:
    """The epoch of a date.

    Args:
        date: ISO 8601 with a scale, such as "2024-03-01T12:00:00 TDB"; a day of the year as in CCSDS,
            "2024-061T12:00:00"; without a scale, or with Z, it is UTC. Or an astropy `Time`, a `datetime` (UTC if it
            has no zone), a Julian date as a number, or an `Epoch`, which is returned.
        scale: the scale of a date that has none; by default UTC.

    Raises:
        ValueError: no date, a day that does not exist, an unknown scale, or two different ones.

    Example:
        >>> print(epoch(2451545.0, "TT"))
        2000-01-01T12:00:00 TT
    """
    if isinstance(date, Epoch):
        return date
    if isinstance(date, _AstropyTime):  # two numbers of days, to keep its digits
        days = Fraction(float(date.jd1)) + Fraction(float(date.jd2)) - _JULIAN
        day = math.floor(days)
        return Epoch(day, Fraction(round((days - day) * _DAY * 10**12), 10**12), _scale(str(date.scale)))
    if isinstance(date, datetime.datetime):
        zone = "Z" if date.tzinfo else ""
        utc = date.astimezone(datetime.UTC) if zone else date
        return _from_text(utc.replace(tzinfo=None).isoformat() + zone, scale)
    if isinstance(date, str):
        return _from_text(date, scale)
    if isinstance(date, bool) or not isinstance(date, int | float) or not math.isfinite(date):
        raise ValueError(f"a date must be a text such as '2024-03-01T12:00:00 TDB' or a Julian date, got {date!r}")
    days = Fraction(float(date)) - _JULIAN
    return Epoch(math.floor(days), (days - math.floor(days)) * _DAY, _scale(scale or "UTC"))


def text_of(date: DateLike | None) -> str:
    """The text of a date, to a picosecond; "" of None."""
    if date is None:
        return ""
    found = epoch(date)
    return f"{found.iso(12)} {found.scale}"


def _from_text(date: str, scale: str | None) -> Epoch:
    found = _ISO.fullmatch(date.strip())
    if found is None:
        raise ValueError(f"a date must be as in '2024-03-01T12:00:00.5 TDB', got {date[:100]!r}")
    year, day_of_year, month, day, hour, minute, second, written = found.groups()
    named = None if written is None else "UTC" if written in ("Z", "z") else _scale(written)
    if named and scale and named != _scale(scale):
        raise ValueError(f"the date {date[:100]!r} is in {named}, and {scale} was asked for")
    try:
        first = datetime.date(int(year), int(month or 1), int(day or 1)).toordinal()
    except ValueError as error:
        raise ValueError(f"the date {date[:100]!r} does not exist: {error}") from error
    if day_of_year:
        if not 1 <= int(day_of_year) <= 365 + calendar.isleap(int(year)):
            raise ValueError(f"the date {date[:100]!r} does not exist: {year} has no day {day_of_year}")
        first += int(day_of_year) - 1
    seconds = Fraction(second or 0)
    if int(hour or 0) > 24 or int(minute or 0) > 59 or seconds >= 61:
        raise ValueError(f"the date {date[:100]!r} has no time of a day: hours to 24, minutes to 59, seconds to 60")
    total = int(hour or 0) * 3600 + int(minute or 0) * 60 + seconds
    if int(hour or 0) == 24 and total > _DAY:
        raise ValueError(f"the date {date[:100]!r} has no time of a day: it ends at 24:00:00")
    return Epoch(first, Fraction(0), named or _scale(scale or "UTC"))._later(total)


def _scale(scale: str) -> str:
    if scale.upper() not in SCALES:
        raise ValueError(f"the scale of a date must be one of {', '.join(SCALES)}, got {scale[:100]!r}")
    return scale.upper()
