"""A run that is written to a store, whole or one of its parts, and the check that it may be resumed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial

from lieint_jax.runs._digests import digest_of_states
from lieint_jax.runs._engine import Engine
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._split import Split
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.leaves import Saves, Table
from lieint_jax.runs._storage.storage import ROOT, Storage, check_json, checked_path
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._layout import first_files
from lieint_jax.runs.store._reading import read_part
from lieint_jax.runs.store._root import Root, check_store, open_root, written_root
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.runs.store._writer import Writer, join


def run_into_store(whole: Plan, engine: Engine, integrate: Callable[[StoreOutput], object]) -> Saves:
    """Let `integrate` fill a part of a store, from its start or its last commit, and return the results of its members.

    The first part to come creates the store; every part checks that the store is that of its own run.

    Args:
        whole: the plan of all members.
        engine: computes the plan of this process.
        integrate: fills an output.
    """
    plan, options = engine.plan, whole.store
    assert options is not None
    k = 0 if whole.part is None else whole.part[0]
    storage, split = open_storage(checked_path(options.path)), whole.split()
    in_parts = whole.part is not None or storage.is_remote  # other processes may write at the same time
    check_json(options.attributes)
    described = _identity.description(whole, engine)
    new_files = partial(first_files, whole, options, described, split, in_parts)
    exists = storage.has_store()
    if exists and not whole.resume:
        raise ValueError(
            f"{storage.address.name} exists and is not overwritten; resume continues it, or choose another store"
        )
    if not exists:
        if not in_parts:  # whose other parts must be comparable
            _identity.warn_of_no_resume(described)
        exists = not _is_created(storage, new_files(), in_parts)
    root = _root_of(storage, described if exists or in_parts else None, split, in_parts, whole.same_bits)
    with contextlib.ExitStack() as stack:
        stack.enter_context(root.storage.lock(root.folder(k)))
        if in_parts:
            join(root, new_files())
        initial, machine = digest_of_states(plan.states), _identity.machine_of(described)
        writer = stack.enter_context(contextlib.closing(Writer(root, k, initial, machine, whole.same_bits)))
        if not writer.progress["complete"]:
            integrate(StoreOutput(plan, writer))
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
