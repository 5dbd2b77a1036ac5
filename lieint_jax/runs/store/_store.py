"""A run in a folder NAME.zarr, in the Zarr 3 format. An existing folder is never overwritten.

The store grows during the run, and the run can be resumed however it ended: see `Writer`.
"""

from __future__ import annotations

import abc
import contextlib
import glob
import hashlib
import itertools
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.runs.store import _integrity
from lieint_jax.runs.store._integrity import CHECKPOINT, CHECKSUMS, Table
from lieint_jax.runs.store._state_file import PartState
from lieint_jax.runs.store._storage import Address, Disk, lock_folder, open_storage, sync
from lieint_jax.types import State, StepInfo, Trajectory

FORMAT = 5  # the format number of new stores; version 0.2 wrote 2 and 0.3.0 wrote 3
PARTS_FORMAT = 4  # that of stores in parts: see `_parts`
_EXTRA = "extra."  # begins the name of a leaf of `State.extra`: extra.NAME
ROOT = "zarr.json"  # the metadata of a Zarr 3 group; new data become visible when it is replaced
_MAX_RECORDS = 2**16  # checksums in a chunk of their array, unless one row has more
_LEVEL = -1  # of zstd: six times as fast as 0, and 5 % larger, for numbers of simulations
_STALE = 3600.0  # seconds after which an unfinished store counts as abandoned


class Loaded(NamedTuple):
    """The published part of a run in a store.

    Attributes:
        found: a `Trajectory` of arrays that are read where they are indexed, or a dict of numpy arrays.
        failed: the first step of each member that did not converge, or −1; None before the last step.
        attributes: those of the store.
    """

    found: Trajectory | dict[str, np.ndarray]
    failed: np.ndarray | None
    attributes: Table


def leaves_by_name(state: State) -> Table:
    """The arrays of a state by the names that stores and files have for them: q, p, t, work, and extra.NAME."""
    own = {name: x for name, x in state._asdict().items() if name != "extra" and x is not None}
    return own | {f"{_EXTRA}{name}": x for name, x in (state.extra or {}).items()}


def state_from_leaves(arrays: Table) -> State:
    """The state of these arrays: the inverse of `leaves_by_name`."""
    extra = {name.removeprefix(_EXTRA): x for name, x in arrays.items() if name.startswith(_EXTRA)}
    own = {name: x for name, x in arrays.items() if not name.startswith(_EXTRA)}
    return State(**own, extra=extra or None)


def store_name(name: str) -> str:
    """The name of an array in a store, an identifier: extra_NAME for extra.NAME."""
    return name.replace(".", "_")


def shared_time(times: np.ndarray, members: int) -> np.ndarray:
    """The time of each member, (…, members), where all share `times`, (…); a view that needs no memory."""
    return np.broadcast_to(times[..., None], (*times.shape, members))


def load(path: Path) -> Loaded:
    """The published part of a run in a store.

    The leaves of the trajectory are arrays on disk, read when they are indexed. For a run with `reduce` the result is
    a dict of numpy arrays instead.
    """
    import zarr

    metadata = dict(read_root(path)["attributes"])
    group: Any = zarr.open_group(str(path), mode="r", use_consolidated=True)
    if metadata["reduce"] is not None:
        return Loaded({name: array[...] for name, array in group.arrays()}, None, metadata)
    times, info = group["time"][...], StepInfo(group["residual"], group["converged"])
    failed = group["first_failure"][...] if metadata["progress"]["complete"] and "first_failure" in group else None
    return Loaded(Trajectory(times, states_in(group, times, metadata), info), failed, metadata)


def states_in(arrays: Any, times: np.ndarray, metadata: Table) -> State:
    """The states among the arrays of a store, whose attributes list them. A shared time has no array of its own."""
    leaves = metadata.get("leaves", ["q", "p"])
    found = {name: arrays[store_name(name)] for name in leaves if store_name(name) in arrays}
    found |= {name: arrays[name] for name in leaves if name in arrays}  # the names in stores of version 0.2
    if "t" in leaves and "t" not in found:
        found["t"] = shared_time(times, metadata["members"])
    return state_from_leaves(found)


def constants(path: Address, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The arrays of these names, which the run does not change."""
    import zarr

    store = open_storage(path).arrays()
    return {name: np.asarray(zarr.open_array(store, path=name, mode="r")[...]) for name in names}


def check(path: Path) -> None:
    """Raise ValueError if files of the store are missing or damaged; the message lists them and what can still be read.

    If the store grows meanwhile, its checkpoint is compared with the root of the same commit.
    """
    root = read_root(path)
    lost = list(_integrity.damage_of_checkpoint(path, root))
    while lost and (now := read_root(path)) != root:
        root, lost = now, list(_integrity.damage_of_checkpoint(path, now))
    _integrity.raise_if_damaged(path, itertools.chain(lost, _integrity.damage(path, root)))


def read_root(path: Path) -> Table:
    """The store's root metadata."""
    try:
        return checked_root((path / ROOT).read_bytes(), path)
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} does not exist, or is not the store of a run") from None


def checked_root(data: bytes, path: Address) -> Table:
    """The root metadata of the store at `path` from its bytes."""
    try:
        root = json.loads(data)
    except ValueError as error:
        raise ValueError(
            f"{path}/{ROOT} is damaged: {error}. The arrays next to it can still be read one by one"
        ) from None
    attributes = root.get("attributes", {})
    if "progress" not in attributes:
        raise ValueError(f"{path} is a Zarr group, but was not written by lieint")
    if "format" not in attributes:
        raise ValueError(f"{path} was written by version 0.1: only its states can be read, by xarray.open_zarr")
    if attributes["format"] > FORMAT:
        raise ValueError(
            f"{path} has format {attributes['format']}; this lieint_jax reads formats up to {FORMAT}: use a newer one"
        )
    if "checksum" in attributes and attributes["checksum"] != _integrity.checksum(root):
        raise ValueError(f"{path}/{ROOT} is damaged: its checksum is wrong. The arrays next to it can still be read")
    return root


class Column(NamedTuple):
    """The description of one array of a store.

    Attributes:
        shape, dtype, chunks: those of the complete run.
        dims: the names of its axes.
        attributes: its units and long name.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    attributes: Table


class Part(NamedTuple):
    """A slab to write into the array `name`: `values`, starting at index `at`, over the whole of all further axes."""

    name: str
    at: tuple[int, ...]
    values: np.ndarray


class Commit(NamedTuple):
    """An addition to a store.

    Attributes:
        row: the row of chunks along time that it fills, or None.
        progress: the progress that it publishes.
    """

    row: int | None
    progress: Table


class BackgroundWriter(abc.ABC):
    """A store, open for writing: a thread writes a commit while the run goes on.

    Attributes:
        path: its address.
    """

    def __init__(self, path: Address) -> None:
        self.path = path
        self._writing: Future[dict[str, int]] | None = None
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="lieint-store")

    @property
    @abc.abstractmethod
    def attributes(self) -> Table:
        """The attributes of the store."""

    @property
    @abc.abstractmethod
    def progress(self) -> Table:
        """The state of the published run: its commits, entries along time, steps, and whether it is complete."""

    @abc.abstractmethod
    def carry(self, members: range) -> dict[str, np.ndarray]:
        """The arrays of the published checkpoint by name, for these members."""

    @abc.abstractmethod
    def _write(self, parts: Iterable[Part], commit: Commit) -> dict[str, int]:
        """Write a commit, and return the checksums of its files that other processes need."""

    def checksums(self, commit: Commit) -> np.ndarray:
        """The checksums of the commit's files: those that this process has written, and 0 for those of others."""
        return self._checksums(commit, self._writing.result() if self._writing is not None else {})

    @abc.abstractmethod
    def _checksums(self, commit: Commit, written: Mapping[str, int]) -> np.ndarray:
        """The same, given what `_write` has returned."""

    def publish(self, commit: Commit, checksums: np.ndarray) -> None:
        """Make the last commit visible, after every process has written it; `checksums` are those of all processes."""
        try:
            self._publish(commit, checksums)
        except OSError as error:
            raise self._write_error(error) from error

    @abc.abstractmethod
    def _publish(self, commit: Commit, checksums: np.ndarray) -> None:
        """The same; an OSError is not yet a sentence."""

    def write(self, parts: Callable[[], Iterable[Part]], commit: Commit, alone: bool) -> None:
        """Start writing a commit in the background, and publish it there if this process is the only one of the run.

        The previous commit must have been published.
        """

        def work() -> dict[str, int]:
            written = self._write(parts(), commit)
            if alone:
                self._publish(commit, self._checksums(commit, written))
            return written

        self._writing = self._writer.submit(work)

    @property
    def is_written(self) -> bool:
        """True if this process' part of the last commit is on disk. Raises OSError if it could not be written."""
        if self._writing is None or not self._writing.done():
            return self._writing is None
        try:
            self._writing.result()
        except OSError as error:
            raise self._write_error(error) from error
        return True

    def _write_error(self, error: OSError) -> OSError:
        reason = error.strerror or str(error)
        steps = self.progress["steps"]
        return OSError(
            error.errno, f"{reason}: {self.path} holds everything up to step {steps}; fix the cause and resume"
        )

    def close(self) -> None:
        """Wait for the background thread."""
        self._writer.shutdown()


class Writer(BackgroundWriter):
    """A run's store, open for writing.

    A commit is a set of parts that belong together: whole chunks of the arrays, and the checkpoint from which a run
    is resumed. A background thread writes them, each file under a temporary name first, and syncs them to disk. Then
    `publish` renames a new version of one file, the metadata at the root, over the old one. That file holds the lengths
    of all arrays, so that readers and resumed runs see either all of a commit or nothing of it. The checkpoint is a
    file for each chunk of members, in one of two slots, used alternately, so that the valid one is never written to;
    it is removed when the run is complete. The root also records by checksums which files belong to the commit: see
    `_integrity`.

    Every process of a run writes the chunks of its own members; the first process publishes.
    """

    def __init__(self, path: Path, leader: bool) -> None:
        super().__init__(path)
        self.path = path
        self._leader = leader
        self._lock = lock_folder(path) if leader else None
        self._arrays: dict[str, Any] = {}  # of zarr
        self._durable = {path}  # folders that this process knows to be in the lists of their parents on disk

    @cached_property
    def attributes(self) -> Table:
        """The attributes of the root; read once, when the first process has locked the store."""
        return read_root(self.path)["attributes"]

    @property
    def progress(self) -> Table:
        """The state of the published run: its commits, entries along time, steps, and whether it is complete."""
        return self.attributes["progress"]

    def carry(self, members: range) -> dict[str, np.ndarray]:
        """See `BackgroundWriter`."""
        chunk, attributes = self.attributes["member_chunk"], self.attributes
        numbers = range(members.start // chunk, -(-members.stop // chunk))
        slot = attributes["progress"]["commits"] % 2
        states = [_integrity.state_of_chunk(self.path, attributes, slot, k).arrays for k in numbers]
        own = slice(members.start - numbers.start * chunk, members.stop - numbers.start * chunk)
        return {name: np.concatenate([arrays[name] for arrays in states])[own] for name in states[0]}

    def _checksums(self, commit: Commit, written: Mapping[str, int]) -> np.ndarray:
        return np.array([written.get(file, 0) for files in self._files(commit).values() for file in files], np.uint32)

    def _publish(self, commit: Commit, checksums: np.ndarray) -> None:
        if self._leader:
            digests = self.attributes["digests"] | self._digests(commit, checksums)
            attributes = self.attributes | {"progress": commit.progress, "digests": digests}
            _write_root(self.path, read_root(self.path) | {"attributes": attributes}, self._metas)
            self.attributes = attributes
            if self.progress["complete"]:
                shutil.rmtree(self.path / CHECKPOINT, ignore_errors=True)
        self.attributes = self.attributes | {"progress": commit.progress}  # pyright: ignore

    def _digests(self, commit: Commit, checksums: np.ndarray) -> Table:
        """Record the checksums of a commit's row of chunks along time, and return the digests that it changes."""
        files = self._files(commit)
        ends = np.cumsum([len(group) for group in files.values()])[:-1]
        parts = dict(zip(files, np.split(checksums, ends), strict=True))
        row, checkpoint = parts.pop(CHECKSUMS), parts.pop(CHECKPOINT)
        if commit.row is not None:
            self._write([Part(CHECKSUMS, (commit.row,), row[None])])
            self._hash_of_rows.update(np.asarray(row, "<u4").tobytes())
        arrays = {name: _integrity.digest_of(found) for name, found in parts.items()}
        return {
            "rows": self._hash_of_rows.hexdigest()[:16],
            "checkpoint": None if commit.progress["complete"] else _integrity.digest_of(checkpoint),
            "arrays": self.attributes["digests"]["arrays"] | arrays,
        }

    def _files(self, commit: Commit) -> dict[str, list[str]]:
        """The files of a commit, by the record that holds their checksums."""
        metas = self._metas
        row = [] if commit.row is None else _integrity.files_of_rows(metas, commit.row)
        found = {
            CHECKSUMS: row,
            CHECKPOINT: _integrity.files_of_checkpoint(self.attributes, commit.progress["commits"]),
        }
        if commit.progress["complete"]:
            found[CHECKPOINT] = []
            names = [name for name in _results(metas) if not _integrity.is_along_time(metas[name])]
            found |= {name: _integrity.chunk_files(name, metas[name]) for name in names if name not in self._constants}
        return found

    @property
    def _constants(self) -> Mapping[str, str]:
        """The arrays that were written when the store was created."""
        return self.attributes["digests"]["arrays"]

    @cached_property
    def _metas(self) -> Table:
        """The metadata of the store's arrays."""
        return _integrity.metadata(self.path, self.attributes["digests"]["metadata"])

    @cached_property
    def _hash_of_rows(self) -> Any:
        """The running hash of the checksums of all published rows of chunks."""
        rows = _integrity.published_rows(self.attributes)
        return hashlib.sha256(_integrity.checksums_of_rows(self.path, rows).tobytes())

    def close(self) -> None:
        """Wait for the background thread, and release the lock."""
        super().close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            import zarr

            with write_every_chunk():
                self._arrays[name] = zarr.open_array(str(self.path / name), mode="r+")
        return self._arrays[name]

    def _write(self, parts: Iterable[Part], commit: Commit | None = None) -> dict[str, int]:
        """Write slabs to disk, and return the checksums of their files."""
        folders: set[Path] = set()
        checksums: dict[str, int] = {}
        carry: dict[str, np.ndarray] = {}
        first = 0
        for name, at, values in parts:
            if name.startswith(f"{CHECKPOINT}/"):
                first, carry[name.removeprefix(f"{CHECKPOINT}/")] = at[0], values
                continue
            array = self._array(name)
            index = tuple(slice(a, a + n) for a, n in zip(at, values.shape, strict=False))
            array[index] = values
            spans = [range(s.start // c, -(-s.stop // c)) for s, c in zip(index, array.chunks, strict=False)]
            for key in itertools.product(*spans):
                rest = ["0"] * (array.ndim - len(key))
                file = "/".join((name, "c", *map(str, key), *rest))
                checksums[file] = _integrity.checksum_of_file(self.path / file)
                sync(self.path / file)
                folders |= self._changed_by(self.path / file)
        for folder in folders:
            sync(folder)
        return checksums | (self._write_states(carry, first, commit.progress) if carry and commit else {})

    def _changed_by(self, file: Path) -> set[Path]:
        """The folders whose lists of entries are not yet on disk after a file is written."""
        folder = file.parent
        found = {folder}
        while folder not in self._durable:
            self._durable.add(folder)
            folder = folder.parent
            found.add(folder)
        return found

    def _write_states(self, carry: dict[str, np.ndarray], first: int, progress: Table) -> dict[str, int]:
        """Write the checkpoint of the members from `first` on, a file for each chunk, and return the checksums."""
        chunk, checksums = self.attributes["member_chunk"], {}
        files = _integrity.files_of_checkpoint(self.attributes, progress["commits"])
        for k in range(first // chunk, -(-(first + len(carry["failed"])) // chunk)):
            own = slice(k * chunk - first, (k + 1) * chunk - first)
            state = PartState(progress, {name: x[own] for name, x in carry.items()})
            data = state.encode(_integrity.place_of_chunk(self.attributes, k))
            Disk(self.path).put(files[k], data)
            checksums[files[k]] = _integrity.tail(data)
        return checksums


def create(
    path: Path,
    columns: Mapping[str, Column],
    attributes: Table,
    constants: Mapping[str, tuple[Column, np.ndarray]],
) -> None:
    """Create a store under a temporary name and rename it, so that it never exists in part.

    It is empty except for the `constants`, arrays that the run does not change.

    Raises:
        ValueError: another run has created it in the meantime. Nothing is left behind.
        OSError: the folder cannot be created.
    """
    _remove_stale(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}-{os.urandom(4).hex()}.partial")
    try:
        unfinished.mkdir(parents=True)
        _fill(unfinished, columns, attributes, constants)
        for file in unfinished.rglob("*"):
            sync(file)
        unfinished.rename(path)
        sync(path.parent)
    except OSError as error:
        if os.path.lexists(path):
            raise ValueError(f"{path} was created by another run in the meantime, and is not overwritten") from None
        raise OSError(error.errno, f"{path} cannot be created: {error.strerror}; choose another store") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _fill(
    folder: Path,
    columns: Mapping[str, Column],
    attributes: Table,
    constants: Mapping[str, tuple[Column, np.ndarray]],
) -> None:
    """Create the arrays of a store in a folder, then write the constants and at last the metadata at the root."""
    import zarr

    start = {"commits": 0, "entries": 0, "steps": 0, "complete": False}
    group = zarr.create_group(str(folder), attributes=dict(attributes) | {"progress": start})
    named = {**columns, **{name: column for name, (column, _) in constants.items()}}
    for name, column in named.items():
        add_array(group, name, column)
    metas = _integrity.metadata(folder, named)
    files, [length], [chunk] = len(_integrity.files_of_rows(metas, 0)), columns["time"].shape, columns["time"].chunks
    rows = -(-length // chunk)
    chunks = min(rows, max(1, _MAX_RECORDS // files)), files
    add_array(group, CHECKSUMS, Column((rows, files), np.dtype(np.uint32), chunks, ("row", "file"), {}))
    with write_every_chunk():
        for name, (_, values) in constants.items():
            zarr.open_array(str(folder / name), mode="r+")[...] = values
    digests = {
        "metadata": {name: _integrity.digest((folder / name / ROOT).read_bytes()) for name in (*named, CHECKSUMS)},
        "arrays": {name: _integrity.digest_of_array(folder, name, metas[name]) for name in constants},
        "rows": _integrity.digest(b""),
        "checkpoint": None,
    }
    root = json.loads((folder / ROOT).read_text(encoding="utf-8"))
    _write_root(folder, root | {"attributes": root["attributes"] | {"digests": digests}}, metas)


def add_array(group: Any, name: str, column: Column) -> None:
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
        fill_value=missing,
        compressors=[zarr.codecs.ZstdCodec(level=_LEVEL), zarr.codecs.Crc32cCodec()],
    )


def _remove_stale(path: Path) -> None:
    """Remove unfinished folders of stores at `path` that a process left long ago when it was killed."""
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > _STALE:
                shutil.rmtree(folder)


def write_every_chunk() -> contextlib.AbstractContextManager[object]:
    """A context whose newly opened arrays write chunks of fill values too, so that every missing file is a lost one."""
    import zarr

    return zarr.config.set({"array.write_empty_chunks": True})


def clean(path: Path) -> None:
    """Remove what a killed writer left: temporary files, and the checkpoint of a complete run."""
    for file in path.rglob("*.partial"):
        file.unlink()
    if read_root(path)["attributes"]["progress"]["complete"]:
        shutil.rmtree(path / CHECKPOINT, ignore_errors=True)


def _write_root(path: Path, root: Table, metas: Mapping[str, Table]) -> None:
    """Replace the root's metadata: its attributes, and the list of the arrays for readers with their current lengths.

    That list is Zarr's consolidated metadata, on which readers such as xarray rely. Arrays whose values are written at
    the end of the run are added to it at the end.
    """
    attributes, shown = root["attributes"], {}
    for name in sorted(_results(metas)):
        if _integrity.is_along_time(metas[name]):
            shown[name] = metas[name] | {"shape": [attributes["progress"]["entries"], *metas[name]["shape"][1:]]}
        elif name in attributes["digests"]["arrays"]:
            shown[name] = metas[name]
    root = root | {"consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": shown}}
    root["attributes"] = attributes | {"checksum": _integrity.checksum(root)}
    Disk(path).put(ROOT, json.dumps(root, indent=1).encode())


def _results(metas: Mapping[str, Table]) -> list[str]:
    """The arrays of a store for readers: all but the checkpoint and the checksums."""
    return [name for name in metas if name != CHECKSUMS and not name.startswith(f"{CHECKPOINT}/")]
