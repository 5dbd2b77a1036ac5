"""Runs in parts, on a disk and in object storage: the same bits as one process, however its parts end and begin.

Object storage is moto's S3 server in a process of its own (`python tests/lib/faults.py PORT_FILE`), behind a proxy that
lets requests fail; and, where no server is needed, the memory of obstore.
"""

import contextlib
import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

import faults
import internals
import jax
import jax.numpy as jnp
import killed
import numpy as np
import pytest
import scripts
from stores import Crash, assert_same

import lieint_jax as li
from lieint_jax.command import cli
from lieint_jax.runs import _dyadic_sum
from lieint_jax.runs import store as archives
from lieint_jax.runs._storage import bucket as _bucket
from lieint_jax.runs._storage import disk as _disk
from lieint_jax.runs.store import _root

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
STATES = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.array(np.random.default_rng(7).normal(size=(41, 3))))
KEY, SECRET = "AKIDOFTHETESTS", "secretOfTheTests/1234"
needs_obstore = pytest.mark.skipif(find_spec("obstore") is None, reason="needs obstore: pip install lieint_jax[cloud]")
needs_moto = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("obstore", "moto", "flask", "flask_cors")),
    reason="needs an S3 server: pip install lieint_jax[test]",
)
pytestmark = pytest.mark.usefixtures("small_chunks")
PLACES = ["disk", pytest.param("bucket", marks=needs_obstore)]


def run(store=None, part=None, step=STEP, states=STATES, **options):
    options = dict(dt=0.1, num_steps=60, save_every=5, progress=False) | options
    return li.run(step, states, store=store, part=part, **options)


@pytest.fixture(params=PLACES)
def place(request, tmp_path):
    """The address of a new store."""
    return tmp_path / "run.zarr" if request.param == "disk" else f"memory://tests{tmp_path}/run.zarr"


def opened(store):
    """The run in a store, and the warning that it is incomplete."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = li.open(store)
    return found, "".join(str(w.message) for w in caught)


def removed(storage, name):
    if isinstance(storage, _disk.Disk):
        (storage.address / name).unlink()
    else:
        storage._store.delete(name)


@pytest.mark.long
@pytest.mark.parametrize("reduce", [None, "energy"])
def test_parts_in_any_order_are_one_process(place, reduce):
    whole = run(reduce=reduce)
    for k in np.random.default_rng(1).permutation(8).tolist():
        mine = run(place, (k, 8), reduce=reduce)
        assert_same(mine, run(part=(k, 8), reduce=reduce))
    assert_same(li.open(place), whole)
    storage = archives.open_storage(place)
    before = {name: storage.read(name) for name in storage.sizes()}
    run(place, (3, 8), reduce=reduce)  # it is complete
    assert before == {name: storage.read(name) for name in storage.sizes()}


def open_while_it_is_created(url, monkeypatch):
    """A run into a bucket that is opened before every file: what was said, and what could be read, in their order."""
    seen = []

    def look(name):
        try:
            seen.append(int(np.isfinite(li.open(url).state.q[:]).all(axis=(1, 2)).sum()))
        except ValueError as error:
            seen.append(str(error))

    with monkeypatch.context() as patch:
        internals.before_puts(patch, look)
        return seen, run(url)


def check_that_creation_is_no_damage(url, monkeypatch, most):
    """`most`: the entries before the last commit, which are whole chunks; those of object storage are longer."""
    seen, whole = open_while_it_is_created(url, monkeypatch)
    creating = next(k for k, x in enumerate(seen) if not isinstance(x, str))
    assert creating > 5
    assert all("has no results yet" in x and "is being created" in x for x in seen[:creating]), seen
    entries = seen[creating:]
    assert entries == sorted(entries)
    assert (entries[0], entries[-1]) == (0, most)  # the last is seen before its commit
    assert_same(li.open(url), whole)
    archives.open_storage(url).stage("q/zarr.json", b"{}")
    with pytest.raises(ValueError, match=r"is damaged: q/zarr\.json is missing or altered"):
        li.open(url)


@pytest.mark.filterwarnings("ignore:.* is incomplete")  # opened by threads that write
@needs_obstore
def test_a_bucket_that_is_opened_while_it_is_created_is_not_called_damaged(tmp_path, monkeypatch):
    check_that_creation_is_no_damage(f"memory://tests{tmp_path}/run.zarr", monkeypatch, 12)


@needs_obstore
@pytest.mark.parametrize("options", [{"reduce": "energy", "save_every": 5}, {"reduce": "energy", "per": "member"}])
def test_a_reduced_run_into_a_bucket_is_the_one_in_memory(options, tmp_path):
    url = f"memory://tests{tmp_path}/run.zarr"
    kept, memory = (li.run(STEP, STATES, 0.1, 60, store=x, progress=False, **options) for x in (url, None))
    jax.tree.map(np.testing.assert_array_equal, kept.summary, memory.summary)


@pytest.mark.long
@pytest.mark.parametrize(("count", "options"), [(3, {"save_every": None}), (41, {}), (5, {"own_step": True}), (2, {})])
def test_any_number_of_parts_is_one_process(place, count, options):
    if "own_step" in options:
        moments = jnp.linspace(1.0, 1.5, 41)
        step = jax.vmap(lambda a: li.schemes.so3_midpoint(li.systems.rigid_body(jnp.stack([a, 2 * a, 2.5 * a]))))(
            moments
        )
        options = options | {"step": step}
    if count == 2:
        step = li.schemes.splitting(li.systems.driven_top(jnp.array([1.0, 2.0, 2.5]), killed.tilted, killed.axis))
        times = jnp.linspace(0.0, 1.0, 41)
        options = {"step": step, "states": STATES._replace(t=times, work=jnp.zeros(41))}
    for k in range(count):
        run(place, (k, count), **options)
    own = {"killed.tilted": killed.tilted, "killed.axis": killed.axis}
    assert_same(li.open(place, own=own), run(**options))


@pytest.mark.long
def test_the_xla_engine_gives_the_same_in_parts_of_one_member_but_for_rounding(tmp_path, monkeypatch):
    internals.by_engine(monkeypatch, "xla")
    states = jax.tree.map(lambda x: x[:3], STATES)
    for k in range(3):
        run(tmp_path / "run.zarr", (k, 3), states=states)
    found, whole = li.open(tmp_path / "run.zarr"), run(states=states)
    for x, y in zip(jax.tree.leaves(found.state), jax.tree.leaves(whole.state), strict=True):
        np.testing.assert_allclose(x[...], y[...], rtol=0, atol=5e-15)  # observed: 7e-16


def test_the_sum_over_members_does_not_depend_on_the_parts():
    rng = np.random.default_rng(2)
    for _ in range(50):
        members = int(rng.integers(1, 200))
        x = rng.normal(size=(3, members)) * 10.0 ** rng.integers(-8, 8, members)
        ends = [0, *sorted(rng.integers(0, members + 1, 5).tolist()), members]
        ranges = [range(a, b) for a, b in itertools.pairwise(ends) if a < b]
        parts = [(part, _dyadic_sum.block_sums(x[:, part.start : part.stop], part.start)) for part in ranges]
        found = _dyadic_sum.total(parts)
        np.testing.assert_array_equal(found, _dyadic_sum.total([(range(members), _dyadic_sum.block_sums(x))]))
        exact = np.array([np.longdouble(row).sum() for row in x], float)
        assert (abs(found - exact) <= 8 * np.finfo(float).eps * abs(x).sum(axis=1)).all()  # the tree has 8 levels


def test_every_member_is_in_one_part_of_about_equal_size():
    for members, count, most in ((41, 8, 8192), (9, 4, 8192), (100_001, 10, 8192), (5, 5, 2), (10**9, 1000, 8192)):
        ends, chunk = internals.members_of_parts(members, count, most)
        assert [part.start for part in ends] == [0, *(part.stop for part in ends[:-1])]
        assert ends[-1].stop == members
        assert chunk <= most
        assert min(map(len, ends)) > 0
        assert max(map(len, ends)) - min(map(len, ends)) <= chunk
    with pytest.raises(ValueError, match=r"a run of 41 member\(s\) has at most 41 part\(s\), got 42"):
        run(part=(0, 42))


@pytest.mark.long
def test_finished_parts_are_read_and_missing_parts_are_named(place, lieint):
    whole, found = run(), None
    for k in (4, 1):
        run(place, (k, 5))
    found, warning = opened(place)
    assert "part 0 (members 0 … 8) is missing" in warning
    assert "part 3 (members 27 … 35) is missing" in warning
    assert "part 1" not in warning
    for members in (slice(9, 18), slice(36, 41)):
        for x, y in zip(jax.tree.leaves(found.state), jax.tree.leaves(whole.state), strict=True):
            np.testing.assert_array_equal(x[:, members], y[:, members])
        assert found.info.converged[:, members].all()
    assert np.isnan(found.state.q[:, [0, 8, 18, 35]]).all()
    assert not found.info.converged[3, :8].any()
    shown = lieint("info", str(place))
    assert "2 of 5 part(s) complete" in shown
    assert "part 2 (members 18 … 26) is missing" in shown


@pytest.mark.long
def test_published_arrays_have_the_indexing_of_numpy(place):
    for k in (0, 2):
        run(place, (k, 3))
    q = opened(place)[0].state.q
    full = np.asarray(q)
    assert np.isnan(full[:, 14:28]).all()
    assert len(q) == full.shape[0]
    assert (q.shape, q.ndim, q.size, q.nbytes, q.dtype) == (full.shape, 3, full.size, full.nbytes, full.dtype)
    points = np.array([0, 3]), np.array([2, 40])
    for index in (3, -1, slice(None, None, 5), (2, 30), (slice(2), slice(9, 30, 3), 1), ..., (..., 0), (1, ..., 2)):
        np.testing.assert_array_equal(q[index], full[index])
    mixed = (([0, 1], slice(None), [0, 1]), (0, slice(None), [0, 1]), (slice(None), [40, 0], [1, 2]))
    for index in (points, ([5, 1],), (slice(None), [40, 0, 13]), (slice(3, 3),), (4, full[0, :, 0] > 0), *mixed):
        np.testing.assert_array_equal(q[index], full[index])


class Mortal:
    """A process that ends when so many files are written."""

    def __init__(self, monkeypatch):
        self.left = math.inf
        internals.before_puts(monkeypatch, self.put)

    def put(self, _):
        self.left -= 1
        if self.left < 0:
            raise Crash


@pytest.mark.long
@pytest.mark.parametrize("reduce", [None, "energy"])
def test_an_end_at_any_write_of_any_part_leaves_the_same_bits(place, monkeypatch, reduce):
    """Parts in random order, each ended after a random number of files, and begun again; nothing published is lost."""
    whole, rng, seen = run(reduce=reduce), np.random.default_rng(3), np.zeros(4, int)
    mortal, unfinished, crashes = Mortal(monkeypatch), [0, 1, 2, 3], 0
    while unfinished:
        k = int(rng.choice(unfinished))
        mortal.left = int(rng.integers(0, 30))
        try:
            run(place, (k, 4), reduce=reduce)
            unfinished.remove(k)
        except Crash:
            crashes += 1
        mortal.left = math.inf
        if reduce is None:
            with contextlib.suppress(ValueError):  # before the store exists
                root = _root.read_root(archives.open_storage(place))
                if root and not list(_root.Root(archives.open_storage(place), root).damage_of_root()):
                    own = _root.Root(archives.open_storage(place), root).statuses(True)
                    assert not [status.problem for status in own if status.problem and "missing" not in status.problem]
                    entries = np.array([status.progress["entries"] for status in own])
                    assert (entries >= seen).all()
                    seen = entries
    assert crashes >= 8
    assert_same(li.open(place), whole)


def test_two_processes_that_run_one_part_at_the_same_time_do_no_harm(monkeypatch):
    """Object storage has no locks: the second runs while the first is between two commits."""
    pytest.importorskip("obstore")
    url, whole, commits, inside = "memory://tests/twice/run.zarr", run(), [0], [0]

    def interrupt(name):
        commits[0] += name == "parts/0/state"
        inside[0] += commits[0] == 1 and name != "parts/0/state"
        if inside[0] == 1:  # after the first commit of part 0
            run(url, (0, 2))

    internals.before_puts(monkeypatch, interrupt)
    run(url, (0, 2))
    assert commits[0] > 4
    run(url, (1, 2))
    assert_same(li.open(url), whole)


def test_a_slower_process_of_the_same_part_takes_nothing_back(monkeypatch):
    """The faster one runs and ends while the slower one is at its second commit."""
    pytest.importorskip("obstore")
    url, whole, states = "memory://tests/slower/run.zarr", run(part=(0, 2)), [0]

    def overtake(name):
        states[0] += name == "parts/0/state"
        if states[0] == 2:
            states[0] = 3
            assert_same(run(url, (0, 2)), whole)

    internals.before_puts(monkeypatch, overtake)
    storage = archives.open_storage(url)
    slow = run(url, (0, 2))
    assert_same(slow, whole)
    assert _root.Root(storage, _root.read_root(storage)).state(0).progress["complete"]


STATES_OF_NOTHING = {  # progress and arrays of a state whose digest is right
    "no table": (None, {}),
    "a word": ({"commits": 1, "entries": "x", "steps": 1, "complete": False}, {}),
    "half an entry": ({"commits": 1, "entries": 1.5, "steps": 1, "complete": False}, {}),
    "no carry": ({"commits": 1, "entries": 1, "steps": 0, "complete": False}, {}),
    "complete too early": ({"commits": 0, "entries": 3, "steps": 10, "complete": True}, {}),
    "fewer than none": ({"commits": 0, "entries": -3, "steps": 10, "complete": True}, {}),
}


@pytest.mark.parametrize("case", STATES_OF_NOTHING)
def test_a_crafted_state_is_named_and_not_used(tmp_path, monkeypatch, case):
    internals.refuse_to_integrate(monkeypatch, Crash)
    path = tmp_path / "run.zarr"
    with pytest.raises(Crash):
        run(path, (0, 2))
    storage = archives.open_storage(path)
    root = _root.Root(storage, _root.read_root(storage))
    storage.put("parts/0/state", _root.PartState(*STATES_OF_NOTHING[case]).encode(root.place(0)))
    with pytest.raises(ValueError, match=r"part 0 of .* is damaged and cannot be resumed: its state is no state"):
        run(path, (0, 2))
    assert "part 0 (members 0 … 20) is damaged: its state is no state" in opened(path)[1]


@pytest.mark.parametrize("text", ["[]", '{"attributes": {"progress": 1, "format": 8}}', "[" * 200_000, "{"])
def test_a_crafted_root_is_named_before_a_part_is_resumed(place, text):
    archives.open_storage(place).put("zarr.json", text.encode())
    with pytest.raises(ValueError, match=r"run\.zarr") as error:
        run(place, (0, 2))
    assert "\n" not in str(error.value)


def test_two_processes_do_not_write_one_part_of_a_folder(tmp_path):
    run(tmp_path / "run.zarr", (0, 2))
    with (
        _disk.Disk(tmp_path / "run.zarr").lock("parts/0"),
        pytest.raises(BlockingIOError, match=r"another run is writing to .*parts.0"),
    ):
        run(tmp_path / "run.zarr", (0, 2))


def test_an_unfinished_file_of_a_killed_part_is_removed_when_the_part_starts_again(tmp_path, monkeypatch):
    """A kill runs no `finally`, so here nothing is removed in the first process."""

    def crash(_):
        raise Crash

    (tmp_path / "q/c/10").mkdir(parents=True)
    storage, killed_part = _disk.Disk(tmp_path), _disk.Disk(tmp_path)
    with monkeypatch.context() as patched, contextlib.suppress(Crash), killed_part.lock("parts/0"):
        patched.setattr(os, "fsync", crash)
        patched.setattr(Path, "unlink", lambda *_, **__: None)
        killed_part.put("q/c/10/1", b"half of a chunk")
    assert len(list(tmp_path.rglob("*.partial"))) == 1
    with storage.lock("parts/0"):
        assert not list(tmp_path.rglob("*.partial"))


def copied(storage, source, target):
    storage.put(target, storage.read(source))


def altered(storage, name):
    data = storage.read(name)
    storage.put(name, data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :])


DAMAGE = {  # what is done to part 1 of 3 in the store, with another run's; what is said of it
    "a chunk removed": (lambda s, other: removed(s, "q/c/1/1/0"), r"q/c/1/1/0 is missing \(q of time 4 … 7, member 14"),
    "a chunk of another time": (
        lambda s, other: copied(s, "q/c/0/1/0", "q/c/1/1/0"),
        "q/c/1/1/0 is the chunk of another",
    ),
    "a chunk of another run": (
        lambda s, other: s.put("q/c/0/1/0", other.read("q/c/0/1/0")),
        "q/c/0/1/0 is the chunk of",
    ),
    "its state altered": (lambda s, other: altered(s, "parts/1/state"), "its state is altered or cut off"),
    "its state cut": (
        lambda s, other: s.put("parts/1/state", s.read("parts/1/state")[:-7]),
        "its state is altered or cut off",
    ),
    "the state of another part": (
        lambda s, other: copied(s, "parts/0/state", "parts/1/state"),
        "is that of another part",
    ),
    "that of another run": (
        lambda s, other: s.put("parts/1/state", other.read("parts/1/state")),
        "is that of another run: the files were copied from elsewhere",
    ),
    "half a copy": (lambda s, other: [removed(s, f"{x}/c/2/1/0") for x in "qp"], "p/c/2/1/0 is missing"),
}


@pytest.mark.long
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_part_is_named_and_refused_and_the_others_are_read(place, damage, no_loop_after, lieint):
    change, sentence = DAMAGE[damage]
    elsewhere = Path(f"{place}-2.zarr") if isinstance(place, Path) else f"{place}-2.zarr"
    for store, dt in ((place, 0.1), (elsewhere, 0.2)):
        for k in range(3):
            no_loop_after(store, (k, 3), dt)
    storage = archives.open_storage(place)
    change(storage, archives.open_storage(elsewhere))
    described = lieint("info", str(place))
    assert "2 of 3 part(s) complete" in described
    with pytest.raises(AssertionError, match=rf"(?s)part 1 \(members 14 … 27\) is damaged: .*{sentence}"):
        raise AssertionError(described)
    with pytest.raises(ValueError, match=rf"part 1 of .* is damaged.*{sentence}.*[Rr]emove parts/1/state, and"):
        run(place, (1, 3))
    found, warning = opened(place)
    if not storage.is_remote or "state" in sentence:
        assert "part 1" in warning
        assert np.isnan(found.state.q[:, 14:28]).all()
    assert np.isfinite(found.state.q[:, :14]).all()
    removed(storage, "parts/1/state")
    run(place, (1, 3))
    assert_same(li.open(place), run())


@pytest.fixture(scope="module")
def complete_stores():
    return {}


@pytest.fixture
def no_loop_after(complete_stores, tmp_path):
    """Run a part, or copy the files that such a run has written before."""

    def make(store, part, dt):
        key, storage = (str(store).startswith("memory"), part, dt), archives.open_storage(store)
        if key not in complete_stores:
            before = set(storage.sizes())
            run(store, part, dt=dt)
            complete_stores[key] = {name: storage.read(name) for name in set(storage.sizes()) - before}
        for name, data in complete_stores[key].items():
            storage.put(name, data)

    return make


@pytest.mark.long
def test_an_altered_chunk_is_named_on_a_disk_and_an_error_when_it_is_read_from_a_bucket(place):
    for k in range(2):
        run(place, (k, 2))
    storage = archives.open_storage(place)
    altered(storage, "q/c/1/1/0")
    found, warning = opened(place)
    if storage.is_remote:
        with pytest.raises((ValueError, RuntimeError), match=r"(?i)checksum"):
            found.state.q[5, 25]
    else:
        assert "part 1 (members 21 … 40) is damaged: q/c/1/1/0 is altered" in warning


@needs_obstore
def test_a_published_chunk_that_is_missing_in_a_bucket_is_an_error_and_not_nan(tmp_path):
    url = f"memory://tests{tmp_path}/run.zarr"
    run(url, (1, 2))
    removed(archives.open_storage(url), "q/c/1/1/0")
    q = opened(url)[0].state.q
    assert np.isnan(q[:, :20]).all()  # of a part that is not there
    assert np.isfinite(q[:4]).any(axis=(0, 2)).sum() == 20
    with pytest.raises(ValueError, match=r"run\.zarr is damaged: q/c/1/1/0 is missing"):
        q[5, 25]


@pytest.mark.long
def test_a_part_of_another_run_is_refused_before_it_integrates(place, monkeypatch):
    run(place, (0, 2))
    storage = archives.open_storage(place)
    before = {name: storage.read(name) for name in storage.sizes()}
    for part, options, message in (
        ((1, 2), dict(dt=0.2), "dt is 0.1 in the store and 0.2 here"),
        ((1, 2), dict(states=jax.tree.map(lambda x: x[:40], STATES)), "members is 41 in the store and 40 here"),
        ((1, 3), {}, r"is written in 2 part\(s\), not in 3"),
        (None, {}, r"exists and is not overwritten"),
        (None, dict(resume=True), r"written in 2 part\(s\)"),
    ):
        with pytest.raises(ValueError, match=message):
            run(place, part, **options)
    internals.another_version(monkeypatch, lieint_jax="9.9")
    with pytest.raises(ValueError, match=r"versions\.lieint_jax is .* in the store and '9.9' here"):
        run(place, (1, 2))
    assert before == {name: storage.read(name) for name in storage.sizes()}


def test_an_ordinary_store_is_not_written_in_parts_and_the_only_part_is_ordinary(tmp_path):
    run(tmp_path / "run.zarr", (0, 1))
    progress = json.loads((tmp_path / "run.zarr/zarr.json").read_text())["attributes"]["progress"]
    assert (progress["complete"], progress["entries"]) == (True, 13)
    run(tmp_path / "run.zarr", (0, 1))
    with pytest.raises(ValueError, match="was not written in parts; choose another store"):
        run(tmp_path / "run.zarr", (0, 2))


def test_the_part_of_a_task_follows_the_variables_of_its_scheduler():
    def part(count=None, **variables):
        return li.part_of_task(count, variables)

    slurm = dict(SLURM_ARRAY_TASK_MIN="5", SLURM_ARRAY_TASK_COUNT="4", SLURM_ARRAY_TASK_STEP="2")
    assert part(SLURM_ARRAY_TASK_ID="9", **slurm) == (2, 4)
    assert part(AWS_BATCH_JOB_ARRAY_INDEX="0", AWS_BATCH_JOB_ARRAY_SIZE="7") == (0, 7)
    assert part(JOB_COMPLETION_INDEX="3", count=8) == (3, 8)
    assert part(SGE_TASK_ID="3", SGE_TASK_FIRST="1", SGE_TASK_LAST="9", SGE_TASK_STEPSIZE="2") == (1, 5)
    assert part(LSB_JOBINDEX="4", LSB_JOBINDEX_END="4") == (3, 4)
    assert part(PARALLEL_SEQ="1", count=2) == (0, 2)
    assert part(SGE_TASK_ID="undefined", BATCH_TASK_INDEX="1", BATCH_TASK_COUNT="2") == (1, 2)
    with pytest.raises(ValueError, match="Kubernetes does not report the number of tasks"):
        part(JOB_COMPLETION_INDEX="3")
    with pytest.raises(ValueError, match="there is no array of tasks: none of SLURM_ARRAY_TASK_ID, "):
        part()
    for bad in ((8, 8), (-1, 8), (0.5, 2), 3, "x", (0, 0)):
        with pytest.raises(ValueError, match=r"part must be \(k, n\)"):
            run(part=bad)


@pytest.mark.long
def test_tasks_of_an_array_are_one_run(tmp_path, monkeypatch, lieint):
    """The second is started twice, as one that its scheduler has put back into the queue."""
    for name, value in (("MIN", "3"), ("COUNT", "2")):
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", value)
    for task, complete in (("4", 1), ("4", 1), ("3", 2)):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", task)
        run(tmp_path / "run.zarr", "auto")
        assert f"{complete} of 2 part(s) complete" in lieint("info", "run.zarr")
    assert_same(li.open(tmp_path / "run.zarr"), run())
    assert "41 of 41 members converged at every step" in lieint("info", "run.zarr")


@needs_obstore
def test_a_script_writes_to_a_url(tmp_path, lieint):
    """Its option is a path, in which pathlib has made one slash of two."""
    url = f"memory://tests{tmp_path}/run.zarr"
    lieint("run", scripts.written("to_url.py"), "--members", "3", "--steps", "200", "--out", url)
    assert li.open(url).state.q.shape == (3, 3, 4)
    assert_same(li.open(Path(url)), li.open(url))
    assert run(Path(f"memory://tests{tmp_path}/other.zarr")).facts.source == f"memory://tests{tmp_path}/other.zarr"
    error = lieint.refuse("run", "to_url.py", "--out", f"s3://{KEY}:{SECRET}@bucket/run.zarr")
    assert "may not contain credentials" in error
    assert SECRET not in error
    assert [x.name for x in tmp_path.iterdir() if x.suffix != ".py" and x.name != "__pycache__"] == []


def part_process(case, place, k, count, environment=None):
    command = [sys.executable, killed.__file__, case, str(place), "0.01", str(k), str(count)]
    output = dict(stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    return subprocess.Popen(command, env=os.environ | (environment or {}), **output)


def kill_parts(case, place, environment, count=8, kills=10):
    """Start parts in random order, end two at a time at random moments, until all are complete; the number of kills.

    The moments are earlier where this machine is so fast that a part has ended by itself.
    """
    rng, unfinished, ended, latest = np.random.default_rng(5), set(range(count)), 0, 7.0
    while unfinished:
        chosen = rng.choice(sorted(unfinished), min(2, len(unfinished)), replace=False).tolist()
        running = {k: part_process(case, place, k, count, environment) for k in chosen}
        if ended < kills:
            time.sleep(rng.uniform(0.3 * latest, latest))
            for process in running.values():
                alive = process.poll() is None
                ended, latest = ended + alive, latest if alive else 0.8 * latest
                process.send_signal(signal.SIGKILL)
        for k, process in running.items():
            error = process.communicate(timeout=300)[1].decode()
            assert process.returncode in (0, -signal.SIGKILL), error
            unfinished -= {k} if process.returncode == 0 else set()
    return ended


OWN = {f"__main__.{function.__name__}": function for function in (killed.tilted, killed.axis, killed.slowness)}


def whole_of(case):
    make, steps = killed.CASES[case]
    step, states, options = make(steps)
    return li.run(step, states, progress=False, **options)


@pytest.mark.long
@pytest.mark.parametrize("case", ["driven", "own_time"])
def test_eight_parts_killed_at_random_moments_are_one_process_on_a_disk(tmp_path, case):
    assert kill_parts(case, tmp_path / "run.zarr", {}) >= 6
    assert_same(li.open(tmp_path / "run.zarr", OWN), whole_of(case))
    assert not list((tmp_path / "run.zarr").rglob("*.partial"))


@pytest.fixture(scope="module")
def s3(tmp_path_factory):
    """The port of an S3 server on this machine."""
    port = tmp_path_factory.mktemp("s3") / "port"
    server = subprocess.Popen([sys.executable, faults.__file__, str(port)], stderr=subprocess.DEVNULL)
    limit = time.monotonic() + 60
    while not port.exists():
        assert time.monotonic() < limit
        assert server.poll() is None
        time.sleep(0.05)
    yield int(port.read_text())
    server.kill()
    server.wait()


@pytest.fixture
def proxy(s3, monkeypatch):
    """A proxy before the server, without faults at first; the environment has its address and the credentials."""
    internals.commit_every(monkeypatch, 4, in_bucket=7)
    with faults.Proxy(s3, 0.0) as proxy:
        for name, value in environment_of(proxy).items():
            monkeypatch.setenv(name, value)
        connection = faults.http.client.HTTPConnection("127.0.0.1", s3)
        connection.request("PUT", "/bucket")
        assert connection.getresponse().status in (200, 409)
        connection.close()
        yield proxy
        proxy.shutdown()


def environment_of(proxy):
    names = dict(
        AWS_ACCESS_KEY_ID=KEY, AWS_SECRET_ACCESS_KEY=SECRET, AWS_REGION="us-east-1", AWS_ENDPOINT_URL=proxy.url
    )
    return {**names, "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.mark.long
@needs_moto
def test_a_run_on_s3_is_that_in_memory_and_holds_no_credentials(proxy, capsys):
    url = "s3://bucket/plain/run.zarr"
    for k in (1, 0):
        run(url, (k, 2))
    assert_same(li.open(url), run())
    assert cli.main(["info", url]) == 0
    shown = "".join(capsys.readouterr())
    storage = archives.open_storage(url)
    for secret in (SECRET, KEY):
        assert secret not in shown
        assert not any(secret.encode() in storage.read(name) for name in storage.sizes())


@pytest.mark.filterwarnings("ignore:.* is incomplete")  # opened by threads that write
@needs_moto
@pytest.mark.long
def test_a_store_on_s3_that_is_opened_while_it_is_created_is_not_called_damaged(proxy, monkeypatch):
    check_that_creation_is_no_damage("s3://bucket/young/run.zarr", monkeypatch, 7)


@needs_moto
@pytest.mark.long
def test_xarray_reads_it_lazily_by_its_url(proxy):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("s3fs")
    url, memory = "s3://bucket/lazy/run.zarr", run()
    run(url, (1, 2))
    with xarray.open_zarr(url) as data:
        assert data.sizes == {"time": 13, "member": 41, "quaternion": 4, "axis": 3}
        assert list(data.quaternion.values) == list("wxyz")
        before = proxy.requests
        np.testing.assert_array_equal(data.q[4, 30], memory.state.q[4, 30])
        assert proxy.requests - before <= 2  # one chunk
        assert np.isnan(data.q[:, :20]).all()
        np.testing.assert_array_equal(data.time, memory.t)


@needs_moto
@pytest.mark.long
def test_requests_that_fail_are_repeated_and_nothing_is_lost_or_doubled(proxy, monkeypatch):
    """Of requests, 30 % fail, in every way; each file that exists at the end was put as a whole."""
    internals.wait_for_buckets(monkeypatch, first_delay=0.002, timeout=faults.LATE / 2)
    clean, faulty = "s3://bucket/clean/run.zarr", "s3://bucket/faulty/run.zarr"
    whole = run()
    for k in range(2):
        run(clean, (k, 2))
    proxy.rate = 0.3
    for k in (1, 0):
        run(faulty, (k, 2))
    found = li.open(faulty)
    assert_same(found, whole)
    proxy.rate = 0.0
    assert min(proxy.injected.values()) >= 3
    a, b = archives.open_storage(clean), archives.open_storage(faulty)
    assert {name: a.read(name) for name in a.sizes()} == {name: b.read(name) for name in b.sizes()}


@needs_moto
@pytest.mark.long
def test_ten_thousand_faults_lose_nothing(proxy, monkeypatch):
    """Faults that need no waiting; `late` ones are in the test above."""
    internals.wait_for_buckets(monkeypatch, first_delay=0.0005, longest_delay=0.002)
    proxy.kinds = tuple(kind for kind in faults.KINDS if kind != "late")
    whole, n = run(num_steps=600), 0
    while sum(proxy.injected.values()) < 10_000:
        proxy.rate, url, n = 0.8, f"s3://bucket/many/{n}/run.zarr", n + 1
        for k in (1, 0, 2):
            run(url, (k, 3), num_steps=600)
        proxy.rate = 0.0
        assert_same(li.open(url), whole)


@needs_moto
@pytest.mark.long
def test_eight_parts_killed_at_random_moments_are_one_process_on_s3(proxy):
    proxy.rate, proxy.kinds = 0.02, tuple(kind for kind in faults.KINDS if kind != "late")
    url = "s3://bucket/killed/run.zarr"
    assert kill_parts("driven", url, environment_of(proxy)) >= 6
    proxy.rate = 0.0
    assert sum(proxy.injected.values()) > 10
    assert_same(li.open(url, OWN), whole_of("driven"))


@pytest.mark.long
@needs_moto
def test_a_storage_that_stays_away_ends_the_run_with_a_sentence_without_credentials(proxy, monkeypatch, capsys):
    internals.wait_for_buckets(monkeypatch, first_delay=0.01, first_patience=0.01, patience=0.01)
    url = "s3://bucket/away/run.zarr"

    def vanish(name):
        if name.startswith("q/c/1"):  # of the second commit
            proxy.rate, proxy.kinds = 1.0, ("throttled",)

    with monkeypatch.context() as patch:
        internals.before_puts(patch, vanish)
        with pytest.raises(
            OSError, match=r"cannot be reached: .*429.* holds everything up to step \d+; fix .* resume"
        ) as error:
            run(url, (0, 2))
    proxy.rate = 0.0
    for bad, message in (("s3://nowhere/run.zarr", "no such bucket|no object"), (url, "exists and is not overwritten")):
        with pytest.raises((OSError, ValueError), match=message) as other:
            run(bad)
        assert SECRET not in str(other.value)
    assert SECRET not in str(error.value) + repr(error.value.__cause__)
    monkeypatch.setenv("SOME_TOKEN", "Too Many")
    assert "Too Many" not in _bucket.message(ValueError("429 Too Many Requests at http://x/?sig=1234 now"))
    assert "1234" not in _bucket.message(ValueError("429 Too Many Requests at http://x/?sig=1234 now"))
    run(url, (0, 2))
    run(url, (1, 2))
    assert_same(li.open(url), run())


def test_urls_that_are_no_place_of_a_store_are_refused(tmp_path):
    for url, message in (
        ("ftp://x/run.zarr", "a store is a path or a URL of s3, gs, az, memory; got one of 'ftp'"),
        ("s3://run.zarr", r"is s3://BUCKET/NAME.zarr, got s3://run\.zarr"),
        ("s3://bucket/run.npz", r"is s3://BUCKET/NAME.zarr"),
        (f"s3://{KEY}:{SECRET}@bucket/run.zarr", "may not contain credentials"),
        (f"az://bucket/run.zarr?sig={SECRET}", "may not contain credentials"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            run(url)
        assert SECRET not in str(error.value)


def test_storages_replace_and_create_files_as_a_whole(place):
    storage, first = archives.open_storage(place), {"root": b"first", "a/b": b"file"}
    assert not storage.has_store()
    assert storage.create_store("root", first)
    assert storage.create_store("root", {"root": b"second"}) is False
    assert storage.read("root") == b"first"
    assert storage.create_store("root", first) is storage.is_remote  # whose answer may have been lost
    storage.stage("a/b", b"second")
    storage.settle()
    storage.put("a/b", b"third")
    storage.put("a/c/d", b"")
    assert (storage.read("a/b"), storage.tail("a/b")) == (b"third", b"hird")
    assert storage.sizes() == {"root": 5, "a/b": 5, "a/c/d": 0}
    assert storage.sizes("a/c") == {"a/c/d": 0}
    for name in ("x", "a/b/c"):
        with pytest.raises(FileNotFoundError):
            storage.read(name)
    if not storage.is_remote:
        assert not list(Path(place).rglob("*.partial"))
        shutil.rmtree(place)
