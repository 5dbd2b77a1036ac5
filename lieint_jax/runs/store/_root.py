"""The root of a store: the description of its run, and the states of its parts.

A store NAME.zarr is written by one run or in parts by independent processes, which integrate ranges of its members
without communication. The root's metadata describe the run. Part k, of one or of many, has whole chunks of members: it
writes their files, and then replaces the file `parts/k/state`: its progress, the checksums of its files, and the carry
from which it is resumed. The replacement is the commit, one indivisible step, so that whoever reads sees all of a
commit or nothing of it. Entries of a part count as published if its state lists them; no published file is written
again.

Of a run in parts the arrays have their full shapes from the beginning; entries that do not exist yet are NaN, and
nobody writes the root again. Should a scheduler start one part twice, both write the same bytes into the chunks, and
every state that they put is complete in itself, so that the results are the same and nothing is lost. Of a run as a
whole the root is written again after each commit, with the lengths of the arrays and the progress: for other readers of
Zarr, who see the run up to the last commit or to the one before.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lieint_jax.runs._split import Split
from lieint_jax.runs._storage.arrays import (
    GROUP,
    ArrayMetadata,
    damage_of_chunks,
    damage_of_constants,
    digest,
    in_threads,
    raise_if_damaged,
)
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.leaves import STEP, Table
from lieint_jax.runs._storage.storage import ROOT, Address, Storage
from lieint_jax.runs._storage.untrusted import UnreadableError, parse_json, refuse_special, wrap_errors

if TYPE_CHECKING:
    from lieint_jax.runs._storage.metadata import Metadata

FORMAT = 8  # the number of the format of stores, the only one that is read
ROWS, ENDS = "checksums of rows", "checksums of the end"  # arrays of a state
CARRY = "checkpoint/"  # begins the names of its other arrays
_DIGEST = 32  # bytes at the end of a state
_MAX_HEADER = 2**20
START = {"commits": 0, "entries": 0, "steps": 0, "complete": False}


class PartState(NamedTuple):
    """The published state of a part.

    Attributes:
        progress: its commits, entries along time, steps, and whether it is complete.
        arrays: the checksums of its files, and the carry of an incomplete part by name.
        initial: the digest of the initial states of its members.
        machines: the processors, versions and engines that have computed it.
        problem: a sentence about a part that is missing or damaged, whose progress is that of the start; else None.
    """

    progress: Table
    arrays: dict[str, np.ndarray]
    initial: str = ""
    machines: tuple[Table, ...] = ()
    problem: str | None = None

    def encode(self, place: Table) -> bytes:
        """The bytes of a state: a line of JSON, the arrays, and a digest; `place` is its part and its run."""
        arrays = {name: np.ascontiguousarray(x) for name, x in sorted(self.arrays.items())}
        shapes = {name: [x.dtype.newbyteorder("<").str, x.shape] for name, x in arrays.items()}
        described = {"initial states": self.initial, "progress": self.progress, "arrays": shapes}
        described["machines"] = self.machines
        header = json.dumps({**place, **described}, sort_keys=True)
        little = [x.astype(x.dtype.newbyteorder("<"), copy=False) for x in arrays.values()]
        parts = [header.encode(), b"\n", *(x.reshape(-1).view(np.uint8).data for x in little)]
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
        return b"".join([*parts, digest.digest()])


class UnusablePartError(ValueError):
    """A part whose files are damaged or belong to another run; the message names them."""


def decode_state(data: bytes, place: Table) -> PartState:
    """The inverse of `PartState.encode`.

    Raises:
        UnusablePartError: damaged, or the state of another part or run.
    """
    from lieint_jax.runs._storage.metadata import StateHeader

    content = memoryview(data)[:-_DIGEST]
    if hashlib.sha256(content).digest() != data[-_DIGEST:]:
        raise UnusablePartError("its state is altered or cut off")
    end = data.find(b"\n", 0, _MAX_HEADER)
    if end < 0:
        raise UnusablePartError("its state has too long a header")
    table = json.loads(data[:end])
    header, arrays, begin = StateHeader.of(table), {}, end + 1
    for key in ("run", "part"):
        if getattr(header, key) != place[key]:
            raise UnusablePartError(f"its state is that of another {key}: the files were copied from elsewhere")
    for name, (kind, shape) in header.arrays.items():
        dtype = np.dtype(kind)
        size = math.prod(shape) * dtype.itemsize
        arrays[name] = np.frombuffer(content[begin : begin + size], dtype).reshape(shape)
        begin += size
    return PartState(table["progress"], arrays, header.initial, tuple(table["machines"]))


class Root:
    """The root of a store.

    Attributes:
        storage: its files.
        attributes: the attributes of the root, as JSON has them.
        metadata: the checked metadata.
        metas: the metadata of the arrays of the complete run by name.
        entries: the number of entries of the complete run.
        constants: the digests of the arrays that the run does not change.
        in_parts: whether several runs, or one into a bucket, write the store; else it is one run on a disk.
        split: its parts.
    """

    def __init__(self, storage: Storage, root: Table) -> None:
        from lieint_jax.runs._storage.metadata import Metadata

        self.storage, self._root, self.attributes = storage, root, root["attributes"]
        self.metadata: Metadata = Metadata.of(root)
        described = self.metadata.attributes
        self.in_parts = described.parts is not None
        self.split = Split(described.members, described.parts or 1, described.member_chunk)
        self.entries, self.constants = described.num_entries, described.digests.arrays
        self.metas = {name: meta.of_length(self.entries) for name, meta in self.metadata.arrays.items()}

    def place(self, k: int) -> Table:
        """Where the state of part k belongs: its part and its run."""
        shape = [self.split, self.attributes["time_chunk"], self.entries]
        run = json.dumps([self.attributes["run"], shape], sort_keys=True)
        return {"part": [k, self.split.parts], "run": digest(run.encode())}

    @staticmethod
    def folder(k: int) -> str:
        """The folder of part k, which its process locks."""
        return f"parts/{k}"

    @staticmethod
    def state_file(k: int) -> str:
        """The file of the state of part k."""
        return f"{Root.folder(k)}/state"

    def state(self, k: int) -> PartState | None:
        """The published state of part k; None if it has published nothing.

        Raises:
            UnusablePartError: it is damaged, or that of another part or run.
        """
        try:
            data = self.storage.read(self.state_file(k))
        except FileNotFoundError:
            return None
        try:
            state = decode_state(data, self.place(k))
            self._check_state(state)
        except UnusablePartError:
            raise
        except Exception as error:  # a crafted file can make json and numpy raise anything
            raise UnusablePartError(f"its state is no state of a part: {error}") from None
        return state

    def _check_state(self, state: PartState) -> None:
        progress = state.progress
        if progress["entries"] > self.entries or progress["complete"] != (progress["entries"] == self.entries):
            raise ValueError(f"it has {progress['entries']} of {self.entries} entries, and is not what it says")
        needed = {"residual", "converged", "failed", *self.attributes["leaves"]} - {"t"}  # a time may follow from n
        missing = needed - {name.removeprefix(CARRY) for name in state.arrays if name.startswith(CARRY)}
        if missing and not progress["complete"]:
            raise ValueError(f"it has no {min(missing)} of the states from which the run goes on")

    def show(self, progress: Table) -> None:
        """Let other readers of Zarr see the progress of a run as a whole."""
        if not self.in_parts and progress != self.attributes["progress"]:
            ordered = {key: progress[key] for key in START}  # whatever the order in which it was read
            self._root = self._root | {"attributes": self.attributes | {"progress": ordered}}
            self.storage.put(ROOT, encode_root(self._root, self.metas))
            self.attributes = self._root["attributes"]

    def files(self, k: int, row: int | None = None) -> list[str]:
        """The files of part k: those of a row of chunks along time, or those that are written at the end."""
        only = {"member": self.split.chunks(k), "part": range(k, k + 1)}
        if row is not None:
            only["time"] = range(row, row + 1)
        names = [name for name in sorted(self.metas) if name not in self.constants]
        chosen = [name for name in names if ("time" in self.metas[name].dims) == (row is not None)]
        return [f for name in chosen for f in self.metas[name].files(name, only)]

    def published_files(self, k: int, state: PartState) -> Iterator[tuple[str, int]]:
        """The published files of part k and their checksums."""
        rows = math.ceil(state.progress["entries"] / self.attributes["time_chunk"])
        groups = [(self.files(k, row), state.arrays[ROWS][row]) for row in range(rows)]
        if state.progress["complete"]:
            groups.append((self.files(k), state.arrays[ENDS]))
        for files, checksums in groups:
            yield from zip(files, checksums.tolist(), strict=True)

    def damage(self) -> Iterator[str]:
        """A line for each file of a run as a whole that is missing, altered, of another place or of another commit."""
        yield from self.damage_of_root()
        file, shown = self.state_file(0), self.attributes["progress"]
        try:
            state = self.state(0)
        except (UnusablePartError, OSError) as error:
            yield f"{file} is damaged: {error}"
            return
        if state is not None:
            yield from self.damage_of_part(0, state)
        found = START if state is None else state.progress
        if any(shown[key] > found[key] for key in ("entries", "steps", "complete")):
            yield (
                f"{file} is missing"
                if state is None
                else f"{file} is that of step {found['steps']}, and {ROOT} that of step {shown['steps']}: it was "
                "replaced, or copied while a run was writing it"
            )

    def damage_of_part(self, k: int, state: PartState) -> Iterator[str]:
        """A line for each published file of part k that is missing, altered or of another place."""
        try:
            expected = dict(self.published_files(k, state))
        except (KeyError, IndexError, ValueError):
            yield f"{self.state_file(k)} does not fit the arrays of the store"
            return
        yield from damage_of_chunks(self.storage, expected, self.metas)

    def damage_of_root(self) -> Iterator[str]:
        """A line for each file of the run's description that is missing or altered."""
        for name, expected in nodes_of(self.metas).items():
            try:
                same = parse_json(self.storage.read(f"{name}/{ROOT}")) == expected
            except (OSError, ValueError):
                same = False
            if not same:
                yield f"{name}/{ROOT} is missing or altered"
        yield from damage_of_constants(self.storage, self.constants, self.metas)

    def statuses(self, thorough: bool) -> list[PartState]:
        """The state of every part, without arrays, as far as it can be used; if `thorough`, by a look at its files."""
        return list(in_threads(lambda k: self._status(k, thorough), range(self.split.parts), self.storage))

    def _status(self, k: int, thorough: bool) -> PartState:
        try:
            state = self.state(k)
        except UnusablePartError as error:
            return PartState(START, {}, problem=f"is damaged: {error}")
        if state is None:
            return PartState(START, {}, problem="is missing: it was not started, or has published nothing yet")
        lost = next(self.damage_of_part(k, state), None) if thorough else None
        found = state._replace(arrays={})
        return found._replace(progress=START, problem=f"is damaged: {lost}") if lost else found

    def sentence(self, k: int, status: PartState) -> str | None:
        """A sentence about part k if it is missing, damaged or not complete, or None."""
        members = self.split.part(k)
        where = f"part {k} (members {members.start} … {members.stop - 1})"
        if status.problem:
            return f"{where} {status.problem}"
        if status.progress["complete"]:
            return None
        return f"{where} has {status.progress['entries']} of {self.entries} entries"


def nodes_of(metas: Mapping[str, ArrayMetadata]) -> dict[str, Table]:
    """The metadata of the group of the step, and of these arrays, by path."""
    return {STEP: GROUP} | {name: meta.to_json() for name, meta in metas.items()}


def encode_root(root: Table, metas: Mapping[str, ArrayMetadata]) -> bytes:
    """The file of a root: its attributes, and the metadata of the arrays by name, which are those of the complete run.

    Of a run as a whole they are shown with the lengths that are published.
    """
    attributes = root["attributes"]
    entries = None if "parts" in attributes else attributes["progress"]["entries"]
    shown = nodes_of({name: meta if entries is None else meta.of_length(entries) for name, meta in metas.items()})
    root = root | {"consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": shown}}
    return json.dumps(root | {"attributes": attributes | {"checksum": checksum(root)}}, indent=1).encode()


def checksum(root: Table) -> str:
    """The checksum of a store's root metadata, without its own entry."""
    attributes = {key: value for key, value in root["attributes"].items() if key != "checksum"}
    text = json.dumps({**root, "attributes": attributes}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def check_store(path: Address) -> Root:
    """Check the files of the store at `path`, and return its root.

    Of a run in parts only the description is checked: `_reading.load` checks its parts one by one.

    Raises:
        UnreadableError: not a store of lieint, or one that is being created; its description does not fit its arrays.
        ValueError: a damaged store; the message names the files.
    """
    root = open_root(path)
    with wrap_errors(path):
        lost = list(root.damage_of_root() if root.in_parts else root.damage())
        if lost and root.in_parts:
            if not root.storage.sizes("parts"):  # a bucket gets the root first, and results after all other files
                raise UnreadableError(
                    f"{path} has no results yet, and not all of its files: it is being created. Open it again when it "
                    "has; if its run was stopped, start that again"
                )
            lost = list(root.damage_of_root())
    raise_if_damaged(path, lost)
    return root


def open_root(path: Address) -> Root:
    """The root of the store at `path`, a folder NAME.zarr, a file NAME.zip or a URL, whose description is checked."""
    storage = open_storage(path)
    if isinstance(path, Path):
        refuse_special(path)
        if path.is_dir() == (path.suffix == ".zip"):
            raise UnreadableError(f"{path} is not the store of a run: that is a folder NAME.zarr, or a file NAME.zip")
    with wrap_errors(path):
        files = storage.check()
    with wrap_errors(path, passed=(ValueError,)):
        table = read_root(storage)
    if table is None:
        raise UnreadableError(
            f"there is no store {path}; li.run(…, store=…) and `lieint run NAME --out {path}` write one"
            if storage.is_remote
            else f"{path} does not exist, or is not the store of a run"
        )
    with wrap_errors(path):
        root = Root(storage, table)
        if not root.in_parts:
            root.metadata.check_chunks(files)
    if storage.is_remote and not root.in_parts:
        raise UnreadableError(f"{path} is a copy of a store that was written on a disk: copy it to a disk to read it")
    return root


def written_root(storage: Storage) -> Root:
    """The root of a store that this process has written."""
    table = read_root(storage)
    assert table is not None
    return Root(storage, table)


def read_root(storage: Storage) -> Table | None:
    """The root metadata of the store in a storage, whose checksum is right; None if there is no store."""
    path = storage.address
    try:
        data = storage.read(ROOT)
    except FileNotFoundError:
        return None
    try:
        root = parse_json(data)
    except ValueError as error:
        raise ValueError(
            f"{path}/{ROOT} is damaged: {error}. The arrays next to it can still be read one by one"
        ) from None
    attributes = root.get("attributes") if isinstance(root, dict) else None
    if not isinstance(attributes, dict) or "progress" not in attributes:
        raise ValueError(f"{path} is a Zarr group, but was not written by lieint")
    if (written := attributes.get("format", 1)) != FORMAT:
        raise ValueError(
            f"{path} has format {written}, that of {'an older' if written < FORMAT else 'a newer'} lieint_jax; this "
            f"one reads format {FORMAT} only: use that one, or read the arrays by xarray.open_zarr"
        )
    if attributes.get("checksum") != checksum(root):
        raise ValueError(f"{path}/{ROOT} is damaged: its checksum is wrong. The arrays next to it can still be read")
    return root
