"""Runs in parts as tasks of an executor: the bits of one run, whatever becomes of the tasks."""

import math
import os
import re
import signal
import threading
import time
from concurrent.futures import BrokenExecutor, CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import internals
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stores import assert_same

import lieint_jax as li
from lieint_jax.runs import LostWorkerError, PermanentError
from lieint_jax.runs import store as archives

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
STATES = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.array(np.random.default_rng(7).normal(size=(12, 3))))
OPTIONS = dict(dt=0.1, num_steps=60, save_every=5, progress=False)
velocity = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))


def made(numbers):
    return velocity(jnp.sin(jnp.asarray(numbers)[:, None] + jnp.arange(3.0)))


class Engine:
    """Starts each task in this thread, and again up to `retries` times if it raises; `calls` are the parts so far."""

    def __init__(self, retries=0, lost=()):
        self.retries, self.lost, self.calls = retries, list(lost), []

    def submit(self, task, k, parts):
        future = Future()
        for left in range(self.retries, -1, -1):
            self.calls.append(k)
            try:
                if k in self.lost:
                    self.lost.remove(k)
                    raise ConnectionError("the worker is gone\nwith a trace")
                future.set_result(task(k, parts))
                return future
            except OSError as error:
                if not left:
                    future.set_exception(error)
        return future


def submit(store, executor, parts=3, step=STEP, states=STATES, **options):
    return li.submit(step, states, store=store, parts=parts, executor=executor, **OPTIONS | options)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_parts_in_threads_are_one_run_and_the_same_call_again_computes_nothing(tmp_path):
    whole = li.run(STEP, STATES, **OPTIONS)
    with ThreadPoolExecutor(2) as pool:
        found = submit(tmp_path / "run.zarr", pool)
        before = contents(tmp_path)
        submit(tmp_path / "run.zarr", pool)
    assert_same((found.state, found.info), (whole.state, whole.info))
    assert (found.members, found.dt, found.step) == (12, 0.1, STEP)
    assert contents(tmp_path) == before


def test_a_worker_compiles_for_its_first_part_only_and_failures_are_reported(tmp_path, monkeypatch):
    """At this dt the step of one member has no solution."""
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [0.0, 0.0, 1.0])
    states = jax.vmap(lambda w: top.state(angular_velocity=w))(STATES.p)
    step, traced, counts = li.schemes.top_energy_momentum(top), [], []
    advance = type(step).advance
    monkeypatch.setattr(type(step), "advance", lambda *given: traced.append(1) or advance(*given))

    class Counting(Engine):
        def submit(self, *task):
            future = super().submit(*task)
            counts.append(len(traced))
            return future

    with pytest.warns(RuntimeWarning) as caught:
        found = submit(tmp_path / "run.zarr", Counting(), 4, step, states)
    assert str(caught[-1].message).startswith("1 of 12 members did not converge at every step: member 6 at step 3")
    assert np.flatnonzero(~found.converged).tolist() == [6]
    assert counts == counts[:1] * 4
    assert counts[0] > 0


def test_an_error_that_stays_is_not_repeated_and_ends_the_run(tmp_path):
    engine = Engine(retries=5)
    with pytest.raises(PermanentError, match=r"part 0 of 3: the first step fails for 4 member\(s\): 0, 1, 2, 3"):
        submit(tmp_path / "run.zarr", engine, dt=100.0)
    assert engine.calls == [0, 1, 2]
    for mistake, name in ((lambda n: n.lost, "AttributeError"), (lambda n: __import__("gone"), "ModuleNotFoundError")):
        with pytest.raises(PermanentError, match=f"part 0 of 3: {name}: .*(lost|gone)"):
            submit(tmp_path / "mistake.zarr", Engine(), states=mistake, members=12)
    for arguments, message in ((dict(parts=13), "at most 12 part"), (dict(save_every=7), "multiple of save_every")):
        with pytest.raises(PermanentError, match=message):
            submit(tmp_path / "other.zarr", Engine(), **arguments)


def test_arguments_that_no_part_can_have_are_refused_before_a_task_is_made(tmp_path):
    engine = Engine()
    for options, error, message in (
        (dict(part=(0, 2)), ValueError, "part is not for a run in parts"),
        (dict(store=None), ValueError, "the parts of a run need a store"),
        (dict(parts=0), ValueError, "parts must be an integer ≥ 1"),
        (dict(save_evry=5), TypeError, "save_evry"),
        (dict(executor=None), TypeError, "executor must have the method submit, such as .* got None"),
        (dict(executor=ThreadPoolExecutor), TypeError, "executor must have the method submit"),
    ):
        with pytest.raises(error, match=message):
            submit(**dict(store=tmp_path / "run.zarr", executor=engine) | options)
    assert engine.calls == []


def test_the_progress_bar_counts_parts(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    submit(tmp_path / "run.zarr", Engine(), progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "/3.00" in err
    assert "parts/s" in err


def test_lost_workers_are_replaced_by_the_engine_or_named_and_the_same_call_computes_the_rest(tmp_path):
    whole = li.run(STEP, made, members=12, **OPTIONS)
    engine = Engine(retries=1, lost=[1, 2, 2])
    options = dict(states=made, members=12)
    with pytest.raises(LostWorkerError, match=r"1 of 3 .* Part 2: ConnectionError: the worker is gone\. What"):
        submit(tmp_path / "run.zarr", engine, **options)
    assert engine.calls == [0, 1, 1, 2, 2]
    assert_same(submit(tmp_path / "run.zarr", Engine(), **options).state, whole.state)


def test_a_pool_that_breaks_while_parts_are_submitted_is_a_lost_worker_and_other_errors_cancel_them(tmp_path):
    class Breaking(Engine):
        def submit(self, task, k, parts):
            if k == 1:
                raise BrokenExecutor("a worker was killed")
            return super().submit(task, k, parts)

    with pytest.raises(LostWorkerError, match=r"1 of 3 .* Part 1: BrokenExecutor: a worker"):
        submit(tmp_path / "run.zarr", Breaking())
    begun = []
    assert_same(submit(tmp_path / "run.zarr", Engine()).state, li.run(STEP, STATES, **OPTIONS).state)
    full = SimpleNamespace(submit=lambda task, k, parts: begun.append(Future()) or begun[k] if k == 0 else 1 / 0)
    with pytest.raises(ZeroDivisionError):
        submit(tmp_path / "other.zarr", full)
    with pytest.raises(CancelledError):
        begun[0].result(0)


def test_an_interrupt_states_what_is_complete_and_the_same_call_computes_the_rest(tmp_path):
    class Interrupted(Engine):  # as by Ctrl-C while the second part runs
        def submit(self, task, k, parts):
            if k != 1:
                return super().submit(task, k, parts)
            looks = iter([lambda: False, lambda: signal.raise_signal(signal.SIGINT)])
            return SimpleNamespace(done=lambda: next(looks)(), cancel=lambda: None)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # other libraries leave handlers of their own
    try:
        with pytest.raises(KeyboardInterrupt, match="stopped after 2 of 3 parts; what is in the store is kept"):
            submit(tmp_path / "run.zarr", Interrupted())
    finally:
        signal.signal(signal.SIGINT, before)
    assert_same(submit(tmp_path / "run.zarr", Engine()).state, li.run(STEP, STATES, **OPTIONS).state)


def test_a_part_that_another_process_writes_may_be_repeated(tmp_path):
    submit(tmp_path / "run.zarr", Engine())
    lock = archives.open_storage(tmp_path / "run.zarr").lock("parts/1")
    with lock, pytest.raises(LostWorkerError, match="Part 1: BlockingIOError: another run is writing"):
        submit(tmp_path / "run.zarr", Engine())


@pytest.mark.parametrize("version", [1, 2])
def test_cores_are_those_of_the_quota(tmp_path, monkeypatch, version):
    for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    top, own = tmp_path / "groups", tmp_path / "own"
    (cpu := top if version == 2 else top / "cpu").joinpath("pods/mine").mkdir(parents=True)
    own.write_text("0::/pods/mine\n" if version == 2 else "5:memory:/x\n4:cpuacct,cpu:/pods/mine\n")
    internals.control_groups(monkeypatch, top, own)
    assert li.count_cores() == 64  # no limit

    def limit(place, cores):
        internals.forget_quotas()
        files = {"cpu.max": f"{cores}00000 100000" if cores else "max 100000"}
        if version == 1:
            files = {"cpu.cfs_quota_us": f"{cores}00000" if cores else "-1", "cpu.cfs_period_us": "100000"}
        for name, text in files.items():
            (cpu / place / name).write_text(text.replace("0.500000", "50000"))

    limit("pods/mine", None)
    assert li.count_cores() == 64
    limit("pods", 6)  # around it
    assert li.count_cores() == 6
    limit("pods/mine", 0.5)
    assert li.count_cores() == 1
    internals.control_groups(monkeypatch, top, tmp_path / "nothing")
    internals.forget_quotas()
    assert li.count_cores() == 64
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4")
    assert li.count_cores() == 4
    monkeypatch.setenv("OMP_NUM_THREADS", "3,2")
    assert li.count_cores() == 3


def test_parts_of_another_machine_are_accepted_if_asked_for_and_recorded(tmp_path, monkeypatch, lieint):
    path = tmp_path / "run.zarr"
    whole = li.run(STEP, STATES, **OPTIONS)
    options = dict(store=path, **OPTIONS)
    li.run(STEP, STATES, part=(0, 2), **options)
    assert "part 0 on" not in lieint("info", path)
    internals.another_machine(monkeypatch, "another processor", "9.9.1")
    refused = r"another machine.*jaxlib is .* and '9\.9\.1' here; device is .* and 'another processor' here\."
    with pytest.raises(ValueError, match=refused):
        li.run(STEP, STATES, part=(1, 2), **options)
    with pytest.raises(ValueError, match=r"holds another run.*: versions.jaxlib is .*; device is .*; dt is 0.1"):
        li.run(STEP, STATES, part=(1, 2), same_bits=False, **options | {"dt": 0.2})
    found = submit(path, Engine(), 2, same_bits=False)
    assert_same(found.state, whole.state)
    text = lieint("info", path)
    assert re.search(r"part 1 on another processor, native, jax .*, jaxlib 9\.9\.1", text)
    assert re.search(r"part 0 on \S.*, native, jax ", text)


def kill_one(store, pids):
    """Kill the first of some processes half a second after the first part has begun."""

    def kill():
        while not list(Path(store).glob("parts/*")):
            time.sleep(0.02)
        time.sleep(0.5)
        os.kill(pids()[0], signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


LONG = dict(states=made, members=64, num_steps=4_000_000, save_every=400_000, parts=8)


def whole_of_long():
    options = {key: value for key, value in LONG.items() if key not in ("states", "parts")}
    return li.run(STEP, made, 0.1, progress=False, **options)


@pytest.mark.long
def test_a_worker_of_dask_is_killed(tmp_path):
    """Dask starts its part again on another one."""
    distributed = pytest.importorskip("distributed")
    path = tmp_path / "run.zarr"
    local = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with local as cluster, distributed.Client(cluster) as client:
        before = [worker.pid for worker in cluster.workers.values()]
        killing = kill_one(path, lambda: before)
        found = submit(path, client.get_executor(), **LONG)
        killing.join()
        assert [worker.pid for worker in cluster.workers.values()] != before
        with pytest.raises(PermanentError, match=r"dt is 0\.1 in the store and 0.2 here"):
            submit(path, client.get_executor(retries=5), **LONG | {"dt": 0.2})
    assert_same(found.state, whole_of_long().state)


@pytest.mark.long
def test_a_worker_of_loky_is_killed(tmp_path):
    """Then loky gives up all tasks, and the same call with new workers computes the rest."""
    loky = pytest.importorskip("loky")
    path = tmp_path / "run.zarr"
    pool = loky.get_reusable_executor(max_workers=2)
    pool.submit(int).result()
    killing = kill_one(path, lambda: list(pool._processes))
    with pytest.raises(LostWorkerError, match="TerminatedWorkerError"):
        submit(path, pool, **LONG)
    killing.join()
    pool = loky.get_reusable_executor(max_workers=2)
    assert_same(submit(path, pool, **LONG).state, whole_of_long().state)
    pool.shutdown()


def test_a_file_waits_for_the_disk_once_and_a_folder_once_a_commit(tmp_path, monkeypatch):
    internals.commit_every(monkeypatch, 4)
    waits, sync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda d: waits.append(os.readlink(f"/proc/self/fd/{d}")) or sync(d))
    li.run(STEP, STATES, store=tmp_path / "run.zarr", **OPTIONS)
    commits = math.ceil(13 / 4)
    times = {name: waits.count(name) for name in waits}
    assert all(times[name] == 1 for name in times if name.endswith(".partial"))  # a file, before it has its name
    root = str(tmp_path / "run.zarr")
    assert times.pop(root) <= 2 * commits + 1  # of the arrays' files, and of its own
    assert max(times.values()) <= commits
