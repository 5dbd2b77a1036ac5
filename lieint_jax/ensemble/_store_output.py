"""A run that is written to a store: its arrays, its checkpoints, and the check that a run may be resumed."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import DTypeLike

from lieint_jax.ensemble import _identity, _layout, _opening, _store
from lieint_jax.ensemble._description import describe
from lieint_jax.ensemble._dyadic_sum import blocks
from lieint_jax.ensemble._engine import Engine
from lieint_jax.ensemble._integrity import Table
from lieint_jax.ensemble._job import (
    CHUNKS_OF_BUFFER,
    OBJECT_BYTES,
    Job,
    first_entry,
    gather_rows,
    local_rows,
    reduce_rows,
)
from lieint_jax.ensemble._layout import Layout, Numbers, Place
from lieint_jax.ensemble._loop import Carry, Range, Saved, step_dtype
from lieint_jax.ensemble._part_writer import PartWriter, join, skeleton
from lieint_jax.ensemble._parts import PartsRoot, Split, read_root
from lieint_jax.ensemble._reading import open_complete, read_part
from lieint_jax.ensemble._storage import Storage, address, open_storage
from lieint_jax.ensemble._store import leaves_by_name, state_from_leaves, store_name
from lieint_jax.types import StepInfo, labeled

Pending = Any  # saved rows by block, or the series of a reduction by name
_RESIDUAL = "largest residual of a step since the entry before"
CHUNK_MEMBERS = 8192  # the most members in a chunk on disk
_OWN = {
    "constants",
    "description",
    "progress",
    "digests",
    "checksum",
    "parts",
    "missing",
}  # further attributes of every store
SLAB = 8  # chunks of members that are joined along time, and written, at once
_CHECKPOINT_EVERY = 30.0  # seconds between checkpoints within a long save interval


class StoreOptions(NamedTuple):
    """The path of a store, and attributes that are written with the results.

    Attributes:
        path: a folder or a URL, whose name ends in .zarr.
        attributes: values for JSON, such as a title. The key "scenario" describes the run: a run with another scenario
            cannot resume it.
        time_unit: the unit of dt.
    """

    path: str | Path
    attributes: Mapping[str, Any] = {}
    time_unit: str = "1"


def run_into_store(
    engine: Engine,
    place: Place,
    options: StoreOptions,
    resume: bool,
    integrate: Callable[[Layout, StoreOutput], object],
) -> Any:
    """Let `integrate` fill a store from the start or from its last checkpoint, and return the stored results."""
    job, mesh = engine.job, place.mesh
    path, leader = _checked_path(options.path), jax.process_index() == 0
    _check_json(options.attributes)
    layout = _layout.layout_of(place, job.members)
    described = _identity.description(job, engine.name, options.attributes.get("scenario"))
    chunk = _layout.chunk_of(layout, CHUNK_MEMBERS)
    attributes = _attributes(job, options, described, chunk, job.buffer_rows(chunk))
    _identity.check_processes(mesh, described, store=path.name, resume=resume)
    exists = bool(_layout.all_reduce_max(mesh, os.path.exists(path))[0])
    if exists and not resume:
        raise ValueError(f"{path} exists and is not overwritten; resume continues it, or choose another store")
    if not exists:
        _identity.warn_of_no_resume(described)
        _layout.fail_together(mesh, lambda: leader and _create(path, job, options, attributes))
    else:
        _layout.fail_together(mesh, lambda: _refuse_parts(path, _opening.check_store(path)))
    with contextlib.ExitStack() as stack:
        writer = _layout.fail_together(mesh, lambda: stack.enter_context(_store.open_writer(path, leader)))
        if exists:
            _layout.fail_together(mesh, lambda: _identity.check_same(path, writer.attributes, described))
        if leader:
            _store.clean(path)
        layout = _layout.layout_of(place, job.members, writer.attributes["member_chunk"])
        _layout.barrier(mesh)
        _layout.fail_together(mesh, lambda: _store.check(path))
        if not writer.progress["complete"]:
            integrate(layout, StoreOutput(job, layout, writer))
    return open_complete(path)


def _refuse_parts(path: Path, attributes: Table) -> None:
    if "parts" in attributes:
        count = attributes["parts"]
        raise ValueError(f"{path} is written in {count} part(s): pass part=(k, {count}), or choose another store")


def split_into_parts(job: Job, count: int, remote: bool) -> Split:
    """The split of a run into `count` parts, and its chunks."""
    return Split.into_parts(
        job.members, count, chunk_members(job.members, count, job.row_bytes, job.num_saves + 1, remote)
    )


def chunk_members(members: int, count: int, row: int, entries: int, remote: bool) -> int:
    """The most members in a chunk of a run of `count` parts, of which a saved row has `row` bytes for each member.

    Where a chunk is an object in a bucket it has members enough that it can become as large as it should: a part holds
    the rows of all of its members in memory, which limits the number of rows.
    """
    if not remote:
        return CHUNK_MEMBERS
    return max(CHUNK_MEMBERS, members // (count * CHUNKS_OF_BUFFER), OBJECT_BYTES // (row * entries))


def run_part_into_store(
    engine: Engine,
    whole: Job,
    place: Place,
    options: StoreOptions,
    split: Split,
    k: int,
    resume: bool,
    integrate: Callable[[Layout, StoreOutput], object],
) -> Any:
    """Let `integrate` fill part k of a store, from its start or its last commit, and return the results of its members.

    The first part to come creates the store; every part checks that the store is that of its own run.

    Args:
        engine: that of the part's job.
        whole: the job of all members.
        place: the devices and threads.
        options: the store.
        split: the parts.
        k: which one.
        resume: continue a store that exists.
        integrate: fills an output.
    """
    storage = open_storage(_checked_path(options.path))
    _check_json(options.attributes)
    described = _identity.description(whole, engine.name, options.attributes.get("scenario"))
    found = read_root(storage)
    if found is not None and not resume:
        raise ValueError(
            f"{storage.address} exists and is not overwritten; resume continues it, or choose another store"
        )
    if found is not None:
        _same_run(storage, found, described, split)  # before anything is written into the store of another run
    files = _skeleton(whole, options, described, split, storage.is_remote)
    with storage.lock(f"parts/{k}"):
        if found is None:
            storage.create(_store.ROOT, files[_store.ROOT])
        root = _same_run(storage, found or read_root(storage), described, split)
        join(storage, root, files)
        layout = _layout.layout_of(place, engine.job.members, alone=whole.members == 1)
        with contextlib.closing(PartWriter(root, k, _identity.digest_of_states(engine.job.initial))) as writer:
            if not writer.progress["complete"]:
                integrate(layout, StoreOutput(engine.job, layout, writer))
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
    attributes = _attributes(job, options, described, split.chunk, rows)
    attributes |= {"format": _store.PARTS_FORMAT, "parts": split.parts}
    attributes |= {"constants": sorted(numbers), "description": description}
    axes = _Axes(job, split.chunk, rows)
    columns = _columns(job, axes, options)
    if job.reduction is not None:
        most = max(len(blocks(part.start, part.stop)) for part in map(split.part, range(split.parts)))
        series = {"part": (split.parts, 1), **axes.times}
        columns |= _series_columns(job, axes, series)
        columns["sums"] = axes.column({**series, "block": (most, most)}, long_name="sums over blocks of members")
    constants = {name: _constant(name, x, job) for name, x in numbers.items()} | _labels(job)
    constants["time"] = columns.pop("time"), job.times
    return skeleton(columns, attributes, constants)


def _checked_path(place: str | Path) -> Any:
    """The path or URL of a store, checked as far as is possible before it exists."""
    path = address(place)
    if path.suffix != ".zarr":
        raise ValueError(f"a store is a folder that ends in .zarr, got {path}")
    if isinstance(path, Path) and os.path.lexists(path) and not os.path.exists(path):
        raise ValueError(f"{path} is a link to {path.readlink()}, which does not exist; remove it or make that folder")
    return path


def _check_json(attributes: Mapping[str, object]) -> None:
    """Raise ValueError if the user's attributes of a store are not values for JSON."""
    for key, value in attributes.items():
        try:
            if not isinstance(key, str):
                raise TypeError(f"names must be strings, got {key!r}")
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"attributes of a store must be values for JSON; {key!r} is not: {error}") from None


def _create(path: Path, job: Job, options: StoreOptions, attributes: Table) -> None:
    """Make the store of a run."""
    description, numbers = describe(job.step)
    chunk = attributes["member_chunk"]
    attributes |= {"constants": sorted(numbers), "description": description}
    axes = _Axes(job, chunk, attributes["time_chunk"])
    columns = _columns(job, axes, options)
    constants = {name: _constant(name, x, job) for name, x in numbers.items()} | _labels(job)
    _store.create(path, columns, _checkpoint_columns(job, axes), attributes, constants)


class StoreOutput:
    """Results in a store, written chunk by chunk, with a checkpoint after each chunk."""

    defers_interrupts = True

    def __init__(self, job: Job, layout: Layout, writer: _store.BackgroundWriter) -> None:
        self._job, self._layout, self._writer = job, layout, writer
        self._entries = writer.progress["entries"]  # committed so far
        self._pending: list[tuple[Pending, int]] = []
        self._since = 0.0
        self._next: _store.Commit | None = None  # the commit that is being written
        self.buffer_rows = int(writer.attributes["time_chunk"])

    @property
    def _pending_rows(self) -> int:
        return sum(number for _, number in self._pending)

    @property
    def free_rows(self) -> int:
        """The number of saves until the current chunk is full."""
        return self.buffer_rows - (self._entries + self._pending_rows) % self.buffer_rows

    def restore(self) -> tuple[list[Carry], int, int] | None:
        """The carry and the numbers of steps and of saves of the run in the store, or None."""
        done = self._writer.progress
        if not done["commits"]:
            return None
        mine = self._layout.local_members
        part = range(max(min(mine.start, self._layout.members - 1), 0), max(mine.stop, mine.start + 1))

        def read(name: str) -> Any:
            return self._writer.read(f"checkpoint/{name}", (self._writer.slot, slice(part.start, part.stop)))

        change = Range(*map(read, Range._fields)) if self._job.reduction is not None else None
        info = StepInfo(read("residual"), read("converged"))  # pyright: ignore[reportArgumentType]
        state = state_from_leaves({name: read(name) for name in leaves_by_name(self._job.states)})
        carry = Carry(state, info, read("failed"), change)  # pyright: ignore[reportArgumentType]
        return _layout.scatter(self._layout, carry, part.start), done["steps"], done["entries"] - 1

    def begin(self, carry: list[Carry]) -> None:
        """Receive the entry of the start."""
        if self._job.reduction is None:
            self._pending.append(([jax.tree.map(lambda x: np.asarray(x)[None], (c.info, c.state)) for c in carry], 1))
        else:
            self._pending.append((first_entry(self._job), 1))

    def append(self, saved: list[Saved], number: int) -> None:
        """Receive `number` saved rows."""
        if self._job.reduction is not None:
            rows: Pending = reduce_rows(gather_rows(self._layout, saved, number), self._job)
        else:
            rows = local_rows(saved, number)
        self._pending.append((rows, number))

    def checkpoint(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        """Commit if a chunk is full; or if no rows are pending and the last commit is old or the run is to stop."""
        self._settle(wait=False)
        self._since += seconds
        last = self._entries + self._pending_rows > self._job.num_saves
        whole = self._pending_rows and (self._entries + self._pending_rows) % self.buffer_rows == 0
        if last or whole or (not self._pending_rows and (stop or self._since > _CHECKPOINT_EVERY)):
            self._commit(carry, done, last)

    def _commit(self, carry: list[Carry], done: int, last: bool) -> None:
        self._settle(wait=True)
        pending, first, writer = self._pending, self._entries, self._writer
        number = writer.progress["commits"] + 1
        self._entries, self._pending, self._since = first + self._pending_rows, [], 0.0
        row = first // self.buffer_rows if pending else None
        commits = 0 if last else number  # reset: it depends on interruptions
        progress = {"commits": commits, "entries": self._entries, "steps": done, "complete": last}
        self._next = _store.Commit(row, progress)
        writer.write(partial(self._parts, carry, pending, first, (number, done), last), self._next)

    def _settle(self, wait: bool) -> None:
        """Publish the commit in progress if all processes have written it; with `wait`, wait until they have."""
        while self._next is not None:
            missing = _layout.all_reduce_max(self._layout.mesh, not self._writer.is_written)[0]
            if not missing:
                checksums = _layout.gather_row(self._layout.mesh, self._writer.checksums(self._next))
                self._writer.publish(self._next, checksums.max(axis=0))
                self._next = None
            elif not wait:
                return
            else:
                time.sleep(0.002)

    def _parts(
        self, carry: list[Carry], pending: list[tuple[Pending, int]], first: int, commit: tuple[int, int], last: bool
    ) -> Any:
        """The parts of a commit (its number, number of steps), one by one, computed by the background thread."""
        layout, part, slot = self._layout, _store.Part, commit[0] % 2
        mine = layout.local_members.start
        series = self._job.reduction is not None
        if len(layout.local_members):
            host = {name: _layout.local_part(layout, x) for name, x in _leaves_of_carry(carry).items()}
            for name, x in host.items():
                yield part(f"checkpoint/{name}", (slot, mine), x[None])
            if last:
                kept = {"first_failure": host["failed"]}
                if series:
                    kept |= {name: host[name] for name in leaves_by_name(self._job.states)}
                    if self._has_own_times:
                        kept["t"] = self._own_times(slice(-1, None), layout.local_members)[0]
                for name, x in kept.items():
                    yield part(store_name(name), (mine,), x)
        if jax.process_index() == 0:
            yield part("checkpoint/commit", (slot,), np.array([commit]))
        if not pending:
            return
        end = first + sum(number for _, number in pending)
        if jax.process_index() == 0:
            yield part("time", (first,), self._job.times[first:end])
        if not series:
            yield from self._slabs(pending, slice(first, end))
        elif jax.process_index() == 0:
            for name in pending[0][0]:
                yield part(name, (first,), np.concatenate([values[name] for values, _ in pending]))

    def _slabs(self, pending: list[tuple[Pending, int]], entries: slice) -> Iterator[_store.Part]:
        """The rows of this process' members, joined along time for a few chunks at once: memory has no copy of all."""
        members, across = self._layout.local_members, SLAB * int(self._writer.attributes["member_chunk"])
        slabs = [members[k : k + across] for k in range(0, len(members), across)]
        blocks = [[leaves_by_name(state) | info._asdict() for info, state in saved] for saved, _ in pending]
        for name in blocks[0][0]:
            pieces = [_layout.local_part(self._layout, [block[name] for block in saved], 1) for saved in blocks]
            for slab in slabs:
                own = slice(slab.start - members.start, slab.stop - members.start)
                rows = [piece[:, own] for piece in pieces]
                joined = np.concatenate(rows) if len(rows) > 1 else rows[0]
                yield _store.Part(store_name(name), (entries.start, slab.start), joined)
        if self._has_own_times:
            for slab in slabs:
                yield _store.Part("t", (entries.start, slab.start), self._own_times(entries, slab))

    @property
    def _has_own_times(self) -> bool:
        """True if the store has an array "t", since members start at different times."""
        return self._job.t0 is not None and not self._job.shares_time

    def _own_times(self, entries: slice, members: range) -> np.ndarray:
        """The values of the array "t" for these members."""
        return self._job.state_times(entries, slice(members.start, members.stop))

    def can_stop(self) -> bool:
        """True if everything so far is committed."""
        if self._pending:
            return False
        self._settle(wait=True)
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        """The message for a user who interrupted the run."""
        return f"stopped after {done} of {num_steps} steps, all of them in {self._writer.path}; resume to continue"

    def result(self, carry: list[Carry]) -> None:
        """Wait until everything is written."""
        self._settle(wait=True)
        _layout.barrier(self._layout.mesh)


def _leaves_of_carry(carry: list[Carry]) -> dict[str, list[Numbers]]:
    """The arrays of a carry by name, each as a list of its blocks."""
    found: dict[str, list[Numbers]] = {}
    for c in carry:
        change = c.change._asdict() if c.change is not None else {}
        for name, x in {**leaves_by_name(c.state), "failed": c.failed, **c.info._asdict(), **change}.items():
            found.setdefault(name, []).append(x)
    return found


class _Axes:
    """The axes that the arrays of a store share, each a name with its length and chunk length."""

    def __init__(self, job: Job, chunk: int, rows: int) -> None:
        self.times = {"time": (job.num_saves + 1, rows)}  # name: (length, chunk)
        self.members = {"member": (job.members, chunk)}
        self.slots = {"slot": (2, 1)}
        self._number = job.dtype

    def column(
        self, axes: Mapping[str, tuple[int, int]], dtype: DTypeLike | None = None, **attributes: str
    ) -> _store.Column:
        """The description of an array of scalars along `axes`."""
        (shape, chunks), kind = zip(*axes.values(), strict=True), np.dtype(self._number if dtype is None else dtype)
        return _store.Column(shape, kind, chunks, tuple(axes), attributes)

    def state(self, axes: Mapping[str, tuple[int, int]], name: str, leaf: Numbers, **attributes: str) -> _store.Column:
        """The description of an array of one leaf of the states along `axes`."""
        dims, _ = labeled.state_axes(store_name(name), leaf.shape[1:])
        return self.column({**axes, **{dim: (n, n) for dim, n in zip(dims, leaf.shape[1:], strict=True)}}, **attributes)


def _columns(job: Job, axes: _Axes, options: StoreOptions) -> dict[str, _store.Column]:
    """The arrays that readers see."""
    times, members = axes.times, axes.members
    series = job.reduction is not None
    texts = {"q": "configuration", "p": "momentum", "work": "work done on the body", "t": "time of each member"}
    text = "time" if job.t0 is None or job.shares_time else "time since the start"
    if job.step.own_time:
        text = "fictitious time since the start"
    columns = {"time": axes.column(times, units=options.time_unit, long_name=text)}
    for name, leaf in leaves_by_name(job.states if job.shares_time else job.initial).items():
        along, text = members if series else {**times, **members}, texts.get(name, name.removeprefix("extra."))
        columns[store_name(name)] = axes.state(along, name, leaf, long_name=text, units=_unit(name, job, options))
    columns["first_failure"] = axes.column(
        members, np.int64, long_name="first step that did not converge, or -1", units="1"
    )
    return columns | (_series_columns(job, axes, times) if series else _report_columns(axes))


def _report_columns(axes: _Axes) -> dict[str, _store.Column]:
    both = {**axes.times, **axes.members}
    return {
        "residual": axes.column(both, long_name=_RESIDUAL, units="1"),
        "converged": axes.column(both, bool, long_name="whether all steps since the entry before did"),
    }


def _series_columns(job: Job, axes: _Axes, along: Mapping[str, tuple[int, int]]) -> dict[str, _store.Column]:
    what = getattr(job.reduction, "__name__", "reduced quantity")
    text = "{} change of {} since the start, over members and steps"
    return {
        **{name: axes.column(along, long_name=text.format(name, what)) for name in ("least", "greatest", "mean")},
        "residual": axes.column(along, long_name=_RESIDUAL, units="1"),
        "unconverged": axes.column(along, np.int64, long_name="members with a step that did not", units="1"),
    }


def _constant(name: str, values: np.ndarray, job: Job) -> tuple[_store.Column, np.ndarray]:
    """The description and the values of an array of the step, with the member axis first if it has one."""
    along = ("member",) if job.step_axis is not None else ()
    dims = (*along, *(f"{name}_axis{k}" for k in range(values.ndim - len(along))))
    return _store.Column(values.shape, values.dtype, values.shape, dims, {"long_name": f"{name} of the run"}), values


def _labels(job: Job) -> dict[str, tuple[_store.Column, np.ndarray]]:
    """The coordinates that name the components of the states, such as x, y, z along the dimension "axis"."""
    found: dict[str, tuple[_store.Column, np.ndarray]] = {}
    for name, leaf in leaves_by_name(job.states).items():
        system = getattr(job.step, "system", None)
        for dim, labels in labeled.state_axes(store_name(name), leaf.shape[1:], system)[1].items():
            values = np.asarray(labels)
            if values.dtype.kind == "U":
                values = values.astype(np.dtypes.StringDType())
            found[dim] = _store.Column(values.shape, values.dtype, values.shape, (dim,), {}), values
    return found


def _checkpoint_columns(job: Job, axes: _Axes) -> dict[str, _store.Column]:
    """The arrays of the checkpoint: those of a carry, in two slots that are written alternately."""
    along = {**axes.slots, **axes.members}
    return {
        **{name: axes.state(along, name, leaf) for name, leaf in leaves_by_name(job.states).items()},
        "commit": axes.column({**axes.slots, "number and steps": (2, 2)}, np.int64),
        "failed": axes.column(along, step_dtype()),
        "residual": axes.column(along),
        "converged": axes.column(along, bool),
        **({name: axes.column(along) for name in Range._fields} if job.reduction is not None else {}),
    }


def _unit(name: str, job: Job, options: StoreOptions) -> str:
    if name == "t":
        return options.time_unit
    rigid = hasattr(job.step.system, "inertia") and job.states.q.shape[1:] == (4,)
    power = {"p": "", "work": "^2"}.get(name)
    return f"unit of inertia / {options.time_unit}{power}" if rigid and power is not None else "1"


def _attributes(job: Job, options: StoreOptions, described: Table, chunk: int, rows: int) -> Table:
    """The attributes of a store, except those that describe its arrays and its progress.

    Raises:
        ValueError: a name of the user's attributes is reserved.
    """
    own = {
        "format": _store.FORMAT,
        "leaves": list(leaves_by_name(job.initial)),
        "time_unit": options.time_unit,
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "dt": job.dt,
        "save_every": job.save_every,
        "num_steps": job.num_steps,
        "num_entries": job.num_saves + 1,
        "members": job.members,
        "reduce": described["reduce"],
        "time_chunk": rows,
        "member_chunk": chunk,
        "run": described,
    }
    reserved = sorted(map(str, options.attributes.keys() & (own.keys() | _OWN)))
    if reserved:
        raise ValueError(f"attributes of a store may not be called {', '.join(reserved)}: these names are reserved")
    return {"title": job.step.name} | own | dict(options.attributes)
