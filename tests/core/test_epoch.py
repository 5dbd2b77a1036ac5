"""The date of t = 0 of a run: what carries it, and the dates of the saves against numpy's own."""

import datetime
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lieint_jax as li
from lieint_jax.dates import epoch

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
ONE = BODY.state(angular_velocity=[0.2, -0.4, 0.7])
START = "2026-03-01T12:00:00.25 TDB"
QUIET = {"progress": False}


def three(**more):
    return jax.vmap(lambda w: BODY.state(angular_velocity=w, **more))(np.eye(3) + 0.1)


def test_an_epoch_goes_wherever_the_run_goes_and_changes_no_number(tmp_path):
    run = li.run(STEP, three(), 0.5, 6, epoch=START, **QUIET)
    plain = li.run(STEP, three(), 0.5, 6, **QUIET)
    np.testing.assert_array_equal(run.state.q, plain.state.q)
    assert plain.epoch is None
    assert "epoch" not in repr(plain)
    saved = run.save(tmp_path / "a.zarr")
    opened = li.open(tmp_path / "a.zarr")
    of = li.Run.of(STEP, li.integrate(STEP, ONE, 0.5, 3), epoch=epoch(START))
    longer = run.extend(2, progress=False)
    reduced = li.run(STEP, three(), 0.5, 6, reduce="energy", epoch=START, **QUIET)
    for found in (run, run.member(1), longer, saved, opened, opened.load(), opened.member(0), of, reduced):
        assert found.epoch == epoch(START)
        assert f"{START} at t = 0" in repr(found)
    assert li.run(STEP, ONE, 0.5, 6, **QUIET).save(tmp_path / "b.zarr").epoch is None


def test_a_saved_run_has_the_unit_of_time_of_its_store(tmp_path):
    options = li.StoreOptions(tmp_path / "a.zarr", time_unit="d")
    saved = li.run(STEP, ONE, 0.5, 6, epoch=START, **QUIET).save(options)
    assert saved.facts.time_unit == li.open(options.path).facts.time_unit == "d"


@pytest.mark.parametrize(
    "given_date",
    [
        epoch("2024-03-01"),
        datetime.datetime(2024, 3, 1),
        datetime.date(2024, 3, 1),
        np.datetime64("2024-03-01"),
        SimpleNamespace(jd1=2460370.5, jd2=0.0, scale="utc"),
        "2024-061",
    ],
    ids=["Epoch", "datetime", "date", "datetime64", "Time", "text"],
)
def test_an_epoch_has_many_forms(given_date):
    assert li.Run.of(STEP, li.integrate(STEP, ONE, 0.5, 1), epoch=given_date).epoch == epoch("2024-03-01T00:00 UTC")


def test_a_store_is_resumed_with_its_own_epoch_only(tmp_path):
    store = tmp_path / "a.zarr"
    li.run(STEP, ONE, 0.5, 6, epoch="2026-03-01", store=store, **QUIET)
    again = li.run(STEP, ONE, 0.5, 6, epoch=datetime.datetime(2026, 3, 1), store=store, resume=True, **QUIET)
    assert again.epoch == epoch("2026-03-01")
    for other in (None, "2026-03-02", "2026-03-01 TT"):
        with pytest.raises(ValueError, match="epoch is '2026-03-01T00:00:00 UTC' in the store and"):
            li.run(STEP, ONE, 0.5, 6, epoch=other, store=store, resume=True, **QUIET)


def test_xarray_and_pandas_have_the_dates():
    run = li.run(STEP, ONE, 0.5, 4, epoch=START, **QUIET)
    dates = np.datetime64("2026-03-01T12:00:00.250", "ns") + np.timedelta64(500, "ms") * np.arange(5)
    date = run.to_xarray().date
    assert (date.dims, date.attrs["scale"], date.dtype) == (("time",), "TDB", "datetime64[ns]")
    np.testing.assert_array_equal(date, dates)
    np.testing.assert_array_equal(run.to_dataframe()["date"], dates)
    batch = li.run(STEP, three(), 0.5, 4, epoch=START, **QUIET)
    np.testing.assert_array_equal(batch.to_dataframe()["date"], np.repeat(dates, 3))
    own = three()._replace(t=np.array([0.0, 86400.0, -0.25]))  # members that start at different times
    frame = li.run(STEP, own, 0.5, 4, epoch=START, **QUIET).to_dataframe()
    expected = dates[:, None] + np.array([0, 86_400_000, -250]).astype("timedelta64[ms]")
    np.testing.assert_array_equal(frame["date"], expected.ravel())
    assert "date" not in li.run(STEP, ONE, 0.5, 4, **QUIET).to_dataframe()


@pytest.mark.long
def test_a_store_in_hours_has_dates_in_hours(tmp_path):
    for unit in ("h", "fortnight"):
        store = li.StoreOptions(tmp_path / f"{unit}.zarr", {}, unit)
        li.run(STEP, ONE, 0.5, 4, epoch="2026-03-01", store=store, **QUIET)
    last = li.open(tmp_path / "h.zarr").to_xarray().date[-1]
    assert last == np.datetime64("2026-03-01T02:00")
    with pytest.raises(ValueError, match="dates need the time in seconds, minutes, hours or days, got 'fortnight'"):
        li.open(tmp_path / "fortnight.zarr").to_dataframe()


@given(
    st.datetimes(datetime.datetime(1700, 1, 1), datetime.datetime(2200, 1, 1)),
    st.lists(st.integers(-(10**15), 10**15), min_size=1, max_size=5),
)
def test_dates_of_seconds_are_those_of_numpy(moment, microseconds):
    """In microseconds, of which 10¹⁵ are 32 years: a second has them exactly to a nanosecond."""
    found = epoch(moment).datetimes(np.array(microseconds) / 1e6)
    expected = np.datetime64(moment, "us") + np.array(microseconds).astype("timedelta64[us]")
    assert found.dtype == "datetime64[ns]"
    assert np.abs(found - expected.astype("datetime64[ns]")).max() <= np.timedelta64(130, "ns")  # an ulp of 10⁹ s


def test_far_dates_are_in_microseconds_and_farther_ones_refused():
    found = epoch("1500-01-01").datetimes([0.0, np.nan, 100000.25])
    assert found.dtype == "datetime64[us]"
    assert found.astype(str).tolist() == ["1500-01-01T00:00:00.000000", "NaT", "1500-01-02T03:46:40.250000"]
    with pytest.raises(ValueError, match=r"3\.17e\+05 years from 1970"):
        epoch("2000-01-01").datetimes(1e13)
