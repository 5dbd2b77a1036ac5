"""The writer of one part of a store: it creates the store or joins it, and commits the results of its members."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from lieint_jax.runs.store import _integrity, _store
from lieint_jax.runs.store._integrity import CHECKPOINT, Table
from lieint_jax.runs.store._parts import ENDS, REQUESTS, ROWS, START, PartsRoot
from lieint_jax.runs.store._state_file import PartState, UnusablePartError
from lieint_jax.runs.store._storage import Storage, writable_arrays
from lieint_jax.runs.store._store import BackgroundWriter, Column, Commit, Part

Constants = Mapping[str, tuple[Column, np.ndarray]]


def skeleton(columns: Mapping[str, Column], attributes: Table, constants: Constants) -> dict[str, bytes]:
    """The files of a store in parts before any part has written: the root and its arrays' metadata, the constants.

    The same run has the same files in every process, so that all of them may write them.
    """
    import zarr
    import zarr.storage

    kept: dict[str, Any] = {}
    store = zarr.storage.MemoryStore(kept)
    group = zarr.create_group(store, attributes=dict(attributes) | {"progress": START})
    for name, column in {**columns, **{name: column for name, (column, _) in constants.items()}}.items():
        _store.add_array(group, name, column)
    with _store.write_every_chunk():
        for name, (_, values) in constants.items():
            zarr.open_array(store, path=name, mode="r+")[...] = values
    files = {name: data.to_bytes() for name, data in kept.items()}
    root = json.loads(files[_store.ROOT])
    metas = {name: json.loads(files[f"{name}/{_store.ROOT}"]) for name in sorted({**columns, **constants})}
    digests = {
        "metadata": {name: _integrity.digest(files[f"{name}/{_store.ROOT}"]) for name in metas},
        "arrays": {
            name: _integrity.digest_of(
                int.from_bytes(files[file][-4:], "little") for file in _integrity.chunk_files(name, metas[name])
            )
            for name in constants
        },
    }
    root |= {"consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": metas}}
    root["attributes"] |= {"digests": digests}
    root["attributes"]["checksum"] = _integrity.checksum(root)
    return files | {_store.ROOT: json.dumps(root, indent=1).encode()}


def join(storage: Storage, root: PartsRoot, files: Mapping[str, bytes]) -> None:
    """Write the files of a store that its creator, killed after it had claimed the name, has not written.

    Args:
        storage: the storage of the store, whose root exists and describes this run.
        root: this root.
        files: the `skeleton` of this run.

    Raises:
        ValueError: the description of the run is damaged.
    """

    def is_right(name: str) -> bool:
        try:
            return storage.read(name) == files[name]
        except FileNotFoundError:
            storage.put(name, files[name])
            return True

    with ThreadPoolExecutor(REQUESTS if storage.is_remote else 1) as pool:
        right = all(pool.map(is_right, set(files) - {_store.ROOT}))
    if not right:  # damaged, or written by another version of zarr
        _integrity.raise_if_damaged(storage.address, root.damage_of_root())


class PartWriter(BackgroundWriter):
    """Part k of a store, open for writing: the interface of `_store.Writer` for one process and its own members.

    Args:
        root: the root of the store.
        k: which part.
        initial: the digest of the initial states of its members.
    """

    def __init__(self, root: PartsRoot, k: int, initial: str = "") -> None:
        super().__init__(root.storage.address)
        self._root, self._k, self._initial = root, k, initial
        self._members = root.split.part(k)
        self._store = writable_arrays(root.storage)
        self._arrays: dict[str, Any] = {}
        self._pool = ThreadPoolExecutor(REQUESTS) if root.storage.is_remote else None
        try:
            found = root.state(k)
        except UnusablePartError as error:
            raise ValueError(
                f"part {k} of {self.path} is damaged and cannot be resumed: {error}. Remove {root.state_file(k)}, and "
                "the part starts again"
            ) from None
        self._state = found or PartState(START, {}, initial)
        if found is not None:
            self._refuse_damage(found)
            self._refuse_other_states(found)

    def _refuse_damage(self, state: PartState) -> None:
        lost = next(self._root.damage(self._k, state), None)
        if lost:
            raise ValueError(
                f"part {self._k} of {self.path} is damaged: {lost}. Restore the file from a copy, or remove "
                f"{self._root.state_file(self._k)}, and the part starts again"
            )

    def _refuse_other_states(self, state: PartState) -> None:
        if state.initial != self._initial:
            raise ValueError(
                f"part {self._k} of {self.path} began with other initial states than those given now, and cannot be "
                "resumed: the function of states must return the same for the same numbers whenever it is called. "
                f"Remove {self._root.state_file(self._k)}, and the part starts anew"
            )

    @property
    def attributes(self) -> Table:
        """See `BackgroundWriter`."""
        return self._root.attributes

    @property
    def progress(self) -> Table:
        """See `BackgroundWriter`."""
        return self._state.progress

    def carry(self, members: range) -> dict[str, np.ndarray]:
        """See `BackgroundWriter`."""
        return {name.removeprefix(f"{CHECKPOINT}/"): x for name, x in self._state.arrays.items() if "/" in name}

    def _checksums(self, commit: Commit, written: Mapping[str, int]) -> np.ndarray:
        return np.zeros(1, np.uint32)

    def _publish(self, commit: Commit, checksums: np.ndarray) -> None:
        """See `BackgroundWriter`: `_write` has replaced the state."""

    def close(self) -> None:
        """Wait for the background threads."""
        super().close()
        if self._pool is not None:
            self._pool.shutdown()

    def _write(self, parts: Iterable[Part], commit: Commit) -> dict[str, int]:
        carry: dict[str, np.ndarray] = {}
        waiting: list[Future[None]] = []
        for part in parts:
            if part.name.startswith(f"{CHECKPOINT}/"):
                carry[part.name] = part.values
            elif part.name not in self._root.constants:
                waiting += self._put_slab(part)
            if len(waiting) > REQUESTS:  # slabs that wait are in memory
                waiting.pop(0).result()
        for future in waiting:
            future.result()
        self._replace_state(carry, commit)
        return {}

    def _put_slab(self, part: Part) -> list[Future[None]]:
        if self._pool is not None:
            return [self._pool.submit(self._put, part)]
        self._put(part)
        return []

    def _put(self, part: Part) -> None:
        """Write a slab of this part's members into an array of all members, or of the series of all parts."""
        array = self._array(part.name)
        dims = _integrity.dims_of(self._root.metas[part.name])
        if dims[0] == "part":
            array[(self._k, *_slices(part.at, part.values.shape))] = part.values
            return
        along = dims.index("member")
        at = tuple(start + (self._members.start if axis == along else 0) for axis, start in enumerate(part.at))
        array[_slices(at, part.values.shape)] = part.values

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            import zarr

            with _store.write_every_chunk():
                self._arrays[name] = zarr.open_array(self._store, path=name, mode="r+")
        return self._arrays[name]

    def _replace_state(self, carry: dict[str, np.ndarray], commit: Commit) -> None:
        """Commit: replace the state of this part by that after the files that have just been written."""
        rows, written = self._state.arrays.get(ROWS), self._store.checksums
        arrays: dict[str, np.ndarray] = {} if rows is None else {ROWS: rows}
        if commit.row is not None:
            row = np.array([[written[file] for file in self._root.files(self._k, commit.row)]], np.uint32)
            arrays[ROWS] = row if rows is None else np.concatenate([rows[: commit.row], row])
        if commit.progress["complete"]:
            arrays[ENDS] = np.array([written[file] for file in self._root.files(self._k)], np.uint32)
        else:
            arrays |= carry
        state = PartState(commit.progress, arrays, self._initial)
        self._root.storage.put(self._root.state_file(self._k), state.encode(self._root.place(self._k)))
        self._state = state._replace(arrays={name: x for name, x in arrays.items() if name == ROWS})
        written.clear()


def _slices(at: tuple[int, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The place of a slab that starts at `at`, over the whole of the axes that this does not name."""
    rest = itertools.repeat(0, len(shape) - len(at))
    return tuple(slice(a, a + n) for a, n in zip((*at, *rest), shape, strict=True))
