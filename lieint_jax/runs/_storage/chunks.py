"""The files of arrays in Zarr's format 3, and their checksums: every chunk ends with its own, CRC-32C."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.storage import Address, Storage

_MAX_FILES = 10**6  # of an array's row of chunks along time
REQUESTS = 16  # at the same time
_MAX_NAMED = 5  # sentences in a message


def digest(data: bytes) -> str:
    """The digest of the bytes of a file, or of checksums."""
    return hashlib.sha256(data).hexdigest()[:16]


def digest_of(checksums: Iterable[int]) -> str:
    """The digest of the checksums of an array's chunks, in order."""
    return digest(np.array(list(checksums), "<u4").tobytes())


def dims_of(meta: Table) -> list[str]:
    """The names of an array's axes, which Zarr leaves out where there are none."""
    return meta.get("dimension_names") or []


def is_along_time(meta: Table) -> bool:
    """True for an array that grows during the run."""
    return dims_of(meta)[:1] == ["time"]


def chunk_files(name: str, meta: Table, only: Mapping[str, range] | None = None) -> list[str]:
    """The files of an array's chunks, relative to the store.

    With `only`, those whose numbers along the dimensions of these names are in these ranges.
    """
    sizes, only = meta["chunk_grid"]["configuration"]["chunk_shape"], only or {}
    spans = [range(-(-n // size)) for n, size in zip(meta["shape"], sizes, strict=True)]
    dims = dims_of(meta) or [""] * len(spans)
    spans = [only.get(dim, span) for dim, span in zip(dims, spans, strict=True)]
    if math.prod(map(len, spans)) > _MAX_FILES:
        raise ValueError(f"{name} of shape {tuple(meta['shape'])} has too many chunks")
    return ["/".join((name, "c", *map(str, key))) for key in itertools.product(*spans)]


def part_of_array(file: str, metas: Mapping[str, Table]) -> str:
    """The part of an array in a chunk's file, in words."""
    name, _, key = file.rpartition("/c")
    meta, keys = metas[name], [int(k) for k in key.split("/")[1:]]
    axes = dims_of(meta) or [f"axis {i}" for i in range(len(keys))]
    sizes = meta["chunk_grid"]["configuration"]["chunk_shape"]
    part = [
        f"{axis} {k * size} … {min((k + 1) * size, n) - 1}"
        for axis, k, size, n in zip(axes, keys, sizes, meta["shape"], strict=True)
        if n > size or axis in ("time", "member")
    ]
    return f"{name} of {', '.join(part)}" if part else name


def tail(data: bytes) -> int:
    """The checksum at the end of a chunk."""
    return int.from_bytes(data[-4:], "little")


def checksum_of(storage: Storage, file: str, whole: bool) -> int | str:
    """The checksum at the end of a chunk; a word if its file is missing, unreadable or, if `whole` is read, altered."""
    import google_crc32c  # a dependency of zarr

    try:
        if not whole:
            return tail(storage.tail(file))
        data = storage.read(file)
        return tail(data) if len(data) >= 4 and google_crc32c.value(data[:-4]) == tail(data) else "altered"
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror or error})"


def damage_of_chunks(storage: Storage, expected: Mapping[str, int], metas: Mapping[str, Table]) -> Iterator[str]:
    """A line for each chunk that is missing, altered or of another place, by the checksums of all.

    Of files in a folder all bytes are compared with the checksums at their ends; of objects, for which a request
    transfers four bytes, these ends only.
    """
    checksums = in_threads(lambda file: checksum_of(storage, file, not storage.is_remote), expected, storage)
    for (file, wanted), found in zip(expected.items(), checksums, strict=True):
        if isinstance(found, str) or found != wanted:
            what = found if isinstance(found, str) else "the chunk of another place or another run"
            yield f"{file} is {what} ({part_of_array(file, metas)})"


def damage_of_constants(storage: Storage, digests: Mapping[str, str], metas: Mapping[str, Table]) -> Iterator[str]:
    """A line for each file of the arrays that a run does not change that is missing, altered or of another run."""
    for name, expected in digests.items():
        files = chunk_files(name, metas[name])
        found = [checksum_of(storage, file, not storage.is_remote) for file in files]
        lost = [(file, x) for file, x in zip(files, found, strict=True) if isinstance(x, str)]
        yield from (f"{file} is {x} ({part_of_array(file, metas)})" for file, x in lost)
        if not lost and digest_of(x for x in found if isinstance(x, int)) != expected:
            yield f"{name} is not as the run wrote it: it was replaced, or copied while a run was writing it"


def in_threads(function: Any, values: Iterable[Any], storage: Storage) -> Iterator[Any]:
    """The results of a function that makes requests; many requests at the same time to object storage."""
    if not storage.is_remote:
        yield from map(function, values)
        return
    with ThreadPoolExecutor(REQUESTS) as pool:
        yield from pool.map(function, values)


def first_of(sentences: list[str]) -> str:
    """The first of several sentences about files or parts, for a message."""
    more = f"; and {len(sentences) - _MAX_NAMED} more" if len(sentences) > _MAX_NAMED else ""
    return f"{'; '.join(sentences[:_MAX_NAMED])}{more}"


def raise_if_damaged(path: Address, damage: Iterable[str]) -> None:
    """Raise a ValueError with the first lines of `damage`, if there are any."""
    lost = list(damage)
    if lost:
        raise ValueError(
            f"{path} is damaged: {first_of(lost)}. Everything else can still be read, for example "
            "by xarray.open_zarr; restore the files from a copy, repeat the copy while no run writes, or run again "
            "into another store"
        )
