"""The check that the files of a store are complete, unaltered, in their places and of one commit.

Every chunk ends with its own checksum (CRC-32C), and the store records these checksums by the places of the chunks.
Those of arrays along time are in the array `checksums`, with one row for each row of chunks. Those of all other arrays
and of the published commit's checkpoint are digests in the root. The root also holds digests of `checksums` itself and
of the metadata of each array.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lieint_jax.runs.store._state_file import PartState, Table, decode_state
from lieint_jax.runs.store._storage import Address

CHECKPOINT = "checkpoint"  # the group from which a run is resumed
CHECKSUMS = "checksums"  # the array of the checksums of chunks along time
_MAX_NAMED = 5  # damaged files in a message


def checksum(root: Table) -> str:
    """The checksum of a store's root metadata, without its own entry."""
    attributes = {key: value for key, value in root["attributes"].items() if key != "checksum"}
    text = json.dumps({**root, "attributes": attributes}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest(data: bytes) -> str:
    """The digest of the bytes of a file, or of checksums."""
    return hashlib.sha256(data).hexdigest()[:16]


def digest_of(checksums: Iterable[int]) -> str:
    """The digest of the checksums of an array's or a checkpoint's chunks, in order."""
    return digest(np.array(list(checksums), "<u4").tobytes())


def digest_of_array(path: Path, name: str, meta: Table) -> str:
    """The digest of the checksums of an array in a store."""
    return digest_of(checksum_of_file(path / file) for file in chunk_files(name, meta))


def metadata(path: Path, names: Iterable[str]) -> dict[str, Table]:
    """The metadata of the arrays of these names in a store."""
    return {name: json.loads((path / name / "zarr.json").read_text(encoding="utf-8")) for name in names}


def is_along_time(meta: Table) -> bool:
    """True for an array that grows during the run."""
    return dims_of(meta)[:1] == ["time"]


def dims_of(meta: Table) -> list[str]:
    """The names of an array's axes, which Zarr leaves out where there are none."""
    return meta.get("dimension_names") or []


def chunk_files(name: str, meta: Table, row: int | None = None, only: Mapping[str, range] | None = None) -> list[str]:
    """The files of an array's chunks, relative to the store: all of them, or those of one row of chunks.

    With `only`, those whose numbers along the dimensions of these names are in these ranges.
    """
    return ["/".join((name, "c", *map(str, key))) for key in _keys(meta, row, only or {})]


def files_of_rows(metas: Mapping[str, Table], row: int) -> list[str]:
    """The files of one row of chunks of all arrays along time, in the order of `checksums`."""
    names = sorted(name for name, meta in metas.items() if is_along_time(meta))
    return [file for name in names for file in chunk_files(name, metas[name], row)]


def files_of_checkpoint(attributes: Table, commit: int) -> list[str]:
    """The files of the checkpoint of a commit, one for each chunk of members."""
    chunks = -(-attributes["members"] // attributes["member_chunk"])
    return [f"{CHECKPOINT}/{commit % 2}/{k}" for k in range(chunks)]


def place_of_chunk(attributes: Table, k: int) -> Table:
    """Where the checkpoint of the k-th chunk of members belongs."""
    return {"part": [k, attributes["member_chunk"]], "run": digest(json.dumps(attributes["run"]).encode())}


def state_of_chunk(path: Path, attributes: Table, commit: int, k: int) -> PartState:
    """The checkpoint of a commit for the k-th chunk of members."""
    data = (path / files_of_checkpoint(attributes, commit)[k]).read_bytes()
    return decode_state(data, place_of_chunk(attributes, k))


def tail(data: bytes) -> int:
    """The last four bytes, those of a checksum or of a digest."""
    return int.from_bytes(data[-4:], "little")


def checksum_of_file(file: Path) -> int:
    """The checksum at the end of a chunk's file."""
    with file.open("rb") as f:
        f.seek(-4, 2)
        return tail(f.read(4))


def raise_if_damaged(path: Address, damage: Iterable[str]) -> None:
    """Raise a ValueError with the first lines of `damage`, if there are any."""
    lost = list(damage)
    if lost:
        more = f"; and {len(lost) - _MAX_NAMED} more" if len(lost) > _MAX_NAMED else ""
        raise ValueError(
            f"{path} is damaged: {'; '.join(lost[:_MAX_NAMED])}{more}. Everything else can still be read, for example "
            "by xarray.open_zarr; restore the files from a copy, repeat the copy while no run writes, or run again "
            "into another store"
        )


def damage(path: Path, root: Table) -> Iterator[str]:
    """A line for each missing or altered file of the published results, with the part that is lost."""
    progress, shown = root["attributes"]["progress"], root["consolidated_metadata"]["metadata"]
    digests = root["attributes"].get("digests")
    if digests is None:  # a store of version 0.2 or older
        yield from _damage_by_chunks(path, shown)
        return
    names = [name for name in digests["metadata"] if not (progress["complete"] and name.startswith(f"{CHECKPOINT}/"))]
    lost = [name for name in names if _digest_of_file(path / name / "zarr.json") != digests["metadata"][name]]
    yield from (f"{name}/zarr.json is missing or altered" for name in lost)
    whole = set(names) - set(lost)
    for name in sorted(whole & digests["arrays"].keys()):
        meta = shown[name]
        yield from _damage_of_array(path, chunk_files(name, meta), {name: meta}, digests["arrays"][name], name)
    if CHECKSUMS in whole:
        yield from _damage_along_time(path, shown, root)


def damage_of_checkpoint(path: Path, root: Table) -> Iterator[str]:
    """A line for each missing or altered file of the published commit's checkpoint."""
    attributes = root["attributes"]
    progress = attributes["progress"]
    if attributes["format"] < 5 or progress["complete"] or not progress["commits"]:
        return
    lost, sums = [], []
    for k, file in enumerate(files_of_checkpoint(attributes, progress["commits"])):
        try:
            sums.append(tail((path / file).read_bytes()))
            state_of_chunk(path, attributes, progress["commits"], k)
        except FileNotFoundError:
            lost.append(f"{file} is missing")
        except OSError as error:
            lost.append(f"{file} is unreadable ({error.strerror})")
        except Exception as reason:  # a crafted file can make json and numpy raise anything
            lost.append(f"{file} is altered: {reason}")
    yield from lost
    if not lost and digest_of(sums) != attributes["digests"]["checkpoint"]:
        found = state_of_chunk(path, attributes, progress["commits"], 0).progress
        yield (
            f"{CHECKPOINT} is not as the run wrote it: the checkpoint of commit {progress['commits']}, step "
            f"{progress['steps']} (found: commit {found['commits']}, step {found['steps']}) was replaced, or copied "
            "while a run was writing it"
        )


def _damage_of_array(
    path: Path, files: list[str], metas: Mapping[str, Table], expected: str, what: str
) -> Iterator[str]:
    """A line for each damaged chunk; if there is none, one line if the digest of all differs from `expected`."""
    found = [_checksum(path / file) for file in files]
    sums = [checksum for checksum in found if isinstance(checksum, int)]
    if len(sums) < len(files):
        yield from _damage_of_files(path, files, metas)
    elif digest_of(sums) != expected:
        folder = files[0].partition("/")[0]
        yield f"{folder} is not as the run wrote it: {what} was replaced, or copied while a run was writing it"


def _damage_of_files(
    path: Path, files: Iterable[str], metas: Mapping[str, Table], summed: bool = True
) -> Iterator[str]:
    """A line for each of these chunks whose file is missing, unreadable or altered."""
    for file in files:
        found = _checksum(path / file, summed)
        if isinstance(found, str):
            yield f"{file} is {found} ({part_of_array(file, metas)})"


def _damage_along_time(path: Path, metas: Mapping[str, Table], root: Table) -> Iterator[str]:
    """A line for each missing, altered or misplaced file of the arrays along time."""
    rows = published_rows(root["attributes"])
    own = metadata(path, [CHECKSUMS])
    chunks = math.ceil(rows / own[CHECKSUMS]["chunk_grid"]["configuration"]["chunk_shape"][0])
    files = [file for row in range(chunks) for file in chunk_files(CHECKSUMS, own[CHECKSUMS], row)]
    lost = list(_damage_of_files(path, files, own))
    if lost:
        yield from lost
        return
    recorded = checksums_of_rows(path, rows)
    if digest(recorded.tobytes()) != root["attributes"]["digests"]["rows"]:
        yield f"{CHECKSUMS} is not that of the last commit: it was replaced, or copied while a run was writing it"
        return
    for row in range(rows):
        for file, expected in zip(files_of_rows(metas, row), recorded[row].tolist(), strict=False):
            found = _checksum(path / file)
            if isinstance(found, int) and found != expected:
                found = "the chunk of another place or another run"
            if isinstance(found, str):
                yield f"{file} is {found} ({part_of_array(file, metas)})"


def published_rows(attributes: Table) -> int:
    """The number of published rows of chunks along time."""
    return math.ceil(attributes["progress"]["entries"] / attributes["time_chunk"])


def checksums_of_rows(path: Path, rows: int) -> np.ndarray:
    """The recorded checksums of the first rows of chunks along time, shape (rows, files)."""
    import zarr

    return np.asarray(zarr.open_array(str(path / CHECKSUMS), mode="r")[:rows], "<u4")


def _damage_by_chunks(path: Path, shown: Mapping[str, Table]) -> Iterator[str]:
    """The damage of a store that records no checksums; only those inside the chunks, if there are any, are compared."""
    for name, meta in shown.items():
        own = _read_json(path / name / "zarr.json")
        if own is None or {**own, "shape": own["shape"][1:]} != {**meta, "shape": meta["shape"][1:]}:
            yield f"{name}/zarr.json is missing or altered"
        yield from _damage_of_files(path, chunk_files(name, meta), shown, meta["codecs"][-1]["name"] == "crc32c")


def _keys(meta: Table, row: int | None, only: Mapping[str, range]) -> Iterator[tuple[int, ...]]:
    """The keys of an array's chunks, or of some of them: see `chunk_files`."""
    sizes = meta["chunk_grid"]["configuration"]["chunk_shape"]
    spans = [range(math.ceil(n / size)) for n, size in zip(meta["shape"], sizes, strict=True)]
    if row is not None:
        spans[0] = range(row, row + 1)
    dims = meta.get("dimension_names") or [""] * len(spans)
    return itertools.product(*(only.get(dim, span) for dim, span in zip(dims, spans, strict=True)))


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _digest_of_file(file: Path) -> str | None:
    try:
        return digest(file.read_bytes())
    except OSError:
        return None


def part_of_array(file: str, metas: Mapping[str, Table]) -> str:
    """The part of an array in a chunk's file, in words."""
    name, _, key = file.rpartition("/c")
    meta, keys = metas[name], [int(k) for k in key.split("/")[1:]]
    axes = meta.get("dimension_names") or [f"axis {i}" for i in range(len(keys))]
    sizes = meta["chunk_grid"]["configuration"]["chunk_shape"]
    part = [
        f"{axis} {k * size} … {min((k + 1) * size, n) - 1}"
        for axis, k, size, n in zip(axes, keys, sizes, meta["shape"], strict=True)
        if n > size or axis in ("time", "member")
    ]
    return f"{name} of {', '.join(part)}" if part else name


def _checksum(file: Path, summed: bool = True) -> int | str:
    """The checksum of a chunk's file, 0 if it has none; a word if the file is missing, unreadable or altered."""
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror})"
    return checksum_of_bytes(data) if summed else 0


def checksum_of_bytes(data: bytes) -> int | str:
    """The checksum at the end of a chunk; "altered" if it is not that of the other bytes."""
    import google_crc32c  # a dependency of zarr

    recorded = int.from_bytes(data[-4:], "little")
    return recorded if len(data) >= 4 and google_crc32c.value(data[:-4]) == recorded else "altered"
