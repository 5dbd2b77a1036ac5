"""Runs on disk: the same bits as in memory, whatever ended them and however often, and nothing lost or half written."""

import contextlib
import filecmp
import itertools
import logging
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
import zipfile
from pathlib import Path

import internals
import jax
import jax.numpy as jnp
import killed
import numpy as np
import pytest
import scripts
import zarr
from free_bodies import rows
from grid import steps
from stores import Crash, assert_same, disk_for

import lieint_jax as li
from lieint_jax.runs import store as archives

pytestmark = pytest.mark.long

J123 = np.array([1.0, 2.0, 3.0])
BODY = li.systems.rigid_body(J123)
STEP = li.schemes.so3_midpoint(BODY)
RNG = np.random.default_rng(7)
Q = RNG.normal(size=(40, 4))
Q /= np.linalg.norm(Q, axis=1, keepdims=True)
OMEGA = 0.4 * RNG.normal(size=(40, 3))
MOMENTA = [np.array(rows(*q)).T @ (J123 * w) for q, w in zip(Q, OMEGA, strict=True)]
STATES = li.State(jnp.array(Q), jnp.array(np.array(MOMENTA)))


def run(path=None, step=STEP, dt=0.1, num_steps=60, save_every=5, **options):
    return li.run(step, STATES, dt, num_steps, save_every=save_every, store=path, progress=False, **options)


def same_folders(a, b):
    """Whether two stores are the same, file by file and byte by byte."""
    files = [sorted(f.relative_to(p) for p in (path,) for f in p.rglob("*") if f.is_file()) for path in (a, b)]
    assert files[0] == files[1]
    _, different, missing = filecmp.cmpfiles(a, b, files[0], shallow=False)
    return not different and not missing


def test_a_store_holds_what_memory_would(tmp_path, small_chunks):
    memory, disk = run(), run(tmp_path / "run.zarr")
    assert_same(memory, disk)
    assert not list((tmp_path / "run.zarr").rglob("*.partial"))
    assert (tmp_path / "run.zarr/parts/0/state").stat().st_size < 2000  # of a complete run it has no states
    again, metadata = archives.load_store(tmp_path / "run.zarr")
    np.testing.assert_array_equal(again.state.q[3, 5], memory.state.q[3, 5])
    assert metadata["scheme"] == "so3_midpoint[symplectic]"
    assert metadata["run"]["versions"]["jax"] == jax.__version__


@pytest.mark.quick
def test_reductions_are_those_of_the_trajectory(tmp_path, small_chunks, lieint):
    every = li.run(STEP, STATES, 0.1, 60, save_every=1, progress=False)
    change = (every.state.q[1:, :, 0] - every.state.q[0, :, 0]).reshape(12, 5 * 40)
    found = run(reduce=lambda step, z: z.q[0]).summary
    for kept, expected in zip(found[1:4], (change.min(1), change.max(1), change.mean(1)), strict=True):
        np.testing.assert_allclose(kept[1:], expected, rtol=1e-12)
    np.testing.assert_array_equal(found.residual[1:], every.info.residual[1:].reshape(12, -1).max(1))
    assert not found.unconverged.any()
    np.testing.assert_array_equal(found.state.q, every.state.q[-1])
    energy = run(reduce="energy").summary
    assert max(np.abs(x).max() for x in energy[1:4]) < 2e-14  # floor 3e-15
    assert energy.least[1:].max() < 0 < energy.greatest[1:].min()
    assert_same(run(tmp_path / "a.zarr", reduce="energy").summary, energy)
    described = lieint("info", "a.zarr")
    for name, value in (("least", energy.least.min()), ("greatest", energy.greatest.max())):
        assert f"{name} {value:.3g}" in described
    assert "unconverged members 0" in described
    with pytest.raises(ValueError, match=r'reduce must be None, "energy" or a function'):
        run(reduce="momentum")


def test_xarray_reads_a_store(tmp_path, small_chunks):
    xarray = pytest.importorskip("xarray")
    memory = run()
    run(li.StoreOptions(tmp_path / "run.zarr", {"seed": 3, "scenario": {"title": "x"}}, "d"))
    with xarray.open_zarr(tmp_path / "run.zarr") as data:
        assert data.sizes == {"time": 13, "member": 40, "quaternion": 4, "axis": 3}
        np.testing.assert_array_equal(data.q.sel(time=2.0, method="nearest"), memory.state.q[4])
        np.testing.assert_array_equal(data.time, memory.t)
        assert (data.attrs["dt"], data.attrs["seed"], data.time.attrs["units"]) == (0.1, 3, "d")
        assert data.p.attrs["units"] == "unit of inertia / d"


def test_a_run_is_saved_to_one_file_as_zarr_reads_it(tmp_path):
    xarray = pytest.importorskip("xarray")
    memory, folder, path = run(), tmp_path / "run.zarr", tmp_path / "run.zip"
    saved = memory.save(li.StoreOptions(path, {"seed": 3}, "d"))
    assert_same(saved, memory)
    again = li.open(path)
    assert_same(again, memory)
    np.testing.assert_array_equal(again.energy_error(), memory.energy_error())
    np.testing.assert_array_equal(again.state.q[3, 5], memory.state.q[3, 5])
    assert_same(again.load().extend(10), run(num_steps=70))
    with xarray.open_zarr(zarr.storage.ZipStore(path, mode="r")) as data:
        np.testing.assert_array_equal(data.q, memory.state.q)
        assert (data.attrs["seed"], data.time.attrs["units"]) == (3, "d")
    with zipfile.ZipFile(path) as file:
        assert {info.compress_type for info in file.infolist()} == {zipfile.ZIP_STORED}
        assert file.testzip() is None
    run(folder, reduce="energy")
    if shutil.which("zip"):  # a folder packed by hand
        subprocess.run(["zip", "-q0rD", "../hand.zip", "."], cwd=folder, check=True)
        assert_same(li.open(tmp_path / "hand.zip").summary, li.open(folder).summary)
    assert {x.name for x in tmp_path.iterdir()} <= {"run.zarr", "run.zip", "hand.zip"}


def test_a_file_is_written_as_a_whole_and_by_save_only(tmp_path):
    memory = run()
    with pytest.raises(ValueError, match=r"to a folder NAME\.zarr, got .*run\.save\('run\.zip'\) writes one file"):
        run(tmp_path / "run.zip")
    whole = memory.save(tmp_path / "whole.zip")
    with disk_for(1000) as waits:
        memory.save(tmp_path / "counted.zip")
    assert (tmp_path / "counted.zip").read_bytes() == (tmp_path / "whole.zip").read_bytes()
    for last in (0, len(waits) // 2, len(waits) - 1):
        with disk_for(last, OSError(28, "No space left on device")), pytest.raises(OSError, match="No space left"):
            memory.save(tmp_path / "run.zip")
    assert sorted(x.name for x in tmp_path.iterdir()) == ["counted.zip", "whole.zip"]
    for use in (lambda: whole.save(tmp_path / "run.zip"), lambda: whole.extend(5)):
        with pytest.raises(ValueError, match=r"whole\.zip"):
            use()


FAULTS = {
    "deleted": lambda file: file.unlink(),
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:-5]),
    "one byte altered": lambda file: file.write_bytes(flipped(file.read_bytes())),
}


def flipped(data):
    """With one bit of a byte in the middle, that is no space, turned."""
    k = next(k for k in range(len(data) // 2, len(data)) if data[k : k + 1].strip())
    return data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_file_of_any_kind_is_named_and_not_used(tmp_path, small_chunks, fault):
    """One file of each array, of its metadata, of the state, and the root, of a run that is half done."""
    half, path = tmp_path / "half.zarr", tmp_path / "run.zarr"
    with contextlib.suppress(Crash), disk_for(140):
        run(half, num_steps=120)
    progress = archives.load_store(half)[1]["progress"]
    assert 8 <= progress["entries"] < 25
    files = {half / "zarr.json": None, half / "parts/0/state": None}
    for array in half.glob("*/"):
        chunks = sorted(array.glob("c/**/*"))
        files |= dict.fromkeys([array / "zarr.json", *[f for f in chunks if f.is_file()][:1]])
    files = [f.relative_to(half) for f in files if (half / f).exists()]
    files = [f for f in files if f.parts[0] != "first_failure"]  # written at the end
    assert len(files) >= 15
    for file in files:
        shutil.copytree(half, path)
        FAULTS[fault](path / file)
        for use in (lambda: run(path, num_steps=120, resume=True), lambda: li.open(path)):
            with pytest.raises(ValueError, match=rf"{re.escape(file.as_posix())} is|does not exist"):
                use()
        shutil.rmtree(path)
    shutil.copytree(half, path)
    run(path, num_steps=120, resume=True)
    run(tmp_path / "whole.zarr", num_steps=120)
    assert same_folders(path, tmp_path / "whole.zarr")


@pytest.mark.parametrize("reduce", [None, "energy"])
def test_an_end_at_any_write_leaves_a_store_that_resumes_to_the_same_bits(tmp_path, small_chunks, reduce):
    """A crash at one wait for the disk after another, between which lie all writes and renames."""
    path, whole = tmp_path / "run.zarr", tmp_path / "whole.zarr"
    run(whole, reduce=reduce)
    seen, stages = 0, set()
    for last in range(0, 1000, 11):
        with contextlib.suppress(Crash), disk_for(last) as waits:
            run(path, reduce=reduce, resume=True)
        crashed = len(waits) > last
        if path.exists():
            found, metadata = archives.load_store(path)
            progress = metadata["progress"]
            assert progress["entries"] >= seen  # nothing that counted is lost
            seen = progress["entries"]
            stages.add(seen)
            if reduce is None and seen:
                assert np.isfinite(found.state.q[...]).all()
                assert found.info.converged[...].all()
        if crashed and last % 2:  # else the next crash is one of the same run, a little later
            run(path, reduce=reduce, resume=True)
            assert same_folders(path, whole)
            shutil.rmtree(path)
            seen = 0
        elif not crashed:
            break
    assert len(stages) >= 4
    assert same_folders(path, whole)


def test_a_resume_with_another_run_is_refused_and_says_why(tmp_path, small_chunks, monkeypatch):
    path = tmp_path / "run.zarr"
    run(li.StoreOptions(path, {"scenario": {"seed": 1}}))
    before = {f: f.read_bytes() for f in path.rglob("*") if f.is_file()}
    with pytest.raises(ValueError, match=r"exists and is not overwritten; resume continues it"):
        run(path)
    for options, message in (
        (dict(dt=0.2), r"dt is 0.1 in the store and 0.2 here"),
        (dict(num_steps=70), r"num_steps is 60 in the store and 70 here"),
        (dict(save_every=10), r"save_every is 5 in the store and 10 here"),
        (
            dict(step=li.schemes.so3_midpoint(BODY, li.maps.kappa_cayley)),
            r"scheme is 'so3_midpoint\[symplectic\]' in the store",
        ),
        (dict(step=li.schemes.so3_midpoint(BODY, iterations=7)), "the equations of the step differ"),
        (
            dict(step=li.schemes.so3_midpoint(li.systems.rigid_body([1.0, 2.0, 2.5]))),
            r"step differ \(system\.inertia\)",
        ),
        (dict(reduce="energy"), "reduce is None in the store and 'energy' here"),
    ):
        with pytest.raises(ValueError, match=message):
            run(path, resume=True, **options)
    with pytest.raises(ValueError, match=r"scenario\.seed is 1 in the store and 2 here"):
        run(li.StoreOptions(path, {"scenario": {"seed": 2}}), resume=True)
    internals.another_version(monkeypatch, lieint_jax="9.9")
    with pytest.raises(ValueError, match=r"versions\.lieint_jax is .* in the store and '9.9' here"):
        run(path, resume=True)
    monkeypatch.undo()
    internals.by_engine(monkeypatch, "xla")
    with pytest.raises(ValueError, match="engine is 'native' in the store and 'xla' here"):
        run(path, resume=True)
    assert before == {f: f.read_bytes() for f in path.rglob("*") if f.is_file()}
    with pytest.raises(ValueError, match="pass store"):
        run(resume=True)
    with pytest.raises(ValueError, match=r"ends in \.zarr"):
        run(tmp_path / "run.npz")


class Begun(Exception):  # noqa: N818
    """The run would begin to integrate."""


@pytest.fixture
def no_loop(monkeypatch):
    internals.refuse_to_integrate(monkeypatch, Begun)


@pytest.fixture(scope="module")
def commits(tmp_path_factory):
    """Copies of a store after each of the first three commits of four, and of the complete one."""
    folder = tmp_path_factory.mktemp("commits")
    with pytest.MonkeyPatch.context() as patch:
        internals.commit_every(patch, 4)
        internals.small_chunks(patch, 20, 8)
        internals.after_commits(patch, lambda path, steps: shutil.copytree(path, folder / f"{steps}.zarr"))
        run(folder / "whole.zarr")
    return [folder / f"{steps}.zarr" for steps in (15, 35, 55, 60)]


def copied(source, path, name="parts/0/state"):
    shutil.copy(source / name, path / name)


def swapped(path, a, b):
    for folder in path:
        (folder / a).rename(folder / "kept")
        (folder / b).rename(folder / a)
        (folder / "kept").rename(folder / b)


def heavier(path):
    zarr.open_array(str(path / "step" / "system_inertia"), mode="r+")[...] = [1.0, 2.0, 2.5]


ELSEWHERE = "is the chunk of another place"
STATE = "parts/0/state"
MIXTURES = {  # which commit, what is done to it, what is said of it
    "the state of a later commit": (0, lambda p, at: copied(at[2], p), r"q/c/1/0/0 is missing"),
    "the state of an earlier one": (2, lambda p, at: copied(at[0], p), rf"{STATE} is that of step 15, .* of step 55"),
    "the root of a later one": (0, lambda p, at: copied(at[2], p, "zarr.json"), rf"{STATE} is that of step 15"),
    "the root of the end": (2, lambda p, at: copied(at[3], p, "zarr.json"), rf"{STATE} is that of step 55, .* step 60"),
    "a part of its state": (
        1,
        lambda p, at: (p / STATE).write_bytes((at[1] / STATE).read_bytes()[:-9]),
        rf"{STATE} is damaged: its state is altered or cut off",
    ),
    "two chunks swapped": (1, lambda p, at: swapped([p / "q/c"], "0", "1"), f"q/c/0/0/0 {ELSEWHERE}"),
    "the same in a complete run": (3, lambda p, at: swapped([p / "q/c"], "0", "2"), f"q/c/2/0/0 {ELSEWHERE}"),
    "an inertia rewritten": (1, lambda p, at: heavier(p), "step/system_inertia is not as the run wrote it"),
    "the same in a complete one": (3, lambda p, at: heavier(p), "step/system_inertia is not as the run wrote it"),
    "no state": (1, lambda p, at: (p / STATE).unlink(), rf"{STATE} is missing"),
    "no parts": (1, lambda p, at: shutil.rmtree(p / "parts"), rf"{STATE} is missing"),
    "no array for the end": (1, lambda p, at: shutil.rmtree(p / "first_failure"), "first_failure/zarr.json is missing"),
}


@pytest.mark.parametrize("mixture", MIXTURES)
def test_a_copy_that_mixes_commits_or_places_is_neither_opened_nor_resumed(tmp_path, commits, mixture, no_loop):
    which, change, sentence = MIXTURES[mixture]
    path = shutil.copytree(commits[which], tmp_path / "copy.zarr")
    li.open(path)
    change(path, commits)
    with pytest.raises(ValueError, match=sentence):
        li.open(path)
    with pytest.raises(ValueError, match=sentence):
        run(path, resume=True)


@pytest.mark.quick
def test_a_store_that_grows_while_it_is_checked_is_not_called_damaged(tmp_path, commits, monkeypatch):
    """Two commits come between the root and the state that are read: what the state lists is what is opened."""
    path, left = shutil.copytree(commits[0], tmp_path / "run.zarr"), [1]

    def overtake():
        left[0] -= 1
        if left[0] == 0:
            shutil.copytree(commits[2], path, dirs_exist_ok=True)

    internals.after_roots_are_read(monkeypatch, overtake)
    assert li.open(path).t.shape == (12,)
    assert left[0] < 0


@pytest.mark.quick
@pytest.mark.parametrize("commit", [2, 3], ids=["on the way", "at the end"])
def test_a_root_that_was_not_written_after_a_commit_is_written_by_the_run_that_resumes(tmp_path, commits, commit):
    """A kill between the state and the root: nothing is lost, and readers of Zarr see the commit before."""
    path = shutil.copytree(commits[commit], tmp_path / "run.zarr")
    copied(commits[commit - 1], path, "zarr.json")
    assert zarr.open_group(str(path), mode="r")["q"].shape[0] == 4 * commit
    assert li.open(path).t.shape == ((12, 13)[commit - 2],)
    with pytest.MonkeyPatch.context() as patch:
        internals.commit_every(patch, 4)
        internals.small_chunks(patch, 20, 8)
        run(path, resume=True)
    assert same_folders(path, commits[3])


@pytest.mark.quick
@pytest.mark.parametrize("options", [{}, {"reduce": "energy"}, {"save_every": None}], ids=["states", "reduced", "end"])
def test_chunks_of_one_entry_are_committed_one_by_one(tmp_path, monkeypatch, options):
    """As of runs of millions of members: the entry of the start is a commit of its own."""
    internals.commit_every(monkeypatch, 1)
    memory, disk = run(**options), run(tmp_path / "run.zarr", **options)
    assert_same(memory, disk)
    assert_same(li.open(tmp_path / "run.zarr"), memory)
    if not options:
        whole = li.run(STEP, STATES, 0.1, 60, save_every=5, progress=False)
        assert_same(whole.save(tmp_path / "saved.zarr").state, memory.state)
        assert_same(li.open(tmp_path / "saved.zarr"), memory)


@pytest.mark.quick
def test_a_store_in_which_nothing_is_published_is_opened(tmp_path, no_loop, lieint):
    for name, part in (("whole", None), ("parts", (0, 2))):
        path = tmp_path / f"{name}.zarr"
        with pytest.raises(Begun):
            run(path, part=part)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = li.open(path)
        assert found.state.q.shape == (0, 40, 4)
        np.testing.assert_array_equal(found.failed, np.full(40, -1))
        assert re.search("0 of 13 entries|0 of 2 part", lieint("info", path))


def test_a_store_can_be_made_for_every_scheme_and_for_groups_with_empty_arrays(tmp_path, no_loop):
    chosen = {type(step): (step, state, dt) for _, step, state, dt in steps()}
    chosen |= {n: case for n, *case in steps() if any(np.size(x) == 0 for x in jax.tree.leaves(case[0]))}
    assert len(chosen) >= 25
    for k, (step, state, dt) in enumerate(chosen.values()):
        with pytest.raises(Begun):
            li.run(step, state, dt, 2, store=tmp_path / f"{k}.zarr", progress=False)
        found = li.open(tmp_path / f"{k}.zarr").step
        assert jax.tree.structure(found) == jax.tree.structure(step)
        jax.tree.map(np.testing.assert_array_equal, found, step)


@pytest.mark.quick
def test_folders_that_a_killed_process_made_are_synced_by_the_next(tmp_path, monkeypatch, small_chunks):
    path, synced, sync = tmp_path / "run.zarr", [], os.fsync
    with contextlib.suppress(Crash), disk_for(45):
        run(path)
    assert (path / "q/c/0").exists()
    monkeypatch.setattr(os, "fsync", lambda d: synced.append(os.readlink(f"/proc/self/fd/{d}")) or sync(d))
    run(path, resume=True)
    assert {str(path), str(path / "q"), str(path / "q/c"), str(path / "parts")} <= set(synced)


def left_by_a_kill(path, chunk, **options):
    """The folders of the unfinished files that a run leaves which is killed while it waits for this chunk's disk."""
    sync, chunks = os.fsync, itertools.count()

    def fsync(descriptor):
        if re.search(rf"/{path.name}/.*/\.\d+\.", os.readlink(f"/proc/self/fd/{descriptor}")) and next(chunks) == chunk:
            raise Crash
        sync(descriptor)

    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Crash):
        patch.setattr(os, "fsync", fsync)
        patch.setattr(Path, "unlink", lambda *_, **__: None)
        run(path, **options)
    return {file.relative_to(path).parent.as_posix() for file in path.rglob("*.partial")}


@pytest.mark.quick
@pytest.mark.parametrize("chunk", [0, 7])
def test_an_unfinished_file_of_a_killed_process_is_removed_by_the_next(tmp_path, small_chunks, chunk):
    path = tmp_path / "run.zarr"
    assert left_by_a_kill(path, chunk) == {"parts/0"}
    run(path, resume=True)
    assert not list(path.rglob("*.partial"))


@pytest.mark.quick
def test_an_unfinished_file_of_another_part_is_not_removed(tmp_path, small_chunks):
    """Its process may be alive."""
    path = tmp_path / "run.zarr"
    assert left_by_a_kill(path, 3, part=(0, 2)) == {"parts/0"}
    left = list(path.rglob("*.partial"))
    run(path, part=(1, 2), resume=True)
    assert left == list(path.rglob("*.partial"))
    run(path, part=(0, 2), resume=True)
    assert not list(path.rglob("*.partial"))


@pytest.mark.quick
def test_two_processes_that_create_one_store(tmp_path, monkeypatch):
    """The second comes between the check and the rename of the first."""
    path = tmp_path / "run.zarr"

    def create():
        monkeypatch.undo()
        run(path, num_steps=5)

    internals.before_new_stores(monkeypatch, create)
    with pytest.raises(ValueError, match=r"run\.zarr was created by another run in the meantime"):
        run(path, num_steps=5)
    assert [p.name for p in tmp_path.iterdir()] == ["run.zarr"]
    assert li.open(path).info.converged[...].all()


@pytest.mark.quick
def test_what_a_killed_process_left_of_a_store_is_removed_when_it_is_old(tmp_path, no_loop):
    for age in (0, 7200.0):
        left = tmp_path / f".run.zarr.{age:.0f}-00.partial"
        left.mkdir()
        os.utime(left, (time.time() - age, time.time() - age))
    with pytest.raises(Begun):
        run(tmp_path / "run.zarr")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".run.zarr.0-00.partial", "run.zarr"]


@pytest.mark.quick
@pytest.mark.usefixtures("no_loop")
def test_places_and_attributes_that_no_store_can_have_are_refused_before_the_run(tmp_path):
    (tmp_path / "link.zarr").symlink_to("nowhere")
    loop = {}
    loop["loop"] = loop
    for name, attributes, message in (
        ("link", {}, r"link\.zarr is a link to nowhere, which does not exist"),
        (240 * "x", {}, r"xxx\.zarr cannot be created: File name too long; choose another"),
        (300 * "x", {}, r"xxx\.zarr cannot be created: File name too long; choose another"),
        ("taken", {"run": 1, "members": 2, "seed": 3}, r"may not be called members, run: these names are reserved"),
        ("taken", {"progress": 1, "machines": []}, "may not be called machines, progress"),
        ("object", {"body": BODY}, "must be values for JSON; 'body' is not: Object of type RigidBody"),
        ("scenario", {"scenario": {"x": {1}}}, "'scenario' is not: Object of type set"),
        ("number", {"n": np.int64(1)}, "'n' is not: Object of type int64"),
        ("infinite", {"x": float("nan")}, "'x' is not: Out of range float"),
        ("key", {3: 1}, "3 is not: names must be strings"),
        ("loop", loop, "'loop' is not: Circular"),
    ):
        with pytest.raises((ValueError, OSError), match=message):
            run(li.StoreOptions(tmp_path / f"{name}.zarr", attributes))
    assert [p.name for p in tmp_path.iterdir()] == ["link.zarr"]


def shifted(step, z, by=1.0):
    return z.q[0] + by


@pytest.mark.quick
@pytest.mark.usefixtures("no_loop")
def test_a_reduced_quantity_may_have_a_default_argument():
    with pytest.raises(Begun):
        run(reduce=shifted)


@pytest.mark.quick
def test_a_reduced_quantity_is_traced_in_the_first_call_only(caplog):
    """The count is one of records of a log: a list to which the function appends would be a value that it reads."""

    def noted(step, z):
        logging.getLogger("traced").warning("now")
        return z.q[0]

    first = run(reduce=noted)
    assert caplog.records
    caplog.clear()
    assert_same(run(reduce=noted), first)
    assert not caplog.records


def test_a_quantity_that_is_nan_is_nan_in_all_of_its_interval_and_refused_at_the_start():
    """Above the values of the first half of the run it is NaN, for some members."""
    whole = run(num_steps=20, save_every=1).state.q[1:, :, 0]
    limit = float(whole[:10].max())
    assert (whole[10:] > limit).any()
    found = run(num_steps=20, save_every=10, reduce=lambda step, z: jnp.where(z.q[0] > limit, jnp.nan, z.q[0])).summary
    for series in found[1:4]:
        np.testing.assert_array_equal(np.isnan(series), [False, False, True])
    np.testing.assert_allclose(found.mean[1], (whole[:10] - Q[:, 0]).mean(), rtol=0, atol=1e-15)  # observed 6e-17
    bad = np.flatnonzero(Q[:, 0] < -0.5)
    with pytest.raises(ValueError, match=rf"reduce must be finite at the start.*{bad.size} member\(s\): {bad[0]}"):
        run(reduce=lambda step, z: jnp.sqrt(z.q[0] + 0.5))


@pytest.mark.quick
def test_two_runs_do_not_write_to_one_store(tmp_path, small_chunks):
    run(tmp_path / "run.zarr")
    lock = archives.open_storage(tmp_path / "run.zarr").lock("parts/0")
    with lock, pytest.raises(BlockingIOError, match="another run is writing"):
        run(tmp_path / "run.zarr", resume=True)


@contextlib.contextmanager
def tmpfs(path, size):
    path.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", path], capture_output=True).returncode:
        pytest.skip("mounting needs root")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", path], check=True)


def test_a_full_disk_ends_a_run_that_resumes_to_the_same_bits(tmp_path, small_chunks):
    run(tmp_path / "whole.zarr", num_steps=600)
    with tmpfs(tmp_path / "disk", "240k"):
        path = tmp_path / "disk/run.zarr"
        with pytest.raises(OSError, match=r"No space left on device: .* holds everything up to step \d+; .* resume"):
            run(path, num_steps=600)
        found, metadata = archives.load_store(path)
        assert 4 <= metadata["progress"]["entries"] < 121
        assert np.isfinite(found.state.q[...]).all()
        subprocess.run(["mount", "-o", "remount,size=4m", tmp_path / "disk"], check=True)
        run(path, num_steps=600, resume=True)
        assert same_folders(path, tmp_path / "whole.zarr")


def test_a_limit_on_the_size_of_files_ends_a_run_that_resumes_to_the_same_bits(tmp_path, monkeypatch):
    """What needs no root: the system refuses files above a size, below that of the metadata or that of the chunks."""
    internals.commit_every(monkeypatch, 13)
    run(tmp_path / "whole.zarr")
    path, before = tmp_path / "run.zarr", resource.getrlimit(resource.RLIMIT_FSIZE)
    for size, message in ((3000, "cannot be created: File too large"), (14_000, "too large: .* step 0; .* resume")):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            with pytest.raises(OSError, match=message):
                run(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert len(list(tmp_path.iterdir())) == 1 + path.exists()
    run(path, resume=True)
    assert same_folders(path, tmp_path / "whole.zarr")


def test_an_interrupt_waits_for_the_chunk_and_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    internals.commit_every(monkeypatch, 50)
    path, steps, before = tmp_path / "run.zarr", 20_000_000, signal.getsignal(signal.SIGINT)

    def interrupt():
        wait_for_a_commit(path)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt, match=rf"stopped after \d+ of {steps} steps, all of them in .*; resume"):
        run(path, num_steps=steps, save_every=1000)
    assert "finishing the chunk" in capsys.readouterr().err
    progress = archives.load_store(path)[1]["progress"]
    assert progress["steps"] > 0
    assert progress["entries"] % 50 == 0
    assert signal.getsignal(signal.SIGINT) is before


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    """A script of some seconds, and the store of its uninterrupted run."""
    folder = tmp_path_factory.mktemp("bodies")
    scripts.written(folder / "bodies.py")
    assert command(folder, "--out", "whole.zarr").wait() == 0
    return folder


def command(folder, *options, **popen):
    script = ["run", "bodies.py", "--members", "100", "--steps", "800000"]
    arguments = [sys.executable, "-m", "lieint_jax.command.cli", *script, *options]
    return subprocess.Popen(arguments, cwd=folder, stdout=subprocess.DEVNULL, **popen)


def test_a_run_killed_at_random_moments_resumes(bodies):
    delays = np.random.default_rng(11).uniform(1.5, 5.0, 5)
    ended = 0
    for delay in delays:
        process = command(bodies, "--out", "killed.zarr", "--resume", stderr=subprocess.DEVNULL)
        time.sleep(delay)
        ended += process.poll() is None
        process.kill()
        process.wait()
    assert ended >= 2
    assert command(bodies, "--out", "killed.zarr", "--resume").wait() == 0
    assert same_folders(bodies / "killed.zarr", bodies / "whole.zarr")


def killable(case, path, pause):
    command = [sys.executable, str(Path(killed.__file__)), case, str(path), str(pause)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def commits_of(path):
    return archives.load_store(path)[1]["progress"]["commits"] if path.exists() else 0


@pytest.mark.parametrize("case", killed.CASES)
def test_kills_at_random_moments_leave_the_same_bits(tmp_path, case):
    """Seven of each case: every second one within a second after a commit, the others from the start of Python on."""
    path, rng, ends = tmp_path / "killed.zarr", np.random.default_rng(12), []
    while len(ends) < 7:
        process, before = killable(case, path, 0.01), commits_of(path)
        while len(ends) % 2 and commits_of(path) == before and process.poll() is None:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 1 if len(ends) % 2 else 5))
        ended = process.poll()
        process.kill()
        error = process.communicate()[1].decode()
        assert ended is None, error  # neither complete nor failed
        ends.append(commits_of(path))
    assert ends == sorted(ends)
    assert len(set(ends)) > 3  # of 60
    for last in (path, tmp_path / "whole.zarr"):
        process = killable(case, last, 0)
        error = process.communicate()[1].decode()
        assert process.returncode == 0, error
    assert same_folders(path, tmp_path / "whole.zarr")


@pytest.mark.parametrize("signals", [[signal.SIGINT, signal.SIGINT], [signal.SIGTERM]], ids=["SIGINT twice", "SIGTERM"])
def test_a_run_that_a_signal_ended_at_once_is_resumed(bodies, signals):
    """The second SIGINT does not wait for the chunk; SIGTERM is what a scheduler sends."""
    path = bodies / f"{len(signals)}.zarr"
    process = command(bodies, "--out", path.name, stderr=subprocess.DEVNULL)
    wait_for_a_commit(path)
    for number in signals:
        process.send_signal(number)
        time.sleep(0.1)
    assert process.wait(timeout=30) != 0
    assert not archives.load_store(path)[1]["progress"]["complete"]
    assert command(bodies, "--out", path.name, "--resume").wait() == 0
    assert same_folders(path, bodies / "whole.zarr")


def limited(size):
    """Files of more than so many bytes are refused, as all are on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@pytest.mark.parametrize("end", ["interrupt", "full"])
def test_a_script_that_is_interrupted_or_fills_the_disk_ends_with_one_line_and_resumes(bodies, end):
    path = bodies / f"{end}.zarr"
    options = dict(stderr=subprocess.PIPE, text=True)
    if end == "full":  # the first files are smaller, and the chunks of states larger
        process = command(bodies, "--out", path.name, **options, preexec_fn=lambda: limited(100_000))
    else:
        process = command(bodies, "--out", path.name, **options)
        wait_for_a_commit(path)
        process.send_signal(signal.SIGINT)
    lines = list(filter(None, process.communicate(timeout=60)[1].splitlines()))
    assert process.returncode == {"full": 2, "interrupt": 130}[end]
    said = {
        "full": "File too large: .* holds everything up to step",
        "interrupt": "stopped after .* steps, all of them",
    }
    assert re.fullmatch(rf"lieint: .*{said[end]}.*resume.*", lines[-1])
    assert len(lines) == {"full": 1, "interrupt": 2}[end]  # that the chunk is being finished
    assert not archives.load_store(path)[1]["progress"]["complete"]
    assert command(bodies, "--out", path.name, "--resume").wait() == 0
    assert same_folders(path, bodies / "whole.zarr")


def wait_for_a_commit(path):
    limit = time.monotonic() + 60
    while not (path.exists() and archives.load_store(path)[1]["progress"]["entries"]):
        assert time.monotonic() < limit
        time.sleep(0.05)


def test_the_command_writes_resumes_and_shows(fresh_folder, lieint):
    run = ("run", scripts.written("writes.py"), "--steps", "2000", "--out", "run.zarr", "--members")
    assert "3 of 3 members converged at every step" in lieint(*run, "3")
    assert "run.zarr exists and is not overwritten" in lieint.refuse(*run, "3")
    lieint(*run, "3", "--resume")
    assert "members is 3 in the store and 4 here" in lieint.refuse(*run, "4", "--resume")
    out = lieint("info", "run.zarr")
    assert "complete: 21 of 21 entries" in out
    assert "so3_midpoint[symplectic]" in out
    assert "3 of 3 members converged at every step" in lieint("plot", "run.zarr")
    lieint.drew("run-motion.png", "run-errors.png")
    assert "run-errors.png exists" in lieint.refuse("plot", "run.zarr")


EIGHT = """
import hashlib, jax, lieint_jax as li
from lieint_jax.runs import first_devices
jax.config.update("jax_enable_x64", True)
J = jax.numpy.array([[1.0, 2.0, 3.0], [1.0, 1.0, 1.5]] * 150)
states = jax.vmap(lambda J, w: li.systems.rigid_body(J).state(angular_velocity=w))(
    J, 0.4 * jax.random.normal(jax.random.key(0), (300, 3))
)
steps = jax.vmap(lambda J: li.schemes.so3_midpoint(li.systems.rigid_body(J)))(J)
for count in (1, 3, 8):
    mesh = first_devices(count)
    options = dict(save_every=100, own_step=True, mesh=mesh)
    kept = [li.run(steps, states, 0.1, 400, reduce=how, **options) for how in (None, "energy")]
    times = jax.numpy.linspace(0, 20, 101) ** 1.2
    kept += [li.run(steps, states, own_step=True, times=times, save_at=[0.3, 5, 5.01, 30], mesh=mesh)]
    leaves = [jax.tree.leaves((run.trajectory, run.summary)) for run in kept]
    print(*(hashlib.sha256(b"".join(x.tobytes() for x in found)).hexdigest() for found in leaves))
"""


def test_one_device_or_eight_are_the_same_bits():
    """States and reductions, of an inertia each, of members that divide evenly among the devices or not."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=8"}
    found = subprocess.run([sys.executable, "-c", EIGHT], env=environment, check=True, capture_output=True, text=True)
    assert len(found.stdout.splitlines()) == 3
    assert len(set(found.stdout.splitlines())) == 1


@pytest.mark.parametrize(("make", "bound"), [(li.schemes.so3_midpoint, 3e-13), (li.schemes.so3_explicit, 1e-14)])
def test_energy_over_a_million_steps(make, bound):
    """Worst of 16 random bodies at any of 10⁶ steps; the floor is 6e-14 and 3e-15. benchmarks/round_off.py has 10⁸."""
    rng = np.random.default_rng(1)
    q, w = rng.normal(size=(16, 4)), rng.normal(size=(16, 3))
    w *= np.cbrt(rng.random((16, 1))) / np.linalg.norm(w, axis=1, keepdims=True)
    states = jax.vmap(lambda q, w: BODY.state(q, angular_velocity=w))(
        jnp.array(q / np.linalg.norm(q, axis=1, keepdims=True)), jnp.array(w)
    )
    relative = lambda step, z: jnp.log(step.system.energy(z))  # noqa: E731
    found = li.run(make(BODY), states, 0.05, 1_000_000, save_every=100_000, reduce=relative, progress=False).summary
    worst = max(-found.least.min(), found.greatest.max())
    slope = np.polyfit(found.t / 0.05, found.mean, 1)[0]
    assert worst < bound
    assert abs(slope) < bound / 3e6  # per step
    assert not found.unconverged.any()
