"""A store in parts: independent processes integrate ranges of its members, without communication.

A store NAME.zarr in parts has the arrays of any store, with their full shapes from the beginning; entries that do not
exist yet are NaN. The root metadata describe the run, and nobody writes them after the first part has created them.
Part k has whole chunks of members. It writes their files, and then replaces the file `parts/k/state`: its progress, the
checksums of its files, and the carry from which it is resumed. The replacement is the commit, one indivisible step.
Entries of a part count as published if its state lists them.

No file is written by two parts. Should a scheduler start one part twice, both write the same bytes into the chunks, and
every state that they put is complete in itself, so that the results are the same and nothing is lost.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from lieint_jax.runs.store import _integrity, _store
from lieint_jax.runs.store._integrity import Table, checksum_of_bytes, part_of_array
from lieint_jax.runs.store._state_file import PartState, UnusablePartError, decode_state
from lieint_jax.runs.store._storage import Storage

ROWS, ENDS = "checksums of rows", "checksums of the end"  # arrays of a state
START = {"commits": 0, "entries": 0, "steps": 0, "complete": False}
REQUESTS = 16  # at the same time
_MAX_NAMED = 5  # parts in a message


class Split(NamedTuple):
    """The members of a run in parts of whole chunks.

    Attributes:
        members: their number.
        parts: the number of parts.
        chunk: the number of members in a chunk.
    """

    members: int
    parts: int
    chunk: int

    @classmethod
    def into_parts(cls, members: int, count: int, most: int) -> Split:
        """The split into `count` parts, with chunks of at most `most` members.

        Raises:
            ValueError: more parts than members.
        """
        if count > members:
            raise ValueError(f"a run of {members} member(s) has at most {members} part(s), got {count}")
        chunks = count * math.ceil(members / (count * most))
        chunk = math.ceil(members / chunks)
        return cls(members, count, chunk if math.ceil(members / chunk) == chunks else members // chunks)

    def chunks(self, k: int) -> range:
        """The chunks of part k."""
        every = math.ceil(self.members / self.chunk)
        return range(k * every // self.parts, (k + 1) * every // self.parts)

    def part(self, k: int) -> range:
        """The members of part k."""
        chunks = self.chunks(k)
        return range(chunks.start * self.chunk, min(chunks.stop * self.chunk, self.members))


class PartStatus(NamedTuple):
    """The state of a part, as far as it can be used.

    Attributes:
        number: which part.
        members: its members.
        progress: its published progress; that of the start if it is missing or damaged.
        problem: a sentence about a missing or damaged part, else None.
    """

    number: int
    members: range
    progress: Table
    problem: str | None

    def sentence(self, entries: int) -> str | None:
        """A sentence about a part that is not complete, or None. `entries` is the number of entries of the run."""
        where = f"part {self.number} (members {self.members.start} … {self.members.stop - 1})"
        if self.problem:
            return f"{where} {self.problem}"
        if self.progress["complete"]:
            return None
        return f"{where} has {self.progress['entries']} of {entries} entries"


class PartsRoot:
    """The root of a store in parts.

    Attributes:
        storage: its files.
        attributes: the attributes of the root.
        metas: the metadata of its arrays by name.
        split: its parts.
    """

    def __init__(self, storage: Storage, root: Table) -> None:
        self.storage, self.attributes = storage, root["attributes"]
        self.metas: Table = root["consolidated_metadata"]["metadata"]
        self.split = Split(*(self.attributes[key] for key in ("members", "parts", "member_chunk")))

    @property
    def entries(self) -> int:
        """The number of entries of the complete run."""
        return self.attributes["num_entries"]

    @property
    def constants(self) -> Mapping[str, str]:
        """The digests of the arrays that the run does not change."""
        return self.attributes["digests"]["arrays"]

    def place(self, k: int) -> Table:
        """Where the state of part k belongs: its part and its run."""
        shape = [self.split, self.attributes["time_chunk"], self.entries]
        run = json.dumps([self.attributes["run"], shape], sort_keys=True)
        return {"part": [k, self.split.parts], "run": _integrity.digest(run.encode())}

    @staticmethod
    def state_file(k: int) -> str:
        """The file of the state of part k."""
        return f"parts/{k}/state"

    def state(self, k: int) -> PartState | None:
        """The published state of part k; None if there is none.

        Raises:
            UnusablePartError: a damaged state, or that of another run.
        """
        try:
            data = self.storage.read(self.state_file(k))
        except FileNotFoundError:
            return None
        try:
            return decode_state(data, self.place(k))
        except UnusablePartError:
            raise
        except Exception as error:  # a crafted file can make json and numpy raise anything
            raise UnusablePartError(f"its state is no state of a part: {error}") from None

    def files(self, k: int, row: int | None = None) -> list[str]:
        """The files of part k: those of a row of chunks along time, or those that are written at the end."""
        only = {"member": self.split.chunks(k), "part": range(k, k + 1)}
        if row is not None:
            only["time"] = range(row, row + 1)
        names = [name for name in sorted(self.metas) if name not in self.constants]
        chosen = [name for name in names if ("time" in _integrity.dims_of(self.metas[name])) == (row is not None)]
        return [f for name in chosen for f in _integrity.chunk_files(name, self.metas[name], only=only)]

    def published_files(self, k: int, state: PartState) -> Iterator[tuple[str, int]]:
        """The published files of part k and their checksums."""
        rows = math.ceil(state.progress["entries"] / self.attributes["time_chunk"])
        groups = [(self.files(k, row), state.arrays[ROWS][row]) for row in range(rows)]
        if state.progress["complete"]:
            groups.append((self.files(k), state.arrays[ENDS]))
        for files, checksums in groups:
            yield from zip(files, checksums.tolist(), strict=True)

    def damage(self, k: int, state: PartState) -> Iterator[str]:
        """A line for each published file of part k that is missing, altered or of another place.

        Of files in a folder all bytes are compared with their checksums; of objects the checksums at their ends with
        those of the state, for which a request transfers four bytes.
        """
        try:
            expected = dict(self.published_files(k, state))
        except (KeyError, IndexError, ValueError):
            yield f"{self.state_file(k)} does not fit the arrays of the store"
            return
        for file, found in zip(expected, _in_threads(self._checksum, expected, self.storage), strict=True):
            if found != expected[file]:
                what = found if isinstance(found, str) else "the chunk of another place or another run"
                yield f"{file} is {what} ({part_of_array(file, self.metas)})"

    def _checksum(self, file: str) -> int | str:
        try:
            if self.storage.is_remote:
                return int.from_bytes(self.storage.tail(file), "little")
            return checksum_of_bytes(self.storage.read(file))
        except FileNotFoundError:
            return "missing"
        except OSError as error:
            return f"unreadable ({error.strerror or error})"

    def damage_of_root(self) -> Iterator[str]:
        """A line for each file of the run's description that is missing or altered."""
        digests = self.attributes["digests"]
        for name, expected in digests["metadata"].items():
            try:
                found = _integrity.digest(self.storage.read(f"{name}/zarr.json"))
            except FileNotFoundError:
                found = None
            if found != expected:
                yield f"{name}/zarr.json is missing or altered"
        for name, expected in digests["arrays"].items():
            found = [self._checksum(file) for file in _integrity.chunk_files(name, self.metas[name])]
            lost = [x for x in found if isinstance(x, str)]
            if lost or _integrity.digest_of(x for x in found if isinstance(x, int)) != expected:
                yield f"{name} is {lost[0] if lost else 'not as the run wrote it'}"

    def statuses(self, thorough: bool) -> list[PartStatus]:
        """The state of every part; if `thorough`, with a look at each of its files."""
        return list(_in_threads(lambda k: self.status(k, thorough), range(self.split.parts), self.storage))

    def status(self, k: int, thorough: bool) -> PartStatus:
        """The state of part k."""
        members = self.split.part(k)
        try:
            state = self.state(k)
        except UnusablePartError as error:
            return PartStatus(k, members, START, f"is damaged: {error}")
        if state is None:
            return PartStatus(k, members, START, "is missing: it was not started, or has published nothing yet")
        lost = next(self.damage(k, state), None) if thorough else None
        return PartStatus(k, members, START if lost else state.progress, lost and f"is damaged: {lost}")


def _in_threads(function: Any, values: Iterable[Any], storage: Storage) -> Iterator[Any]:
    """The results of a function that makes requests; many requests at the same time to object storage."""
    if not storage.is_remote:
        yield from map(function, values)
        return
    with ThreadPoolExecutor(REQUESTS) as pool:
        yield from pool.map(function, values)


def first_of(sentences: list[str]) -> str:
    """The first of several sentences about parts, for a message."""
    more = f"; and {len(sentences) - _MAX_NAMED} more" if len(sentences) > _MAX_NAMED else ""
    return f"{'; '.join(sentences[:_MAX_NAMED])}{more}"


def read_root(storage: Storage) -> Table | None:
    """The root metadata of the store in a storage; None if there is no store."""
    try:
        data = storage.read(_store.ROOT)
    except FileNotFoundError:
        return None
    return _store.checked_root(data, storage.address)
