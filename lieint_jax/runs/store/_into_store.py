"""A run that is written to a store, whole or one of its parts, and the check that it may be resumed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial

import jax
from jax.sharding import Mesh

from lieint_jax.runs._job import devices
from lieint_jax.runs._job.devices import Layout
from lieint_jax.runs._job.digests import digest_of_states
from lieint_jax.runs._job.engine import Engine
from lieint_jax.runs._job.job import Job
from lieint_jax.runs._job.make_job import split_into_parts
from lieint_jax.runs._job.split import Split
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.leaves import Saves, Table
from lieint_jax.runs._storage.storage import ROOT, Storage, StoreOptions, check_json, checked_path
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._layout import first_files
from lieint_jax.runs.store._reading import read_part
from lieint_jax.runs.store._root import Root, check_store, open_root, written_root
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.runs.store._writer import Writer, join


def run_into_store(
    job: Job,
    engine: Engine,
    options: StoreOptions,
    integrate: Callable[[Layout, StoreOutput], object],
    *,
    whole: Job,
    mesh: Mesh,
    part: tuple[int, int] = (0, 1),
    in_parts: bool = False,
    resume: bool = False,
    same_bits: bool = True,
) -> Saves:
    """Let `integrate` fill a part of a store, from its start or its last commit, and return the results of its members.

    The first part to come creates the store; every part checks that the store is that of its own run.

    Args:
        job: that of the part.
        engine: computes it.
        options: the store.
        integrate: fills an output.
        whole: the job of all members.
        mesh: the devices.
        part: (k, n), part k of n.
        in_parts: whether other parts, or other processes into the same bucket, may write at the same time.
        resume: continue a store that exists.
        same_bits: only where it was begun on a machine of the same kind.
    """
    k, count = part
    storage, leader = open_storage(checked_path(options.path)), jax.process_index() == 0
    split = split_into_parts(whole, count, storage.is_remote)
    check_json(options.attributes)
    described = _identity.description(whole, engine, options.attributes.get("scenario"))
    new_files = partial(first_files, whole, options, described, split, in_parts, storage.is_remote)
    _identity.check_processes(mesh, described, store=storage.address.name, resume=resume)
    together = partial(devices.fail_together, mesh)
    exists = bool(devices.all_reduce_max(mesh, storage.has_store())[0])
    if exists and not resume:
        raise ValueError(
            f"{storage.address.name} exists and is not overwritten; resume continues it, or choose another store"
        )
    if not exists:
        if not in_parts:  # whose other parts must be comparable
            _identity.warn_of_no_resume(described)
        exists = not together(lambda: not leader or _is_created(storage, new_files(), in_parts))
    root = together(lambda: _root_of(storage, described if exists or in_parts else None, split, in_parts, same_bits))
    with contextlib.ExitStack() as stack:
        together(lambda: stack.enter_context(root.storage.lock(root.folder(k), leader)))
        if in_parts:
            join(root, new_files())
        initial, machine = digest_of_states(job.initial), _identity.machine_of(described)
        writer = together(
            lambda: stack.enter_context(contextlib.closing(Writer(root, k, leader, initial, machine, same_bits)))
        )
        layout = devices.layout_of(mesh, job.members, root.split.chunk)
        if not writer.progress["complete"]:
            integrate(layout, StoreOutput(job, layout, writer))
        progress = writer.progress
    return read_part(root, k, progress)


def _is_created(storage: Storage, files: dict[str, bytes], in_parts: bool) -> bool:
    """Create a store; False if another process has created it, which may be that of another part."""
    created = storage.create_store(ROOT, files)
    if not (created or in_parts):
        raise ValueError(f"{storage.address} was created by another run in the meantime, and is not overwritten")
    return created


def _root_of(storage: Storage, described: Table | None, split: Split, in_parts: bool, same_bits: bool) -> Root:
    """The root of a store, if it is that of the run described and in these parts; None: this run has just made it."""
    if described is None:
        return written_root(storage)
    found = (open_root if in_parts else check_store)(storage.address)
    count = found.split.parts
    if found.in_parts and not in_parts:
        raise ValueError(
            f"{storage.address} is written in {count} part(s): pass part=(k, {count}), or choose another store"
        )
    if in_parts and not found.in_parts:
        raise ValueError(f"{storage.address} was not written in parts; choose another store")
    _identity.check_same(storage.address, found.attributes, described, same_bits)
    if count != split.parts:
        raise ValueError(f"{storage.address} is written in {count} part(s), not in {split.parts}")
    return found
