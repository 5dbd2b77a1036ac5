"""Logs as CSV: what is written is read to the last bit, and each of many spoiled files has a decided result."""

import contextlib
import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lieint_jax as li
from lieint_jax.files import read_csv_log, write_csv

RATES, Q = ["x", "y", "z"], ["w", "i", "j", "k"]
GYRO = "t,x,y,z\n0.0,0.1,0.2,0.3\n0.5,0.4,0.5,0.6\n1.0,0.7,0.8,0.9\n"
STARS = "t,w,i,j,k\n0,1,0,0,0\n1,0.8,0.6,0,0\n2,0.6,0.8,0,0\n"
READ = dict(time="t", rates=RATES)
BY_INDEX = dict(time=0, rates=[1, 2, 3])
STARRED = dict(time="t", attitudes=Q)
SINGLE = [0.0, 0.5, 1.0]


def written(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


SAME = {  # the same log in another dress: text, and arguments that differ from READ
    "as it is": (GYRO, {}),
    "byte order mark": ("\ufeff" + GYRO, {}),
    "UTF-16": (GYRO.encode("utf-16"), {}),
    "CRLF": (GYRO.replace("\n", "\r\n"), {}),
    "CR": (GYRO.replace("\n", "\r"), {}),
    "no line end at the end": (GYRO.rstrip(), {}),
    "empty lines": (GYRO.replace("\n", "\n\n \n"), {}),
    "semicolons": (GYRO.replace(",", ";"), {}),
    "tabs": (GYRO.replace(",", "\t"), {}),
    "white space": (GYRO.replace(",", "  "), {}),
    "bars": (GYRO.replace(",", "|"), dict(delimiter="|")),
    "a hint for Excel": ("sep=|\n" + GYRO.replace(",", "|"), {}),
    "spaces about commas": (GYRO.replace(",", " , "), {}),
    "quotes": (GYRO.replace("0.4", '"0.4"').replace("t,x", '"t","x"'), {}),
    "comments": ('# "made" by a gyro of 5"\n' + GYRO.replace("\n0.5", "\n# a remark, with commas\n0.5"), {}),
    "header of numpy": ("# made\n# " + GYRO, {}),
    "commas at the ends of rows": (GYRO.replace("\n", ",\n"), {}),
    "commas at the ends of rows only": (GYRO.replace("\n", ",,\n").replace("z,,", "z"), {}),
    "by index, with names": (GYRO, BY_INDEX),
    "by index, without names": (GYRO.partition("\n")[2], BY_INDEX),
    "a name and indices": (GYRO, dict(time="t", rates=[1, 2, 3])),
    "columns in another order": ("z,y,t,x\n.3,.2,0,.1\n.6,.5,.5,.4\n.9,.8,1,.7\n", {}),
    "columns of text": (GYRO.replace("\n", ",text with words\n"), {}),
    "names that are numbers": (GYRO.replace("x,y,z", "0,1,2"), dict(rates=["0", "1", "2"])),
    "exponents": (GYRO.replace("0.1,", "1e-1,").replace("0.2,", "2D-1,").replace("0.3\n", "+3.E-01\n"), {}),
    "milliseconds": (GYRO.replace("\n0.5", "\n500").replace("\n1.0", "\n1000"), dict(units={"time": "ms"})),
    "microseconds": (GYRO.replace("\n0.5", "\n500000").replace("\n1.0", "\n1e6"), dict(units={"time": "us"})),
    "dates": (GYRO.replace("\n0.0", "\n2024-03-01T12:00:00Z").replace("\n0.5", "\n2024-03-01T12:00:00.5Z")
              .replace("\n1.0", "\n2024-03-01 12:00:01"), {}),
    "days of the year": (GYRO.replace("\n0.0", "\n2024-061T23:59:59.5").replace("\n0.5", "\n2024-061T24:00:00")
                         .replace("\n1.0", "\n2024-062T00:00:00.5"), {}),
    "one of two members": (GYRO.replace("\n", ",1\n").replace("z,1", "z,member") + "0,9,9,9,2\n", dict(member=1)),
}  # fmt: skip


@pytest.mark.parametrize("name", SAME)
def test_a_log_in_another_dress_is_the_same(name, tmp_path):
    text, options = SAME[name]
    log = read_csv_log(written(tmp_path, text), **(READ | options))
    assert log.times.tolist() == SINGLE
    np.testing.assert_array_equal(log.rates, np.arange(1, 10).reshape(3, 3) / 10)
    assert log.attitudes is None
    assert (log.epoch is None) == ("da" not in name)


BAD = {  # text, arguments, and the sentence
    "no file": (None, READ, "there is no file"),
    "empty": ("", READ, r"log\.csv: there are no rows"),
    "names alone": ("t,x,y,z\n", READ, "there are no rows"),
    "comments alone": ("# t\n#\n", READ, "there are no rows"),
    "no text": (b"\xff\x00\x81\x00\x00", READ, "not UTF-8|null|no text"),
    "Latin-1": (GYRO.replace("x", "\xb0").encode("latin-1"), READ, "is not UTF-8 text"),
    "zeros": (GYRO.encode() + b"\0\0", READ, "null character"),
    "NaN": (GYRO.replace("0.5,0.6", "nan,0.6"), READ, r"line 3: rates \(y\) must be a finite number, got 'nan'"),
    "infinity": (GYRO.replace("0.5,0.6", "-inf,0.6"), READ, r"line 3: rates \(y\) must be a finite number"),
    "too large": (GYRO.replace("0.6", "1e999"), READ, r"line 3: rates \(z\) must be a finite number"),
    "an underscore": (GYRO.replace("0.6", "0_6"), READ, r"line 3: rates \(z\) must be a finite number, got '0_6'"),
    "a word": (GYRO.replace("0.6", "OFF"), READ, r"line 3: rates \(z\) must be a finite number, got 'OFF'"),
    "control characters": (GYRO.replace("0.6", "\x1b[2J"), READ, r"got '\\\\x1b\[2J'"),
    "an empty cell": (GYRO.replace("0.5,0.6", ",0.6"), READ, r"line 3: rates \(y\) is missing: the cell is empty"),
    "NaN of a time": (GYRO.replace("\n0.5", "\nNaN"), READ, "line 3: time must be a finite number"),
    "a row of units": (GYRO.replace("z\n", "z\ns,rad/s,rad/s,rad/s\n"), READ, "line 2: time must be a finite number"),
    "a short row": (GYRO.replace(",0.6", ""), READ, r"line 3: there are 3 cells for 4 columns"),
    "cut": (GYRO[:-5], READ, r"line 4: there are 3 cells for 4 columns"),
    "a long row": (GYRO.replace("0.6", "0.6,7"), READ, "line 3: there are 5 cells for 4 columns; numbers need points"),
    "decimal commas": (GYRO.replace(",", ";").replace(".", ","), READ,
        "line 2: time must have a decimal point, got '0,0'"),
    "decimal commas between commas": (GYRO.replace(".", ","), READ,
        "line 2: there are 8 cells for 4 columns; .*commas"),
    "thousands": (GYRO.replace(",", ";").replace("0.6", "1,000.5"), READ, "line 3: .* got '1,000.5'"),
    "a double time": (GYRO.replace("\n1.0", "\n0.5"), READ,
        "line 4: times must increase, got 0.5 s after 0.5 s of line 3"),
    "times that go back": (GYRO.replace("\n1.0", "\n0.2"), READ, "line 4: times must increase, got 0.2 s after 0.5 s"),
    "two members": (GYRO.replace("\n", ",1\n").replace("z,1", "z,member") + "0,9,9,9,2\n", READ, "give member="),
    "no such member": (GYRO.replace("\n", ",1\n").replace("z,1", "z,member"), READ | dict(member=3),
        "no rows of member 3"),
    "no members": (GYRO, READ | dict(member=3), "no column 'member'"),
    "a name misspelled": (GYRO.replace("x,", "gyro_x,"), READ | dict(rates=["gyrox", "y", "z"]),
        r"log\.csv: there is no column 'gyrox'; did you mean 'gyro_x'\? The columns are t, gyro_x, y, z$"),
    "another name": (GYRO, READ | dict(time="clock"), r"no column 'clock'; The columns are t, x, y, z$"),
    "a name twice": (GYRO.replace("y", "x"), READ | dict(rates=["x", 2, 3]), "there are 2 columns 'x': give the index"),
    "names without a header": (GYRO.partition("\n")[2], READ, "the columns have no names, and 't' was asked for"),
    "too large an index": (GYRO, BY_INDEX | dict(rates=[1, 2, 4]), "no column 4: there are 4, counted from 0"),
    "many columns": (",".join(f"c{k}" for k in range(10**4)) + "\n", READ, r"no column 't'.*c39, …"),
    "a quote that stays open": (GYRO.replace("0.4", '"0.4'), READ, "line 3: the cells cannot be separated"),
    "a cell of a million characters": (GYRO.replace("0.4", "4" * 10**6), READ, "line 3: the cells cannot be separated"),
    "no date": (GYRO.replace("\n0.0", "\n2024-02-30"), READ, "line 2: the date '2024-02-30' does not exist"),
    "dates, then numbers": (GYRO.replace("\n0.0", "\n2024-02-01"), READ, "line 3: a date must be as in"),
    "numbers, then dates": (GYRO.replace("\n0.5", "\n2024-02-01"), READ,
        "line 3: time must be a finite number, got '2024"),
    "dates of another scale": (GYRO.replace("\n0.0", "\n2024-02-01 TT"), READ | dict(epoch="2024-02-01"),
                               "line 2: .*needs the table of leap seconds"),
    "dates with a unit": (GYRO.replace("\n0.0", "\n2024-02-01"), READ | dict(units={"time": "ms"}),
        "which have no unit"),
    "European dates": (GYRO.replace("\n0.0", "\n01.03.2024"), READ,
        "line 2: time must be a finite number, got '01.03.2024'"),
    "an unknown unit": (GYRO, READ | dict(units={"rates": "grad/s"}),
        "units of rates must be 'rad/s' or 'deg/s' or 'rpm'"),
    "a unit of nothing": (GYRO, READ | dict(units={"rate": "rad/s"}),
        "a key of units must be 'time' or 'rates', got"),
    "two rates": (GYRO, READ | dict(rates=["x", "y"]), "rates must be 3 different columns"),
    "one column twice": (GYRO, READ | dict(rates=["x", "x", "y"]), "rates must be 3 different columns"),
    "a text for a list": (GYRO, READ | dict(rates="xyz"), "rates must be 3 different columns"),
    "a negative index": (GYRO, READ | dict(time=-1), "counted from 0, got -1"),
    "nothing to read": (GYRO, dict(time="t"), "give the columns of rates, of attitudes"),
    "a delimiter of two": (GYRO, READ | dict(delimiter=", "), "delimiter must be one character"),
    "a delimiter of digits": (GYRO, READ | dict(delimiter="0"), "delimiter must be one character"),
    "no unit quaternion": (STARS.replace("0.8,0.6", "0.8,0.7"), STARRED,
        r"line 3: attitudes must be unit .*norm 1\.063"),
    "zeros for a quaternion": (STARS.replace("0.8,0.6", "0,0"), STARRED, "line 3: attitudes must be unit .*norm 0"),
    "an order": (STARS, STARRED | dict(scalar="middle"), "scalar must be 'first' or 'last', got 'middle'"),
    "a direction": (STARS, STARRED | dict(frame="inertial"), "frame must be 'body_to_space' or 'space_to_body'"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_log_is_refused_by_one_sentence(name, tmp_path):
    text, options, message = BAD[name]
    path = tmp_path / "log.csv" if text is None else written(tmp_path, text)
    with pytest.raises(ValueError, match=message) as found:
        read_csv_log(path, **options)
    assert str(found.value).isprintable()
    assert len(str(found.value)) < 900


def test_quaternions_are_those_of_this_package(tmp_path):
    """Of any order and direction, without jumps of sign."""
    path = written(tmp_path, "t,i,j,k,w\n0,0,0.6,0,0.8\n1,0,-0.8,0,-0.6\n2,0,1,0,0\n3,0,-0.8,0,0.6\n")
    log = read_csv_log(path, time="t", attitudes=["i", "j", "k", "w"], scalar="last", frame="space_to_body")
    expected = [[0.8, 0, -0.6, 0], [0.6, 0, -0.8, 0], [0, 0, -1, 0], [-0.6, 0, -0.8, 0]]
    np.testing.assert_array_equal(log.attitudes, expected)
    np.testing.assert_array_equal(
        log.attitudes[:2], li.attitude.from_scalar_last([[0, 0.6, 0, 0.8], [0, 0.8, 0, 0.6]], "space_to_body")
    )


def test_quaternions_of_five_digits_are_normalized_with_one_warning(tmp_path):
    q = np.random.default_rng(0).normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    path = written(
        tmp_path, "t,w,i,j,k\n" + "".join(f"{t},{','.join(f'{x:.5f}' for x in r)}\n" for t, r in enumerate(q))
    )
    with pytest.warns(RuntimeWarning, match=r"attitudes\[\d+\] has the norm .*normalized") as found:
        log = read_csv_log(path, **STARRED)
    assert len(found) == 1
    sign = np.sign(np.sum(log.attitudes * q, axis=1, keepdims=True))
    np.testing.assert_allclose(log.attitudes * sign, q, rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(log.attitudes, axis=1), 1, rtol=0, atol=3e-16)


def test_epochs_and_rates_in_degrees(tmp_path):
    dated = (
        GYRO.replace("\n0.0", "\n2024-03-01T12:00:10")
        .replace("\n0.5", "\n2024-03-01T12:00:11")
        .replace("\n1.0", "\n2024-03-02")
    )
    log = read_csv_log(written(tmp_path, dated), **READ, units={"rates": "deg/s"})
    assert log.times.tolist() == [0, 1, 43190]
    assert str(log.epoch) == "2024-03-01T12:00:10 UTC"
    np.testing.assert_allclose(log.rates, np.deg2rad(np.arange(1, 10).reshape(3, 3) / 10), rtol=3e-16)
    late = read_csv_log(written(tmp_path, dated), **READ, epoch="2024-03-01T12:00:00Z", units={"rates": "rpm"})
    assert late.times.tolist() == [10, 11, 43200]
    np.testing.assert_allclose(late.rates[0] * 60 / (2 * np.pi), [0.1, 0.2, 0.3], rtol=3e-16)
    assert read_csv_log(written(tmp_path, GYRO), **READ, epoch=late.epoch).epoch == late.epoch


@given(st.text('0123456789.,;-eE#"\n\t txyznia_', max_size=60), st.sampled_from([READ, BY_INDEX]))
def test_any_text_is_read_or_refused(tmp_path_factory, text, options):
    path = written(tmp_path_factory.getbasetemp(), text)
    with contextlib.suppress(ValueError):
        assert np.isfinite(read_csv_log(path, **options).rates).all()


number = st.floats(-1e300, 1e300, allow_subnormal=False)


@given(st.lists(st.tuples(number, number, number), min_size=1, max_size=5))
def test_numbers_are_read_to_the_last_bit(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "bits.csv"
    path.write_text("".join(f"{t} {a!r} {b!r} {c!r}\n" for t, (a, b, c) in enumerate(rows)))
    np.testing.assert_array_equal(read_csv_log(path, **BY_INDEX).rates, rows)


BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
WRITTEN = dict(time="time", rates=[f"angular_velocity_{x}" for x in "xyz"], attitudes=["q_w", "q_x", "q_y", "q_z"])


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz"])
def test_a_run_is_written_and_read_to_the_last_bit(name, tmp_path):
    start = BODY.state([0.6, 0.8, 0, 0], angular_velocity=[0.3, 2.0, -0.1])
    run = li.run(li.schemes.so3_midpoint(BODY), start, dt=0.05, num_steps=40, progress=False)
    write_csv(tmp_path / name, run)
    log = read_csv_log(tmp_path / name, **WRITTEN)
    np.testing.assert_array_equal(log.times, run.t)
    np.testing.assert_array_equal(log.attitudes, run.state.q)
    np.testing.assert_array_equal(log.rates, run.map(lambda step, state: step.system.angular_velocity(state)))
    if name.endswith(".gz"):
        assert gzip.decompress((tmp_path / name).read_bytes()).startswith(b"time,q_w,")


def test_members_of_a_run_have_a_column(tmp_path):
    make = lambda w: BODY.state(angular_velocity=[0.1, w, 0.2])  # noqa: E731
    starts = li.State(*(np.stack(x) for x in zip(*[(s.q, s.p) for s in map(make, (0.3, 0.5))], strict=True)))
    run = li.run(li.schemes.so3_midpoint(BODY), starts, dt=0.1, num_steps=3, progress=False)
    write_csv(tmp_path / "run.csv", run)
    for k in range(2):
        log = read_csv_log(tmp_path / "run.csv", **WRITTEN, member=k)
        np.testing.assert_array_equal(log.attitudes, run.state.q[:, k])
        np.testing.assert_array_equal(log.times, run.t)
    with pytest.raises(ValueError, match=r"line 6: times must increase.*give member="):
        read_csv_log(tmp_path / "run.csv", **WRITTEN)


def test_runs_of_other_systems_are_refused(tmp_path):
    with pytest.raises(ValueError, match="runs of one rigid body"):
        write_csv(tmp_path / "run.csv", "run")
    assert not list(tmp_path.iterdir())
