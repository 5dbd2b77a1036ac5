"""The writer of a store: it creates the store or joins it, and commits the results of a part, or of the whole run."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.runs._storage.chunks import (
    REQUESTS,
    chunk_files,
    digest_of,
    dims_of,
    in_threads,
    raise_if_damaged,
    tail,
)
from lieint_jax.runs._storage.files import open_zarr
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs.store._root import CARRY, ENDS, ROOT, ROWS, START, PartState, Root, UnusablePartError, encode_root

_LEVEL = -1  # of zstd: six times as fast as 0, and 5 % larger, for numbers of simulations


class Column(NamedTuple):
    """The description of one array of a store.

    Attributes:
        shape, dtype, chunks: those of the complete run.
        dims: the names of its axes.
        attributes: its units and long name.
        missing: what stands for a value that is not published; None: NaN, −1, False or "".
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    attributes: Table
    missing: int | None = None


Constants = Mapping[str, tuple[Column, np.ndarray]]


class Slab(NamedTuple):
    """Values to write into the array `name`, starting at index `at`, over the whole of all further axes."""

    name: str
    at: tuple[int, ...]
    values: np.ndarray


def skeleton(columns: Mapping[str, Column], attributes: Table, constants: Constants) -> dict[str, bytes]:
    """The files of a store before anything is computed: the root and its arrays' metadata, and the constants.

    The same run has the same files in every process, so that all of them may write them.
    """
    import zarr
    import zarr.storage

    kept: dict[str, Any] = {}
    store = zarr.storage.MemoryStore(kept)
    group = zarr.create_group(store, attributes=dict(attributes) | {"progress": START})
    for name, column in {**columns, **{name: column for name, (column, _) in constants.items()}}.items():
        _add_array(group, name, column)
    with _every_chunk():
        for name, (_, values) in constants.items():
            zarr.open_array(store, path=name, mode="r+")[...] = values
    files = {name: data.to_bytes() for name, data in kept.items()}
    metas = {name: json.loads(files[f"{name}/{ROOT}"]) for name in sorted({**columns, **constants})}
    root = json.loads(files[ROOT])
    root["attributes"]["digests"] = {
        "arrays": {name: digest_of(tail(files[f]) for f in chunk_files(name, metas[name])) for name in constants}
    }
    return files | {ROOT: encode_root(root, metas)}


def _add_array(group: Any, name: str, column: Column) -> None:
    """Create an array of a store, without values."""
    import zarr.codecs

    missing = {"f": np.nan, "i": -1, "b": False, "T": ""}.get(column.dtype.kind, 0)
    group.create_array(
        name,
        shape=column.shape,
        dtype=column.dtype,
        chunks=column.chunks,
        dimension_names=column.dims,
        attributes=dict(column.attributes),
        fill_value=missing if column.missing is None else column.missing,
        compressors=[zarr.codecs.ZstdCodec(level=_LEVEL), zarr.codecs.Crc32cCodec()],
    )


def _every_chunk() -> AbstractContextManager[object]:
    """A context whose newly opened arrays write chunks of fill values too, so that every missing file is a lost one."""
    import zarr

    return zarr.config.set({"array.write_empty_chunks": True})


def join(root: Root, files: Mapping[str, bytes]) -> None:
    """Write the files of a store that its creator, killed after it had claimed the name, has not written.

    Args:
        root: the root of the store, which describes this run.
        files: the `skeleton` of this run.

    Raises:
        ValueError: the description of the run is damaged.
    """
    storage = root.storage

    def is_right(name: str) -> bool:
        try:
            return storage.read(name) == files[name]
        except FileNotFoundError:
            storage.put(name, files[name])
            return True

    right = list(in_threads(is_right, set(files) - {ROOT}, storage))
    if not all(right):  # damaged, or written by another version of zarr
        raise_if_damaged(storage.address, root.damage_of_root())


class Writer:
    """Part k of a store, open for writing: one of several, or the whole of a run.

    A commit is a row of whole chunks, and the carry from which the run goes on. A background thread writes the chunks
    while the run continues. Then `publish` replaces the state of the part, in which their checksums and the carry are.

    Args:
        root: the root of the store.
        k: which part.
        initial: the digest of the initial states of the part's members.
        machine: the processor, the versions and the engine, which the part records.
        same_bits: whether the part must have begun with initial states of the same bits.
    """

    def __init__(
        self,
        root: Root,
        k: int,
        initial: str = "",
        machine: Table | None = None,
        same_bits: bool = True,
    ) -> None:
        self.path = root.storage.address
        self._root, self._k = root, k
        self._members = root.split.part(k)
        self._store = open_zarr(root.storage, writable=True)
        self._arrays: dict[str, Any] = {}
        self._pool = ThreadPoolExecutor(REQUESTS) if root.storage.is_remote else None
        self._background = ThreadPoolExecutor(1, thread_name_prefix="lieint-store")
        self._writing: Future[None] | None = None
        state = self._found(initial, same_bits) or PartState(START, {}, initial)
        new = () if machine is None or machine in state.machines else (machine,)
        self._state = state._replace(machines=(*state.machines, *new))
        root.show(self.progress)

    def _found(self, initial: str, same_bits: bool) -> PartState | None:
        """The state that is resumed."""
        remedy = f"remove {self._root.state_file(self._k)}, and the part starts again"
        name = f"part {self._k} of {self.path}"
        try:
            state = self._root.state(self._k)
        except UnusablePartError as error:
            raise ValueError(f"{name} is damaged and cannot be resumed: {error}. R{remedy[1:]}") from None
        if state is None:
            return None
        lost = next(self._root.damage_of_part(self._k, state), None) if self._root.in_parts else None
        if lost:
            raise ValueError(f"{name} is damaged: {lost}. Restore the file from a copy, or {remedy}")
        if state.initial != initial and same_bits:
            raise ValueError(
                f"{name} began with other initial states than those given now, and cannot be resumed: the function of "
                f"states must return the same for the same numbers whenever it is called. R{remedy[1:-5]}new"
            )
        return state

    @property
    def attributes(self) -> Table:
        """The attributes of the store."""
        return self._root.attributes

    @property
    def progress(self) -> Table:
        """The state of the published run: its commits, entries along time, steps, and whether it is complete."""
        return self._state.progress

    def carry(self) -> dict[str, Any]:
        """The arrays of the published carry by name."""
        return {name.removeprefix(CARRY): x for name, x in self._state.arrays.items() if name.startswith(CARRY)}

    def write(self, slabs: Callable[[], Iterable[Slab]], then: Callable[[], None]) -> None:
        """Start writing slabs in the background, and then call `then` there.

        The previous commit must have been published.
        """

        def work() -> None:
            self._put_all(slabs())
            then()

        self._writing = self._background.submit(work)

    def check(self) -> None:
        """Raise OSError if what `write` has started has failed."""
        if self._writing is not None and self._writing.done():
            self.wait()

    def wait(self) -> None:
        """Wait until what `write` has started is on disk and published. Raises OSError if it could not be."""
        writing, self._writing = self._writing, None
        if writing is not None:
            with self.errors():
                writing.result()

    @contextmanager
    def errors(self) -> Iterator[None]:
        """A context in which errors of the storage say what the store holds, and what to do."""
        try:
            yield
        except OSError as error:
            reason, steps = error.strerror or str(error), self.progress["steps"]
            raise OSError(
                error.errno, f"{reason}: {self.path} holds everything up to step {steps}; fix the cause and resume"
            ) from error

    def publish(self, row: int | None, progress: Table, carry: Mapping[str, np.ndarray]) -> None:
        """Make a commit visible whose files are written.

        Args:
            row: the row of chunks along time that it fills, or None.
            progress: the progress that it publishes.
            carry: the arrays of all members of this part, from which the run goes on; none after the last step.
        """
        rows = self._state.arrays.get(ROWS)
        if row is not None:
            own = self._checksums(self._root.files(self._k, row))[None]
            rows = own if rows is None else np.concatenate([rows[:row], own])
        arrays = {} if rows is None else {ROWS: rows}
        if progress["complete"]:
            arrays[ENDS] = self._checksums(self._root.files(self._k))
        state = self._state._replace(progress=progress, arrays=arrays)
        if not self._is_overtaken(progress):
            whole = state._replace(arrays=arrays | {f"{CARRY}{name}": x for name, x in carry.items()})
            self._root.storage.put(self._root.state_file(self._k), whole.encode(self._root.place(self._k)))
            self._root.show(progress)
        self._state = state
        self._store.checksums.clear()

    def _checksums(self, files: Iterable[str]) -> np.ndarray:
        """The checksums of files of this commit."""
        return np.array([self._store.checksums[file] for file in files], np.uint32)

    def _is_overtaken(self, progress: Table) -> bool:
        """Whether another process has come further with this part, which happens only where there are no locks."""
        if not self._root.storage.is_remote:
            return False
        try:
            found = self._root.state(self._k)
        except UnusablePartError:
            return False
        return found is not None and found.progress["steps"] > progress["steps"]

    def close(self) -> None:
        """Wait for the background threads."""
        self._background.shutdown()
        if self._pool is not None:
            self._pool.shutdown()

    def _put_all(self, slabs: Iterable[Slab]) -> None:
        waiting: list[Future[None]] = []
        for slab in slabs:
            if self._pool is None:
                self._put(slab)
                continue
            waiting.append(self._pool.submit(self._put, slab))
            if len(waiting) > REQUESTS:  # slabs that wait are in memory
                waiting.pop(0).result()
        for future in waiting:
            future.result()
        self._root.storage.settle()

    def _put(self, slab: Slab) -> None:
        """Write a slab of this part's members into an array of all members, or of the series of all parts."""
        if slab.name not in self._arrays:
            import zarr

            with _every_chunk():
                self._arrays[slab.name] = zarr.open_array(self._store, path=slab.name, mode="r+")
        array, dims = self._arrays[slab.name], dims_of(self._root.metas[slab.name])
        if dims[0] == "part":
            array[(self._k, *_slices(slab.at, slab.values.shape))] = slab.values
            return
        first = {"member": self._members.start}
        at = tuple(start + first.get(dim, 0) for start, dim in zip(slab.at, dims, strict=False))
        array[_slices(at, slab.values.shape)] = slab.values


def _slices(at: tuple[int, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The place of a slab that starts at `at`, over the whole of the axes that this does not name."""
    rest = itertools.repeat(0, len(shape) - len(at))
    return tuple(slice(a, a + n) for a, n in zip((*at, *rest), shape, strict=True))
