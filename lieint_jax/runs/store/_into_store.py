"""A run that is written to a store, whole or one of its parts, and the check that it may be resumed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

import jax
from jax.sharding import Mesh

from lieint_jax.runs import _layout
from lieint_jax.runs._dyadic_sum import blocks
from lieint_jax.runs._job import CHUNK_MEMBERS, Job
from lieint_jax.runs._layout import Layout
from lieint_jax.runs.store import _identity, _store
from lieint_jax.runs.store._columns import (
    Axes,
    attributes_of,
    columns_of,
    constant,
    labels,
    series_columns,
)
from lieint_jax.runs.store._description import describe
from lieint_jax.runs.store._integrity import Table
from lieint_jax.runs.store._open_store import check_store
from lieint_jax.runs.store._part_writer import PartWriter, join, skeleton
from lieint_jax.runs.store._parts import PartsRoot, Split, read_root
from lieint_jax.runs.store._reading import Stored, open_complete, read_part
from lieint_jax.runs.store._storage import Storage, open_storage
from lieint_jax.runs.store._store_options import StoreOptions, check_json, checked_path
from lieint_jax.runs.store._store_output import StoreOutput


def run_into_store(
    job: Job,
    engine: str,
    mesh: Mesh,
    options: StoreOptions,
    resume: bool,
    integrate: Callable[[Layout, StoreOutput], object],
) -> Stored:
    """Let `integrate`, by the engine of this name, fill a store from the start or from its last checkpoint."""
    path, leader = checked_path(options.path), jax.process_index() == 0
    check_json(options.attributes)
    described = _identity.description(job, engine, options.attributes.get("scenario"))
    chunk = min(_layout.layout_of(mesh, job.members).each, CHUNK_MEMBERS)
    attributes = attributes_of(job, options, described, chunk, job.buffer_rows(chunk))
    _identity.check_processes(mesh, described, store=path.name, resume=resume)
    exists = bool(_layout.all_reduce_max(mesh, os.path.exists(path))[0])
    _refuse_overwriting(path, exists, resume)
    if not exists:
        _identity.warn_of_no_resume(described)
        _layout.fail_together(mesh, lambda: leader and _create(path, job, options, attributes))
    else:
        _layout.fail_together(mesh, lambda: _refuse_parts(path, check_store(path)))
    with contextlib.ExitStack() as stack:
        writer = _layout.fail_together(
            mesh, lambda: stack.enter_context(contextlib.closing(_store.Writer(path, leader)))
        )
        if exists:
            _layout.fail_together(mesh, lambda: _identity.check_same(path, writer.attributes, described))
        _layout.fail_together(mesh, lambda: leader and _store.clean(path))
        layout = _layout.layout_of(mesh, job.members, writer.attributes["member_chunk"])
        _layout.fail_together(mesh, lambda: _store.check(path))
        if not writer.progress["complete"]:
            integrate(layout, StoreOutput(job, layout, writer))
    return open_complete(path)


def _refuse_overwriting(store: object, exists: bool, resume: bool) -> None:
    if exists and not resume:
        raise ValueError(f"{store} exists and is not overwritten; resume continues it, or choose another store")


def _refuse_parts(path: Path, attributes: Table) -> None:
    if "parts" in attributes:
        count = attributes["parts"]
        raise ValueError(f"{path} is written in {count} part(s): pass part=(k, {count}), or choose another store")


def run_part_into_store(
    job: Job,
    engine: str,
    whole: Job,
    mesh: Mesh,
    options: StoreOptions,
    split: Split,
    k: int,
    resume: bool,
    integrate: Callable[[Layout, StoreOutput], object],
) -> Stored:
    """Let `integrate` fill part k of a store, from its start or its last commit, and return the results of its members.

    The first part to come creates the store; every part checks that the store is that of its own run.

    Args:
        job: that of the part.
        engine: the name of its engine.
        whole: the job of all members.
        mesh: the devices.
        options: the store.
        split: the parts.
        k: which one.
        resume: continue a store that exists.
        integrate: fills an output.
    """
    storage = open_storage(checked_path(options.path))
    check_json(options.attributes)
    described = _identity.description(whole, engine, options.attributes.get("scenario"))
    found = read_root(storage)
    _refuse_overwriting(storage.address, found is not None, resume)
    if found is not None:
        _same_run(storage, found, described, split)  # before anything is written into the store of another run
    files = _skeleton(whole, options, described, split, storage.is_remote)
    with storage.lock(f"parts/{k}"):
        if found is None:
            storage.create(_store.ROOT, files[_store.ROOT])
        root = _same_run(storage, found or read_root(storage), described, split)
        join(storage, root, files)
        layout = _layout.layout_of(mesh, job.members)
        with contextlib.closing(PartWriter(root, k, _identity.digest_of_states(job.initial))) as writer:
            if not writer.progress["complete"]:
                integrate(layout, StoreOutput(job, layout, writer))
    return read_part(root, k)


def _same_run(storage: Storage, found: Table | None, described: Table, split: Split) -> PartsRoot:
    """The root of a store, if it is that of this run in these parts."""
    if found is None:
        raise ValueError(f"{storage.address} was removed while this part started")
    attributes = found["attributes"]
    if "parts" not in attributes:
        raise ValueError(f"{storage.address} was not written in parts; choose another store")
    _identity.check_same(storage.address, attributes, described)
    if attributes["parts"] != split.parts:
        raise ValueError(f"{storage.address} is written in {attributes['parts']} part(s), not in {split.parts}")
    return PartsRoot(storage, found)


def _skeleton(job: Job, options: StoreOptions, described: Table, split: Split, remote: bool) -> dict[str, bytes]:
    """The files that a store in parts begins with; `job` is that of all members."""
    largest = job.restricted(max(map(split.part, range(split.parts)), key=len))
    rows = (largest.bucket_rows if remote else largest.buffer_rows)(split.chunk)
    description, numbers = describe(job.step)
    attributes = attributes_of(job, options, described, split.chunk, rows)
    attributes |= {"format": _store.PARTS_FORMAT, "parts": split.parts}
    attributes |= {"constants": sorted(numbers), "description": description}
    axes = Axes(job, split.chunk, rows)
    columns = columns_of(job, axes, options)
    if job.reduction is not None:
        most = max(len(blocks(part.start, part.stop)) for part in map(split.part, range(split.parts)))
        series = {"part": (split.parts, 1), **axes.times}
        columns |= series_columns(job, axes, series)
        if not job.per_member:
            columns["sums"] = axes.column({**series, "block": (most, most)}, long_name="sums over blocks of members")
    constants = {name: constant(name, x, job) for name, x in numbers.items()} | labels(job)
    constants["time"] = columns.pop("time"), job.times
    return skeleton(columns, attributes, constants)


def _create(path: Path, job: Job, options: StoreOptions, attributes: Table) -> None:
    """Make the store of a run."""
    description, numbers = describe(job.step)
    chunk = attributes["member_chunk"]
    attributes |= {"constants": sorted(numbers), "description": description}
    axes = Axes(job, chunk, attributes["time_chunk"])
    columns = columns_of(job, axes, options)
    constants = {name: constant(name, x, job) for name, x in numbers.items()} | labels(job)
    _store.create(path, columns, attributes, constants)
