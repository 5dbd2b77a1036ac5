"""The writer of a store: it completes a new store, and commits the results of a part, or of the whole run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.runs._storage.arrays import (
    ArrayMetadata,
    chunk_file,
    in_threads,
    raise_if_damaged,
    tail,
)
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.storage import ROOT
from lieint_jax.runs.store._root import CARRY, ENDS, ROWS, START, PartState, Root, UnusablePartError


class Slab(NamedTuple):
    """Values to write into the array `name`, starting at index `at`, over the whole of all further axes."""

    name: str
    at: tuple[int, ...]
    values: np.ndarray


def join(root: Root, files: Mapping[str, bytes]) -> None:
    """Write the files of a store that its creator, killed after it had claimed the name, has not written.

    Args:
        root: the root of the store, which describes this run.
        files: the `first_files` of this run.

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
        self._checksums: dict[str, int] = {}  # of the files that this process has written since the last commit
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
            own = self._checksums_of(self._root.files(self._k, row))[None]
            rows = own if rows is None else np.concatenate([rows[:row], own])
        arrays = {} if rows is None else {ROWS: rows}
        if progress["complete"]:
            arrays[ENDS] = self._checksums_of(self._root.files(self._k))
        state = self._state._replace(progress=progress, arrays=arrays)
        if not self._is_overtaken(progress):
            whole = state._replace(arrays=arrays | {f"{CARRY}{name}": x for name, x in carry.items()})
            self._root.storage.put(self._root.state_file(self._k), whole.encode(self._root.place(self._k)))
            self._root.show(progress)
        self._state = state
        self._checksums.clear()

    def _checksums_of(self, files: Iterable[str]) -> np.ndarray:
        """The checksums of files of this commit."""
        return np.array([self._checksums[file] for file in files], np.uint32)

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
        """Wait for the background thread."""
        self._background.shutdown()

    def _put_all(self, slabs: Iterable[Slab]) -> None:
        storage = self._root.storage
        chunks = (chunk for slab in slabs for chunk in self._chunks(slab))

        def put(chunk: tuple[str, ArrayMetadata, np.ndarray]) -> None:
            file, meta, values = chunk
            data = meta.encode(values)
            storage.stage(file, data)
            self._checksums[file] = tail(data)

        for _ in in_threads(put, chunks, storage):
            pass
        storage.settle()

    def _chunks(self, slab: Slab) -> Iterator[tuple[str, ArrayMetadata, np.ndarray]]:
        """The chunks of a slab of this part's members in an array of all members, or in the series of all parts."""
        meta, at, values = self._root.metas[slab.name], slab.at, slab.values
        if meta.dims[0] == "part":
            at, values = (self._k, *at), values[None]
        else:
            first = {"member": self._members.start}
            at = tuple(start + first.get(dim, 0) for start, dim in zip(at, meta.dims, strict=False))
        for key, block in meta.blocks(values, (*at, *(0,) * (values.ndim - len(at)))):
            yield chunk_file(slab.name, key), meta, block
