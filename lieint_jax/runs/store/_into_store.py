"""A run that is written to a store, whole or one of its parts, and the check that it may be resumed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial

from lieint_jax.runs._job.digests import digest_of_states
from lieint_jax.runs._job.dyadic_sum import blocks
from lieint_jax.runs._job.engine import Engine
from lieint_jax.runs._job.split import Split
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.leaves import Saves, Table
from lieint_jax.runs._storage.storage import Storage, StoreOptions, check_json, checked_path
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._columns import Axes, attributes_of, columns_of, constant, labels, series_columns
from lieint_jax.runs.store._description import describe
from lieint_jax.runs.store._open_store import check_store, described_root
from lieint_jax.runs.store._reading import read_part
from lieint_jax.runs.store._root import FORMAT, ROOT, Root
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.runs.store._writer import Writer, join, skeleton


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
    first_files = partial(_skeleton, whole, options, described, split, in_parts)
    exists = storage.has_store()
    if exists and not whole.resume:
        raise ValueError(
            f"{storage.address.name} exists and is not overwritten; resume continues it, or choose another store"
        )
    if not exists:
        if not in_parts:  # whose other parts must be comparable
            _identity.warn_of_no_resume(described)
        exists = not _is_created(storage, first_files(), in_parts)
    root = _root_of(storage, described if exists or in_parts else None, split, in_parts, whole.same_bits)
    with contextlib.ExitStack() as stack:
        stack.enter_context(root.storage.lock(root.folder(k)))
        if in_parts:
            join(root, first_files())
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
    found = (described_root if described is None or in_parts else check_store)(storage.address)
    count = found.split.parts
    if found.in_parts and not in_parts:
        raise ValueError(
            f"{storage.address} is written in {count} part(s): pass part=(k, {count}), or choose another store"
        )
    if in_parts and not found.in_parts:
        raise ValueError(f"{storage.address} was not written in parts; choose another store")
    if described is not None:
        _identity.check_same(storage.address, found.attributes, described, same_bits)
    if count != split.parts:
        raise ValueError(f"{storage.address} is written in {count} part(s), not in {split.parts}")
    return found


def _skeleton(plan: Plan, options: StoreOptions, described: Table, split: Split, in_parts: bool) -> dict[str, bytes]:
    """The files that a store begins with; `plan` is that of all members."""
    members = max(map(split.part, range(split.parts)), key=len)
    largest = plan.select(slice(members.start, members.stop))
    rows = largest.buffer_rows(split.chunk)
    description, numbers = describe(plan.step)
    attributes = attributes_of(plan, options, described, split.chunk, rows)
    attributes |= {"format": FORMAT, "constants": sorted(numbers), "description": description}
    axes = Axes(plan, split.chunk, rows)
    columns = columns_of(plan, axes, options)
    if in_parts:
        attributes["parts"] = split.parts
        if plan.reduction is not None:
            most = max(len(blocks(part.start, part.stop)) for part in map(split.part, range(split.parts)))
            series = {"part": (split.parts, 1), **axes.times}
            columns |= series_columns(plan, axes, series)
            if not plan.per_member and split.parts > 1:
                columns["sums"] = axes.column(
                    {**series, "block": (most, most)}, long_name="sums over blocks of members"
                )
    constants = {name: constant(name, x, plan) for name, x in numbers.items()} | labels(plan)
    constants["time"] = columns.pop("time"), plan.times
    return skeleton(columns, attributes, constants)
