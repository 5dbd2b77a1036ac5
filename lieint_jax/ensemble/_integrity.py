"""Whether the files of a store are all there, as they were written, in their places and of one commit.

Every chunk ends with its own checksum (CRC-32C). The store records those checksums by the chunks' places: of arrays
along time, in the array `checksums`, a row for each row of chunks; of all others, and of the checkpoint that belongs to
the published commit, as digests in the root, with one of `checksums` itself and of the metadata of each array.
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

CHECKPOINT = "checkpoint"  # the group that a run is resumed from
CHECKSUMS = "checksums"  # the array of the checksums of chunks along time
_NAMED = 5  # the most damaged files that a message names


def checksum(root: Mapping[str, Any]) -> str:
    """The checksum of a store's root metadata, itself left out."""
    attributes = {key: value for key, value in root["attributes"].items() if key != "checksum"}
    text = json.dumps({**root, "attributes": attributes}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest(data: bytes) -> str:
    """The digest of the bytes of a file, or of checksums."""
    return hashlib.sha256(data).hexdigest()[:16]


def digest_of(checksums: Iterable[int]) -> str:
    """The digest of the checksums of an array's or a checkpoint's chunks, in order."""
    return digest(np.array(list(checksums), "<u4").tobytes())


def digest_of_array(path: Path, name: str, meta: Mapping[str, Any]) -> str:
    """The digest of the checksums of an array in a store."""
    return digest_of(checksum_of_file(path / file) for file in chunk_files(name, meta))


def metadata(path: Path, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The metadata of the arrays of these names in a store."""
    return {name: json.loads((path / name / "zarr.json").read_text(encoding="utf-8")) for name in names}


def is_along_time(meta: Mapping[str, Any]) -> bool:
    """True for an array that grows while the run goes on."""
    return (meta.get("dimension_names") or [""])[0] == "time"


def chunk_files(name: str, meta: Mapping[str, Any], row: int | None = None) -> list[str]:
    """The files of the chunks of an array, relative to the store: all of them, or those of one row of chunks."""
    return ["/".join((name, "c", *map(str, key))) for key in _keys(meta, row)]


def files_of_rows(metas: Mapping[str, Any], row: int) -> list[str]:
    """The files of one row of chunks of all arrays along time, in the order of `checksums`."""
    names = sorted(name for name, meta in metas.items() if is_along_time(meta))
    return [file for name in names for file in chunk_files(name, metas[name], row)]


def files_of_checkpoint(metas: Mapping[str, Any], slot: int) -> list[str]:
    """The files of a slot of the checkpoint, in the order in which their checksums enter its digest."""
    names = sorted(name for name in metas if name.startswith(f"{CHECKPOINT}/"))
    return [file for name in names for file in chunk_files(name, metas[name], slot)]


def checksum_of_file(file: Path) -> int:
    """The checksum that the file of a chunk ends with."""
    with file.open("rb") as f:
        f.seek(-4, 2)
        return int.from_bytes(f.read(4), "little")


def raise_if_damaged(path: Path, found: Iterable[str]) -> None:
    """ValueError that names the files that are missing or altered, if there are any."""
    lost = list(found)
    if lost:
        more = f"; and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        raise ValueError(
            f"{path} is damaged: {'; '.join(lost[:_NAMED])}{more}. All else can still be read, by xarray.open_zarr for "
            "one; put the files back from a copy, make the copy again while no run writes, or run again into another "
            "store"
        )


def damage(path: Path, root: Mapping[str, Any]) -> Iterator[str]:
    """A line for each file of the published results that is missing or altered, and what is lost with it."""
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


def damage_of_checkpoint(path: Path, root: Mapping[str, Any]) -> Iterator[str]:
    """A line for each file of the published commit's checkpoint that is missing or altered."""
    progress, digests = root["attributes"]["progress"], root["attributes"].get("digests")
    if digests is None or progress["complete"] or not progress["commits"]:
        return
    try:
        metas = metadata(path, [name for name in digests["metadata"] if name.startswith(f"{CHECKPOINT}/")])
    except (OSError, ValueError):
        return  # `damage` names the file
    slot = progress["commits"] % 2
    files, found = files_of_checkpoint(metas, slot), _commit_in(path, slot)
    what = f"the checkpoint of commit {progress['commits']}, step {progress['steps']} (found: {found})"
    yield from _damage_of_array(path, files, metas, digests["checkpoint"], what)


def _commit_in(path: Path, slot: int) -> str:
    """The commit that a slot of the checkpoint is of, in words."""
    import zarr

    try:
        number, steps = np.asarray(zarr.open_array(str(path / CHECKPOINT / "commit"), mode="r")[slot])
    except (OSError, ValueError):
        return "unreadable"
    return f"commit {number}, step {steps}"


def _damage_of_array(path: Path, files: list[str], metas: Mapping[str, Any], expected: str, what: str) -> Iterator[str]:
    """The damaged files of chunks; if there is none, a line if they are not the ones whose digest is `expected`."""
    found = [_checksum(path / file) for file in files]
    sums = [checksum for checksum in found if isinstance(checksum, int)]
    if len(sums) < len(files):
        yield from _damage_of_files(path, files, metas)
    elif digest_of(sums) != expected:
        folder = files[0].partition("/")[0]
        yield f"{folder} is not what the run wrote: {what} has been replaced, or was copied while a run wrote to it"


def _damage_of_files(path: Path, files: Iterable[str], metas: Mapping[str, Any], summed: bool = True) -> Iterator[str]:
    """A line for each of these files of chunks that is missing, unreadable or altered."""
    for file in files:
        found = _checksum(path / file, summed)
        if isinstance(found, str):
            yield f"{file} is {found} ({_part(file, metas)})"


def _damage_along_time(path: Path, metas: Mapping[str, Any], root: Mapping[str, Any]) -> Iterator[str]:
    """The files along time that are missing, altered, or not those of their places."""
    rows = rows_of(root["attributes"])
    own = metadata(path, [CHECKSUMS])
    chunks = math.ceil(rows / own[CHECKSUMS]["chunk_grid"]["configuration"]["chunk_shape"][0])
    files = [file for row in range(chunks) for file in chunk_files(CHECKSUMS, own[CHECKSUMS], row)]
    lost = list(_damage_of_files(path, files, own))
    if lost:
        yield from lost
        return
    recorded = checksums_of_rows(path, rows)
    if digest(recorded.tobytes()) != root["attributes"]["digests"]["rows"]:
        yield f"{CHECKSUMS} is not that of the last commit: it has been replaced, or was copied while a run wrote to it"
        return
    for row in range(rows):
        for file, expected in zip(files_of_rows(metas, row), recorded[row].tolist(), strict=False):
            found = _checksum(path / file)
            if isinstance(found, int) and found != expected:
                found = "the chunk of another place or of another run"
            if isinstance(found, str):
                yield f"{file} is {found} ({_part(file, metas)})"


def rows_of(attributes: Mapping[str, Any]) -> int:
    """The number of rows of chunks along time that are published."""
    return math.ceil(attributes["progress"]["entries"] / attributes["time_chunk"])


def checksums_of_rows(path: Path, rows: int) -> np.ndarray:
    """The recorded checksums of the first rows of chunks along time, (rows, files)."""
    import zarr

    return np.asarray(zarr.open_array(str(path / CHECKSUMS), mode="r")[:rows], "<u4")


def _damage_by_chunks(path: Path, shown: Mapping[str, Any]) -> Iterator[str]:
    """The damage of a store that records no checksums: its chunks may have some of their own."""
    for name, meta in shown.items():
        own = _json(path / name / "zarr.json")
        if own is None or {**own, "shape": own["shape"][1:]} != {**meta, "shape": meta["shape"][1:]}:
            yield f"{name}/zarr.json is missing or altered"
        yield from _damage_of_files(path, chunk_files(name, meta), shown, meta["codecs"][-1]["name"] == "crc32c")


def _keys(meta: Mapping[str, Any], row: int | None) -> Iterator[tuple[int, ...]]:
    """The keys of an array's chunks, or of one row of them."""
    sizes = meta["chunk_grid"]["configuration"]["chunk_shape"]
    spans = [range(math.ceil(n / size)) for n, size in zip(meta["shape"], sizes, strict=True)]
    return itertools.product(*(spans if row is None else [range(row, row + 1), *spans[1:]]))


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _digest_of_file(file: Path) -> str | None:
    try:
        return digest(file.read_bytes())
    except OSError:
        return None


def _part(file: str, metas: Mapping[str, Any]) -> str:
    """The part of an array that a chunk's file holds, in words."""
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
    """The checksum that a chunk's file ends with, 0 if it has none; a word if it is missing, unreadable or altered."""
    import google_crc32c  # of zarr

    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror})"
    if not summed:
        return 0
    recorded = int.from_bytes(data[-4:], "little")
    return recorded if len(data) >= 4 and google_crc32c.value(data[:-4]) == recorded else "altered"
