"""A run in a folder NAME.zarr, in the Zarr 3 format. Nothing that is already there is ever overwritten.

The store grows while the run goes on, and the run can be continued after an end of any kind: see `Writer`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.ensemble import _integrity
from lieint_jax.ensemble._leaves import shared_time, state_of
from lieint_jax.types import State, StepInfo, Trajectory

FORMAT = 2  # of the stores written here; those of version 0.1 have no number
_ROOT = "zarr.json"  # the metadata of a Zarr 3 group; new data become visible when it is replaced
_CHECKPOINT = "checkpoint"  # the group that a run is resumed from


def load(path: Path) -> tuple[Any, dict[str, Any]]:
    """The complete part of a run in a store, and the store's attributes.

    The leaves of the trajectory are arrays on disk, read when they are indexed. A run with `reduce` gives a dict of
    numpy arrays instead.
    """
    import zarr

    metadata = dict(_root(path)["attributes"])
    group: Any = zarr.open_group(str(path), mode="r", use_consolidated=True)
    if metadata["reduce"] is not None:
        return {name: array[...] for name, array in group.arrays()}, metadata
    times, info = group["time"][...], StepInfo(group["residual"], group["converged"])
    return Trajectory(times, states(group, times, metadata), info), metadata


def states(arrays: Any, times: np.ndarray, metadata: Mapping[str, Any]) -> State:
    """The states among the arrays of a store, whose attributes list them; a time that members share has none."""
    leaves = metadata.get("leaves", ["q", "p"])
    found = {name: arrays[name] for name in leaves if name in arrays}
    if "t" in leaves and "t" not in found:
        found["t"] = shared_time(times, metadata["members"])
    return state_of(found)


def constants(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The arrays of these names that the run does not change."""
    import zarr

    return {name: np.asarray(zarr.open_array(str(path / name), mode="r")[...]) for name in names}


def check(path: Path) -> None:
    """ValueError if a file of the store is missing or damaged: says which, and what can still be read."""
    _integrity.check(path, _root(path))


def _root(path: Path) -> dict[str, Any]:
    """The store's root metadata."""
    try:
        root = json.loads((path / _ROOT).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path} is not there, or is no store of a run") from None
    except ValueError as error:
        raise ValueError(
            f"{path / _ROOT} is damaged: {error}. The arrays beside it can still be read one by one"
        ) from None
    attributes = root.get("attributes", {})
    if "progress" not in attributes:
        raise ValueError(f"{path} is a Zarr group, but not one that lieint wrote")
    if attributes.get("format", 1) > FORMAT:
        raise ValueError(
            f"{path} has format {attributes['format']}; this lieint_jax reads up to {FORMAT}: take a newer one"
        )
    if "checksum" in attributes and attributes["checksum"] != _integrity.checksum(root):
        raise ValueError(f"{path / _ROOT} is damaged: its checksum is wrong. The arrays beside it can still be read")
    return root


class Column(NamedTuple):
    """One array of a store.

    Attributes:
        shape, dtype, chunks: of the complete run.
        dims: names of its axes.
        attributes: units, a long name.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    attributes: Mapping[str, Any]


class Part(NamedTuple):
    """A slab to write into the array `name`: `values`, beginning at index `at`; axes beyond those of `at` are whole."""

    name: str
    at: tuple[int, ...]
    values: np.ndarray


class Writer:
    """A run's store, open for writing.

    A commit is a set of parts that belong together: whole chunks of the arrays, and the checkpoint from which a run
    is resumed. A background thread writes them, each file under a temporary name first, and syncs them to disk. Then
    `publish` replaces one file, the metadata at the root, by rename: it holds the lengths of all arrays, so that
    readers (and a run that is resumed) see either all of a commit or nothing of it. The checkpoint has two slots, used
    in turn, so that the valid one is never written to; it is removed when the run is complete.

    Every process of a run writes the chunks of its own members; the first one publishes.
    """

    def __init__(self, path: Path, leader: bool) -> None:
        self.path = path
        self.attributes: dict[str, Any] = _root(path)["attributes"]
        self._leader = leader
        self._writing: Future[None] | None = None
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="lieint-store")
        self._lock = _lock(path) if leader else None
        self._arrays: dict[str, Any] = {}

    @property
    def progress(self) -> dict[str, Any]:
        """The state of the published run: commits, entries along time, steps, whether it is complete."""
        return self.attributes["progress"]

    def read(self, name: str, index: Any) -> np.ndarray:
        """The values of an array of the store at `index`."""
        return np.asarray(self._array(name)[index])

    def write(self, parts: Callable[[], Iterable[Part]]) -> None:
        """Begin to write a commit in the background; the previous one must have been published."""
        self._writing = self._writer.submit(self._write, parts)

    @property
    def written(self) -> bool:
        """True if this process' part of the last commit is on disk; raises OSError if writing it failed."""
        if self._writing is None or not self._writing.done():
            return self._writing is None
        try:
            self._writing.result()
        except OSError as error:
            raise self._unwritten(error) from error
        return True

    def publish(self, **progress: Any) -> None:
        """Make the last commit visible, after every process has written it."""
        self.attributes = self.attributes | {"progress": self.progress | progress}
        if self._leader:
            root = _root(self.path)
            try:
                _write_root(self.path, root | {"attributes": self.attributes})
            except OSError as error:
                raise self._unwritten(error) from error
            if self.progress["complete"]:
                shutil.rmtree(self.path / _CHECKPOINT)

    def _unwritten(self, error: OSError) -> OSError:
        steps = _root(self.path)["attributes"]["progress"]["steps"]
        reason = f"{error.strerror}: {self.path} holds everything up to step {steps}; mend this and resume"
        return OSError(error.errno, reason)

    def close(self) -> None:
        """Wait for the background thread, and release the lock."""
        self._writer.shutdown()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            import zarr

            with _every_chunk():
                self._arrays[name] = zarr.open_array(str(self.path / name), mode="r+")
        return self._arrays[name]

    def _write(self, parts: Callable[[], Iterable[Part]]) -> None:
        folders: set[Path] = set()
        for name, at, values in parts():
            array = self._array(name)
            index = tuple(slice(a, a + n) for a, n in zip(at, values.shape, strict=False))
            array[index] = values
            spans = [range(s.start // c, -(-s.stop // c)) for s, c in zip(index, array.chunks, strict=False)]
            for key in itertools.product(*spans):
                file = self.path / name / "c" / "/".join(map(str, key))
                rest = array.ndim - len(key)
                file = file.joinpath(*["0"] * rest)
                _sync(file)
                folders.update(list(file.parents)[: array.ndim + 1])
        for folder in folders:
            _sync(folder)


def create(
    path: Path,
    columns: Mapping[str, Column],
    checkpoint: Mapping[str, Column],
    attributes: Mapping[str, Any],
    constants: Mapping[str, tuple[Column, np.ndarray]],
) -> None:
    """Make a store, under a temporary name, and rename it: a store exists whole or not at all.

    It is empty but for the `constants`, arrays that the run does not change.
    """
    import zarr
    import zarr.codecs

    unfinished = path.with_name(f".{path.name}.partial")
    if unfinished.exists():
        shutil.rmtree(unfinished)
    start = {"commits": 0, "entries": 0, "steps": 0, "complete": False}
    group = zarr.create_group(str(unfinished), attributes=dict(attributes) | {"progress": start})
    slots = {f"{_CHECKPOINT}/{name}": column for name, column in checkpoint.items()}
    fixed = {name: column for name, (column, _) in constants.items()}
    for name, (shape, dtype, chunks, dims, extra) in {**columns, **slots, **fixed}.items():
        missing = np.nan if np.issubdtype(dtype, np.floating) else -1 if np.issubdtype(dtype, np.integer) else False
        group.create_array(
            name,
            shape=shape,
            dtype=dtype,
            chunks=chunks,
            dimension_names=dims,
            attributes=dict(extra),
            fill_value=missing,
            compressors=[zarr.codecs.ZstdCodec(), zarr.codecs.Crc32cCodec()],
        )
    with _every_chunk():
        for name, (_, values) in constants.items():
            zarr.open_array(str(unfinished / name), mode="r+")[...] = values
    _write_root(unfinished, json.loads((unfinished / _ROOT).read_text()))
    for file in unfinished.rglob("*"):
        _sync(file)
    unfinished.rename(path)
    _sync(path.parent)


def _every_chunk() -> Any:
    """A context in which arrays opened write chunks of fill values too: a file that is missing is one that was lost."""
    import zarr

    return zarr.config.set({"array.write_empty_chunks": True})


def clean(path: Path) -> None:
    """Remove what a killed writer left: temporary files, and the checkpoint of a run that is complete."""
    for file in path.rglob("*.partial"):
        file.unlink()
    if _root(path)["attributes"]["progress"]["complete"]:
        shutil.rmtree(path / _CHECKPOINT, ignore_errors=True)


def _write_root(path: Path, root: dict[str, Any]) -> None:
    """Replace the root's metadata: its attributes, and the list of the arrays that readers see, with current lengths.

    That list is Zarr's consolidated metadata, on which readers (xarray among them) rely.
    """
    progress, shown = root["attributes"]["progress"], {}
    for file in sorted(path.glob(f"*/{_ROOT}")):
        meta = json.loads(file.read_text())
        if meta["node_type"] != "array":
            continue
        if (meta.get("dimension_names") or [""])[0] == "time":
            meta["shape"][0] = progress["entries"]
        elif not progress["complete"] and file.parent.name not in root["attributes"]["constants"]:
            continue  # its values are written at the end
        shown[file.parent.name] = meta
    root = root | {"consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": shown}}
    root["attributes"] = root["attributes"] | {"checksum": _integrity.checksum(root)}
    file = path / f"{_ROOT}.partial"
    with file.open("w") as f:
        f.write(json.dumps(root, indent=1))
        f.flush()
        os.fsync(f.fileno())
    file.rename(path / _ROOT)
    _sync(path)


def _sync(path: Path) -> None:
    """Wait until a file, or a folder's list of entries, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lock(path: Path) -> int | None:
    """Lock the store against a second run; the lock is released when the process ends, however it ends."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ValueError(f"another run is writing to {path}") from None
    except (ImportError, OSError):  # a system, or a file system, without locks
        pass
    return descriptor


def differences(stored: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The differences of two descriptions of a run, one line for each key."""
    lines = []
    for key in sorted(stored.keys() | now.keys()):
        a, b = stored.get(key), now.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += differences(a, b, f"{prefix}{key}.")
        elif a != b:
            lines.append(f"{prefix}{key} is {a!r} there and {b!r} here")
    return lines


def without_addresses(text: str) -> str:
    """`text` without memory addresses, which differ from process to process."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


@contextlib.contextmanager
def opened(path: Path, leader: bool) -> Any:
    """A `Writer` of the store at `path`, closed at the end."""
    writer = Writer(path, leader)
    try:
        yield writer
    finally:
        writer.close()
