"""Logs as CSV: what is written is read to the last bit, and each of many spoiled files has a decided result."""

import contextlib
import gzip

import data_files
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


def cases(kind):
    """Name ↦ text, arguments and pattern of the error of the logs of `tests/data/csv_logs.toml`."""
    for name, row in data_files.table("csv_logs")[kind].items():
        text, arguments = (STARS, STARRED) if row.get("log") == "stars" else (row.get("text", GYRO), READ)
        for old, new in row.get("replace", []):
            text = text.replace(old, new)
        yield name, (text, arguments | row.get("arguments", {}), row.get("message"))


SAME = dict(cases("same")) | {"UTF-16": (GYRO.encode("utf-16"), READ, None)}  # the same log in another dress


@pytest.mark.parametrize("name", SAME)
def test_a_log_in_another_dress_is_the_same(name, tmp_path):
    text, options, _ = SAME[name]
    log = read_csv_log(written(tmp_path, text), **options)
    assert log.times.tolist() == SINGLE
    np.testing.assert_array_equal(log.rates, np.arange(1, 10).reshape(3, 3) / 10)
    assert log.attitudes is None
    assert (log.epoch is None) == ("da" not in name)


BAD = dict(cases("bad")) | {
    "no file": (None, READ, "there is no file"),
    "no text": (b"\xff\x00\x81\x00\x00", READ, "not UTF-8|null|no text"),
    "Latin-1": (GYRO.replace("x", "\xb0").encode("latin-1"), READ, "is not UTF-8 text"),
    "zeros": (GYRO.encode() + b"\0\0", READ, "null character"),
    "many columns": (",".join(f"c{k}" for k in range(10**4)) + "\n", READ, r"no column 't'.*c39, …"),
    "a cell of a million characters": (GYRO.replace("0.4", "4" * 10**6), READ, "line 3: the cells cannot be separated"),
    "nothing to read": (GYRO, dict(time="t"), "give the columns of rates, of attitudes"),
}


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
