"""Epochs against Python's datetime and astropy-like times, to the digits that were given."""

import contextlib
import datetime
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lieint_jax.dates import epoch


@given(st.datetimes(datetime.datetime(1, 1, 1), datetime.datetime(9998, 1, 1)), st.sampled_from(["UTC", "TT", "GPS"]))
def test_a_date_of_datetime_is_written_and_read_again(moment, scale):
    found = epoch(f"{moment.isoformat()} {scale}")
    assert epoch(str(found)) == found
    assert datetime.datetime.fromisoformat(found.iso()) == moment
    assert found == epoch(moment, scale)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_seconds_are_added_and_subtracted_exactly(a, b):
    start = epoch("2024-02-29T24:00:00 TDB")
    assert (start + a) - start == a
    assert abs(((start + a) + b) - (start + b) - a) <= 1e-15 * abs(a)


def test_forms_of_a_date():
    noon = epoch("2024-03-01T12:00:00")
    assert noon == epoch("2024-061T12:00:00Z") == epoch("2024-3-1 12:00 UTC") == epoch(noon)
    assert noon == epoch(datetime.datetime(2024, 3, 1, 13, tzinfo=datetime.timezone(datetime.timedelta(hours=1))))
    assert epoch("2024-02-29T24:00:00") == epoch("2024-03-01")
    time = SimpleNamespace(jd1=2451545.0, jd2=0.25 + 1e-9 / 86400, scale="tdb")
    assert str(epoch(time)) == "2000-01-01T18:00:00.000000001 TDB"
    assert epoch("2000-01-01T12:00:00").julian_date == 2451545.0


def test_a_number_is_a_date_where_its_count_is_named():
    noon = epoch("2024-03-01T12:00:00")
    for number in (2460371.0, 60370.5, 1709294400, np.float64(60370.5), np.float32(1.0)):
        with pytest.raises(ValueError, match=r"alone is no date: name what it counts, epoch\(jd=…\)"):
            epoch(number)
    assert noon == epoch(jd=2460371.0) == epoch(mjd=60370.5) == epoch(unix=1709294400) == epoch(jd=np.int64(2460371))
    assert epoch(jd=2451545.0, scale="TT") == epoch("2000-01-01T12:00:00 TT")
    assert epoch(unix=-0.25) == epoch("1969-12-31T23:59:59.75")
    with pytest.raises(ValueError, match="Unix seconds are in UTC, and TT was asked for"):
        epoch(unix=0, scale="TT")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"jd": 60370.5}, r"from 1721425.5 to 5373484.5, got 60370.5; perhaps epoch\(mjd=60370.5\)"),
        ({"jd": 1709294400}, r"got 1709294400; perhaps epoch\(unix=1709294400\) was meant"),
        ({"mjd": 2460371.0}, r"a modified Julian date must be .*perhaps epoch\(jd=2460371\)"),
        ({"unix": 1709294400123}, r"a number of Unix seconds must be from -62135596800 to 253402300800"),
        ({"unix": 10**400}, "got inf"),
        ({"mjd": float("nan")}, "got nan"),
        ({"jd": "2460371"}, "jd must be a number, got '2460371'"),
        ({"jd": 2460371.0, "mjd": 60370.5}, "give exactly one of date, jd, mjd, unix; got jd and mjd"),
    ],
)
def test_a_number_out_of_range_is_refused_with_what_it_may_be(given, words):
    with pytest.raises(ValueError, match=words):
        epoch(**given)


@given(st.datetimes(datetime.datetime(1, 1, 1), datetime.datetime(6571, 1, 1)))
def test_counts_of_days_and_seconds_are_those_of_datetime(moment):
    """To the rounding of one number: 4e-5 s, 6e-6 s (of years far from 1858), 3e-5 s."""
    utc = moment.replace(tzinfo=datetime.UTC)
    right = epoch(moment)
    assert abs(epoch(jd=right.julian_date) - right) < 5e-5
    assert (
        abs(epoch(mjd=(utc - datetime.datetime(1858, 11, 17, tzinfo=datetime.UTC)) / datetime.timedelta(1)) - right)
        < 2e-5
    )
    assert abs(epoch(unix=utc.timestamp()) - right) < 3e-5


def test_a_second_60_is_a_leap_second_of_utc():
    """TAI − UTC was 10 s at the beginning of 1972, 19 s in 1980 (GPS), 32 s in 1999, 37 s since 2017: IERS."""
    found = []
    for year in range(1972, 2031):
        for month, day in ((3, 31), (6, 30), (9, 30), (12, 31)):
            with contextlib.suppress(ValueError):
                after = epoch(f"{year}-{month:02d}-{day}T23:59:60.5 UTC")
                assert after == epoch(datetime.date(year, month, day)) + 86400.5
                found.append(year)
    for year, count in ((1980, 19), (1999, 32), (2017, 37), (2031, 37)):
        assert 10 + sum(x < year for x in found) == count
    assert epoch("2017-01-01T05:29:60+05:30") == epoch("2017-01-01")
    for text in ("2024-03-01T12:30:60", "2016-12-31T12:00:60", "2016-12-30T23:59:60", "2016-12-31T23:59:60 TAI",
                 "2017-01-01T23:59:60+00:01", "0001-01-01T01:59:60+02:00"):  # fmt: skip
        with pytest.raises(ValueError, match="a second 60 is a leap second of UTC"):
            epoch(text)


@given(st.datetimes(datetime.datetime(1, 1, 2), datetime.datetime(9998, 1, 1)), st.integers(-1439, 1439))
def test_an_offset_is_that_of_datetime(moment, minutes):
    zone = datetime.timezone(datetime.timedelta(minutes=minutes))
    text = moment.replace(tzinfo=zone).isoformat()
    assert epoch(text) == epoch(moment) + -60.0 * minutes == epoch(moment.replace(tzinfo=zone))
    assert epoch(text[:-3] + text[-2:]) == epoch(text)


def test_offsets_that_say_nothing_are_refused():
    assert epoch("2024-03-01T12:00-05") == epoch("2024-03-01T17:00 UTC") == epoch("2024-03-01T12:00:00-05:00 UTC")
    for text, words in {
        "2024-03-01T12:00+02:00 TT": "has an offset from UTC, and is in TT",
        "2024-03-01T12:00+25:00": "hours to 23, minutes to 59",
        "2024-03-01+02:00": "a date must be as in",
    }.items():
        with pytest.raises(ValueError, match=words):
            epoch(text)
    with pytest.raises(ValueError, match="is in UTC, and TT was asked for"):
        epoch("2024-03-01T12:00+02:00", "TT")


@given(st.integers(0, 10**17), st.sampled_from(["D", "h", "m", "s", "ms", "us", "ns", "ps", "fs", "as"]))
def test_dates_of_numpy_are_exact(count, unit):
    """Within 1600 years of 1970, as numpy prints them: the fraction of the second in decimal digits."""
    most = {"D": 6 * 10**5, "h": 10**7, "m": 8 * 10**8, "s": 5 * 10**10, "ms": 5 * 10**13}.get(unit, 10**16)
    count = count % (2 * most) - most
    date = np.datetime64(count, unit)
    digits = {"ms": 3, "us": 6, "ns": 9, "ps": 12, "fs": 15, "as": 18}.get(unit, 0)
    assert epoch(date, "TAI") == epoch(str(date).replace("T", " ") + ":00" * (unit == "h") + " TAI")
    assert epoch(date).second % 1 == Fraction(count % 10**digits, 10**digits)


def test_days_and_months_of_numpy_and_what_is_no_date():
    assert epoch(datetime.date(2024, 3, 1), "TT") == epoch("2024-03-01 TT")
    assert epoch(np.datetime64("2024-03")) == epoch(np.datetime64("2024-03-01T00:00", "25s")) == epoch("2024-03-01")
    assert epoch(np.datetime64("2024-02-29", "W")) == epoch("2024-02-29")
    for wrong, words in (
        (np.datetime64("NaT", "s"), "got NaT of numpy"),
        (np.datetime64(10**15, "D"), "a year from 1 to 9999"),
        (True, "a date must be a text"),
        (b"2024-03-01", "a date must be a text"),
    ):
        with pytest.raises(ValueError, match=words):
            epoch(wrong)


def test_every_epoch_can_be_printed():
    last = epoch("9999-12-31T23:59:59")
    assert str(last) == "9999-12-31T23:59:59 UTC"
    for late in (lambda: last + 1.0, lambda: epoch("9999-12-31T24:00"), lambda: epoch("0001-01-01T00:30+01:00")):
        with pytest.raises(ValueError, match="a date must have a year from 1 to 9999"):
            late()


def test_scales_without_leap_seconds_are_converted():
    start = epoch("2024-03-01T00:00:00 TAI")
    assert str(start.to("TT")) == "2024-03-01T00:00:32.184 TT"
    assert str(start.to("GPS")) == "2024-02-29T23:59:41 GPS"
    assert start.to("TDB").to("TAI") == start
    assert start - start.to("GPS") == 0
    assert start.to("TT").second == Fraction(32184, 1000)
