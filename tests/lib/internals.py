"""What tests change inside the package to see it at work on small runs: the one file with these private names.

Each change is made by pytest's `monkeypatch`, which undoes it.
"""

import contextlib
import dataclasses
import json
import signal
from types import SimpleNamespace

import numpy as np

import lieint_jax as li
from lieint_jax import _checks
from lieint_jax._xla import compiled
from lieint_jax.core import tangent
from lieint_jax.native import _kernel, _machine, _march_code, _traced
from lieint_jax.runs import _devices, _engine, _execute, _facts, _made_states, _plan, _run
from lieint_jax.runs._split import Split
from lieint_jax.runs._storage import bucket as _bucket
from lieint_jax.runs._storage import disk as _disk
from lieint_jax.runs.store import _identity, _root, _store_output, _writer

_DIFFERENCE = _engine.Engine._difference


def by_engine(monkeypatch, name, plans=None):
    """Let the engine of this name compute all runs; their plans are appended to `plans`."""

    def engine_of(plan):
        if plans is not None:
            plans.append(plan)
        return _engine.Engine(plan, name)

    monkeypatch.setattr(_execute, "engine_of", engine_of)


def runs_by(monkeypatch, engines, *arguments, **options):
    """The saves or the summary of `li.run` by each of the engines."""
    found = []
    for name in engines:
        by_engine(monkeypatch, name)
        run = li.run(*arguments, progress=False, **options)
        found.append(run.summary if run.trajectory is None else run.trajectory)
    return found


def engine_on(platform, plan):
    """The name of the engine that computes a plan on a platform, "cpu" or "gpu"."""
    mesh = SimpleNamespace(devices=np.array([SimpleNamespace(platform=platform)]))
    return _engine.engine_of(dataclasses.replace(plan, mesh=mesh)).name


def refusal(name, plan):
    """Why an engine cannot compute a plan."""
    return _engine.Engine(plan, name).refusal


def spread_over_devices(monkeypatch):
    """Let a process spread its members over its devices, as over accelerators."""
    monkeypatch.setattr(_devices, "on_cpu", lambda _: False)


def forget_loops():
    """Let the package forget the code of loops; what JAX has compiled holds its own."""
    _traced._cache.clear()


def live_kernels():
    """The number of kernels in memory, when those that nothing holds are freed, as before another one is made."""
    _machine._free_unused(_machine._registry())
    return len(_machine._engines)


def largest_at_once(monkeypatch, dim):
    """Let derivatives in more dimensions than this be computed column by column."""
    monkeypatch.setattr(tangent, "_LARGE", dim)


def always_map(monkeypatch):
    """Let programs of all lengths have maps over long axes."""
    monkeypatch.setattr(_traced, "_cache", {})
    monkeypatch.setattr(_traced, "_UNROLLED", 0)


def limit_kernels(monkeypatch, most):
    """Let steps of more than so many operations be too long for a kernel."""
    monkeypatch.setattr(_traced, "_cache", {})  # of what is known of loops
    monkeypatch.setattr(_kernel, "_LONGEST", most)


def compare_machine_code(compares):
    """Whether the first step of machine code is compared with XLA from now on."""
    _engine.Engine._difference = _DIFFERENCE if compares else lambda *_: ""


def forget_fallbacks():
    """Let the log name again why XLA runs a loop in place of machine code."""
    _march_code.warn_once.cache_clear()


def share_short_calls(monkeypatch):
    """Let short calls of machine code run in several threads too."""
    monkeypatch.setattr(_march_code, "_SHORT", 0)


def commit_every(monkeypatch, rows, in_bucket=None):
    """Let runs commit after every `rows` saves, on disks and in buckets, so that a short run has many commits."""
    monkeypatch.setattr(_plan.Plan, "buffer_rows", lambda self, across: (self.is_remote and in_bucket) or rows)


def make_states_of(monkeypatch, members):
    """Let functions of states be called for so many members at once."""
    monkeypatch.setattr(_made_states, "BLOCK", members)


def small_chunks(monkeypatch, members, joined):
    """Let chunks of a store have so many members, and so many of them be joined along time at once."""
    monkeypatch.setattr(_plan, "CHUNK_MEMBERS", members)
    monkeypatch.setattr(_store_output, "SLAB", joined)


def members_of_parts(members, count, most=8192):
    """The members of each of `count` parts of a run, and of how many a chunk is, at most `most`."""
    split = Split.into_parts(members, count, most)
    return [split.part(k) for k in range(count)], split.chunk


def compiled_once(function):
    """A function compiled quickly, for calls that are shorter than their compilation; few programs are kept."""
    return compiled(function, once=True)


def memory_of(monkeypatch, size):
    """Let this machine have so many bytes of memory."""
    monkeypatch.setattr(_checks, "memory_of_machine", lambda: size)


def refuse_to_integrate(monkeypatch, error):
    """Let each run end by `error` where it would begin to integrate."""

    def refuse(*_):
        raise error

    monkeypatch.setattr(_engine.Engine, "start", refuse)


def interrupt_after_the_first_call(monkeypatch):
    """Let a run be interrupted as if by Ctrl-C."""
    monkeypatch.setattr(_execute, "_interrupts", lambda _: contextlib.nullcontext([signal.SIGINT]))


def another_machine(monkeypatch, device, jaxlib):
    """Let runs be on another kind of processor and by another jaxlib."""
    monkeypatch.setattr(_identity, "device", lambda: device)
    monkeypatch.setattr(_facts, "_version", lambda _: jaxlib)


def control_groups(monkeypatch, top, own):
    """Let `top` be the folder of the control groups, and `own` the file of those of this process."""
    monkeypatch.setattr(_checks, "_GROUPS", top)
    monkeypatch.setattr(_checks, "_OWN_GROUPS", own)


def forget_quotas():
    """Let the CPU quotas of this process be read again."""
    _devices._quotas.cache_clear()


def another_version(monkeypatch, **versions):
    """Let stores be written by other versions of packages."""
    known = _facts.package_versions()
    monkeypatch.setattr(_identity, "package_versions", lambda: known | versions)


def after_commits(monkeypatch, action):
    """Call action(path, steps) after each commit of a run of so many steps so far to the store at `path`."""
    publish = _writer.Writer.publish

    def published(self, *arguments):
        publish(self, *arguments)
        action(self.path, self.progress["steps"])

    monkeypatch.setattr(_writer.Writer, "publish", published)


def after_roots_are_read(monkeypatch, action):
    """Call action() after the root of a store is read, before its state is."""
    state = _root.Root.state
    monkeypatch.setattr(_root.Root, "state", lambda self, k: (action(), state(self, k))[1])


def before_new_stores(monkeypatch, action):
    """Call action() between the check that there is no store yet and the creation of a new one."""
    create = _disk.Disk.create_store
    monkeypatch.setattr(_disk.Disk, "create_store", lambda *arguments: (action(), create(*arguments))[1])


def before_puts(monkeypatch, action):
    """Call action(name) before a file of a store is written, on a disk or in a bucket."""
    for kind in (_disk.Disk, _bucket.Bucket):

        def stage(self, name, data, stage=kind.stage):
            action(name)
            stage(self, name, data)

        monkeypatch.setattr(kind, "stage", stage)


def wait_for_buckets(monkeypatch, **seconds):
    """Set the `first_delay` and the `longest_delay` between requests, the `timeout`, and the `patience` with them."""
    for name, value in seconds.items():
        monkeypatch.setattr(_bucket, f"_{name.upper()}", value)


def write_root(file, root):
    """Write the metadata of the root of a store, with their checksum made right."""
    if isinstance(root.get("attributes"), dict):
        root["attributes"]["checksum"] = _root.checksum(root)
    file.write_text(json.dumps(root))


def read_few_rows(monkeypatch, size):
    """Let a run on disk be read in blocks of this number of bytes."""
    monkeypatch.setattr(_run, "_BLOCK", size)
