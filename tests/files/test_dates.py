"""Epochs against Python's datetime and astropy-like times, to the digits that were given."""

import datetime
from fractions import Fraction
from types import SimpleNamespace

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
    start = epoch("2024-02-29T23:59:60 TDB")
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


def test_scales_without_leap_seconds_are_converted():
    start = epoch("2024-03-01T00:00:00 TAI")
    assert str(start.to("TT")) == "2024-03-01T00:00:32.184 TT"
    assert str(start.to("GPS")) == "2024-02-29T23:59:41 GPS"
    assert start.to("TDB").to("TAI") == start
    assert start - start.to("GPS") == 0
    assert start.to("TT").second == Fraction(32184, 1000)
