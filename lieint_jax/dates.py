"""Dates: the epoch that is the zero of time of a run, an orbit or a file.

    >>> start = epoch("2024-03-01T12:00:00.5 TDB")
    >>> print(start + 86400.0)
    2024-03-02T12:00:00.5 TDB
    >>> epoch("2024-03-02 12:00 TDB") - start
    86399.5

Days of UTC and UT1 have 86 400 seconds here: no leap second is counted, so a difference of two dates in UTC is wrong by
the leap seconds between them (none since 2017), and 23:59:60 is the midnight that follows. Between TT, TAI, GPS and TDB
dates are converted, TDB to 2 ms; for exact conversions from UTC give an astropy `Time` in the scale you need, such as
`Time("2024-03-01").tdb`.
"""

from __future__ import annotations

import calendar
import dataclasses
import datetime
import math
import numbers
import re
from fractions import Fraction
from typing import Any, Protocol, SupportsFloat, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks

__all__ = ["SCALES", "Epoch", "epoch"]
__dir__ = __all__.copy

SCALES = ("UTC", "UT1", "TAI", "TT", "TDB", "GPS")
_AFTER_TAI = {"TAI": Fraction(0), "TT": Fraction(32184, 1000), "TDB": Fraction(32184, 1000), "GPS": Fraction(-19)}
_DAY, _UNIX = 86400, 719163  # seconds; the day 1970-01-01
_JULIAN = Fraction(3442849, 2)  # 1721424.5, the Julian date of day 0 of Python's count
_LAST = datetime.date.max.toordinal()
_LEAP_SECONDS = """
1972-06 1972-12 1973-12 1974-12 1975-12 1976-12 1977-12 1978-12 1979-12 1981-06 1982-06 1983-06 1985-06 1987-12 1989-12
1990-12 1992-06 1993-06 1994-06 1995-12 1997-06 1998-12 2005-12 2008-12 2012-06 2015-06 2016-12
"""  # the months of UTC that ended in 23:59:60, IERS Bulletins C to 71
_ISO = re.compile(
    r"(\d{4})-(?:(\d{3})|(\d{1,2})-(\d{1,2}))"  # a day of the year, or a month and a day
    r"(?:[T ](\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?(?:([+-])(\d{2})(?::?(\d{2}))?)?)?"  # a time, its offset from UTC
    r"\s*(Z|[A-Za-z][A-Za-z0-9]*)?",
    re.ASCII,
)
# of numbers of days or seconds, the day 0 of Python's count, in days, and the length of the unit in days
_COUNTS = {"jd": (-_JULIAN, Fraction(1)), "mjd": (Fraction(678576), Fraction(1))}
_COUNTS |= {"unix": (Fraction(_UNIX), Fraction(1, _DAY))}
_SPANS = {  # of the years 1 to 9999; an MJD beyond would be a Julian date, whose years begin there
    "jd": (float(1 + _JULIAN), float(_LAST + 1 + _JULIAN)),
    "mjd": (-678575.0, float(1 + _JULIAN)),
    "unix": (-62135596800.0, 253402300800.0),
}


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

    def __post_init__(self) -> None:
        if not 1 <= self.day <= _LAST:
            raise ValueError(f"a date must have a year from 1 to 9999, got the day {self.day} of the calendar")

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
        t = _checks.host_array("seconds", seconds, np.float64)
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


DateLike = str | datetime.date | np.datetime64 | Epoch | _AstropyTime


def epoch(
    date: DateLike | None = None,
    scale: str | None = None,
    *,
    jd: float | None = None,
    mjd: float | None = None,
    unix: float | None = None,
) -> Epoch:
    """The epoch of a date, or of a number of days or seconds whose count is named.

    Args:
        date: ISO 8601 with a scale, such as "2024-03-01T12:00:00 TDB", with an offset from UTC, "…T12:00:00+02:00", or
            with a day of the year as in CCSDS, "2024-061T12:00:00"; without a scale, or with Z, it is UTC. Or an
            astropy `Time`, a `datetime` (UTC if it has no zone), a `date` (0 h), a `numpy.datetime64`, or an `Epoch`,
            which is returned.
        scale: the scale of a date that has none; by default UTC.
        jd: a Julian date in place of `date`. In one number its rounding is 4e-5 s: a text keeps all digits.
        mjd: a modified Julian date in place of `date`, that is jd − 2400000.5; its rounding is 6e-7 s.
        unix: seconds since 1970 without leap seconds, in UTC, in place of `date`.

    Raises:
        ValueError: no date, a day or a leap second that does not exist, an unknown scale, or two different ones; a
            number without the name of its count, or one beyond the years 1 to 9999 (mjd: 1 to 6572).

    Example:
        >>> print(epoch(jd=2451545.0, scale="TT"), epoch(mjd=60370.5), epoch(unix=1709294400))
        2000-01-01T12:00:00 TT 2024-03-01T12:00:00 UTC 2024-03-01T12:00:00 UTC
    """
    name, given = _checks.one_of(date=date, jd=jd, mjd=mjd, unix=unix)
    if name != "date":
        return _from_count(name, given, scale)
    if isinstance(given, Epoch):
        return given
    if isinstance(given, _AstropyTime):  # two numbers of days, to keep its digits
        days = Fraction(float(given.jd1)) + Fraction(float(given.jd2)) - _JULIAN
        day = math.floor(days)
        return Epoch(day, Fraction(round((days - day) * _DAY * 10**12), 10**12), _scale(str(given.scale)))
    if isinstance(given, datetime.datetime):
        zone = "Z" if given.tzinfo else ""
        utc = given.astimezone(datetime.UTC) if zone else given
        return _from_text(utc.replace(tzinfo=None).isoformat() + zone, scale)
    if isinstance(given, datetime.date):
        return _from_text(given.isoformat(), scale)
    if isinstance(given, np.datetime64):
        return _from_numpy(given, scale)
    if isinstance(given, str):
        return _from_text(given, scale)
    if isinstance(given, numbers.Real) and not isinstance(given, bool):
        raise ValueError(
            f"the number {given} alone is no date: name what it counts, epoch(jd=…) for Julian dates, epoch(mjd=…) for "
            "modified ones, epoch(unix=…) for seconds since 1970"
        )
    _checks.plain("date", given)
    raise ValueError(f"a date must be a text such as '2024-03-01T12:00:00 TDB', a datetime or a Time, got {given!r}")


_UNITS_OF_NUMPY = {"W": Fraction(7 * _DAY), "D": Fraction(_DAY), "h": Fraction(3600), "m": Fraction(60)}
_UNITS_OF_NUMPY |= {unit: Fraction(1, 1000**k) for k, unit in enumerate(("s", "ms", "us", "ns", "ps", "fs", "as"))}


def are_julian_dates(numbers: Any) -> Any:
    """Whether numbers may be Julian dates, element by element: NaN, modified ones and Unix seconds are none."""
    first, end = _SPANS["jd"]
    return (numbers >= first) & (numbers < end)


def julian_dates(given: ArrayLike) -> np.ndarray:
    """Numbers as Julian dates, in double precision; ValueError if one of them is none."""
    given = _checks.plain("date", given)
    try:
        found = np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Julian dates must be numbers, got {given!r}") from error
    wrong = found[~are_julian_dates(found)]
    if wrong.size:
        raise ValueError(_not_in_span("jd", float(wrong[0])))
    return found


def _not_in_span(name: str, given: Any) -> str:
    value = math.inf if abs(given) > 1e300 else float(given)  # an integer may be larger than any float
    first, end = _SPANS[name]
    what = {"jd": "a Julian date", "mjd": "a modified Julian date", "unix": "a number of Unix seconds"}[name]
    fits = [f"epoch({x}={value:.16g})" for x, (low, high) in _SPANS.items() if low <= value < high]
    hint = f"; perhaps {' or '.join(fits)} was meant" if fits else ""
    return f"{what} must be from {first:.16g} to {end:.16g}, got {value:.16g}{hint}"


def _from_count(name: str, value: Any, scale: str | None) -> Epoch:
    """The epoch of a number of days or seconds."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise ValueError(f"{name} must be a number, got {value!r}")
    if name == "unix" and _scale(scale or "UTC") != "UTC":
        raise ValueError(f"Unix seconds are in UTC, and {scale} was asked for")
    exact = Fraction(int(value)) if isinstance(value, numbers.Integral) else float(value)
    low, high = _SPANS[name]
    if not low <= exact < high:  # nor NaN
        raise ValueError(_not_in_span(name, exact))
    start, unit = _COUNTS[name]
    days = start + Fraction(exact) * unit
    day = math.floor(days)
    return Epoch(day, (days - day) * _DAY, _scale(scale or "UTC"))


def _from_numpy(date: np.datetime64, scale: str | None) -> Epoch:
    """The epoch of a date of numpy, exact in its unit."""
    if np.isnat(date):
        raise ValueError("a date must be known, got NaT of numpy")
    if np.datetime_data(date.dtype)[0] in "YM":  # which have no fixed length
        date = date.astype("datetime64[D]")
    unit, count = np.datetime_data(date.dtype)
    days, second = divmod(int(date.astype(np.int64)) * count * _UNITS_OF_NUMPY[unit], _DAY)
    return Epoch(int(days) + _UNIX, second, _scale(scale or "UTC"))


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
    year, day_of_year, month, day, hour, minute, second, sign, off_hours, off_minutes, written = found.groups()
    named = "UTC" if sign or written in ("Z", "z") else None
    if written and written not in ("Z", "z"):
        if sign and _scale(written) != "UTC":
            raise ValueError(f"the date {date[:100]!r} has an offset from UTC, and is in {written}")
        named = _scale(written)
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
    offset = int(off_hours or 0) * 3600 + int(off_minutes or 0) * 60
    if int(off_hours or 0) > 23 or int(off_minutes or 0) > 59:
        raise ValueError(f"the date {date[:100]!r} has no offset from UTC: hours to 23, minutes to 59")
    start = Epoch(first, Fraction(0), named or _scale(scale or "UTC"))
    found = start._later(total + (offset if sign == "-" else -offset))
    if seconds >= 60 and not _follows_leap_second(found):
        raise ValueError(
            f"the date {date[:100]!r} does not exist: a second 60 is a leap second of UTC, 23:59:60 at the end of 27 "
            "days from 1972-06-30 to 2016-12-31"
        )
    return found


def _follows_leap_second(date: Epoch) -> bool:
    """Whether a date is in the first second after the midnight at which a leap second ends."""
    day = datetime.date.fromordinal(date.day)
    if date.scale != "UTC" or date.second >= 1 or day.day != 1 or day.year < 1972:
        return False
    return f"{day - datetime.timedelta(1):%Y-%m}" in _LEAP_SECONDS.split()


def _scale(scale: str) -> str:
    if scale.upper() not in SCALES:
        raise ValueError(f"the scale of a date must be one of {', '.join(SCALES)}, got {scale[:100]!r}")
    return scale.upper()
