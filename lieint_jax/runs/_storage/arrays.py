"""Arrays in Zarr's format 3, written and read here: their metadata, and their chunks with a checksum each, CRC-32C.

Zarr itself is not used: it reads these stores, as xarray does, but its import lasts most of a second, and each of its
calls passes through a thread of its own.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.storage import REQUESTS, ROOT, Address, Storage
from lieint_jax.runs._storage.untrusted import parse_json

_S = TypeVar("_S")
_T = TypeVar("_T")
_MAX_FILES = 10**6  # of an array's row of chunks along time
_MAX_LENGTH = 10**15  # of an axis
_CHUNK_BYTES = 2**30
_MAX_NAMED = 5  # sentences in a message
_LEVEL = -1  # of zstd: six times as fast as 0, and 5 % larger, for numbers of simulations
_TEXT = "string"  # Zarr's name of a data type
GROUP = {"attributes": {}, "zarr_format": 3, "node_type": "group"}  # the metadata of the group of the step


class ArrayMetadata(NamedTuple):
    """The metadata of one array of a store.

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

    @property
    def fill(self) -> Any:
        """What stands for a value that is not published."""
        default = {"f": np.nan, "i": -1, "b": False, "T": ""}.get(self.dtype.kind, 0)
        return default if self.missing is None else self.missing

    @property
    def is_along_time(self) -> bool:
        """True for an array that grows during the run."""
        return self.dims[:1] == ("time",)

    def of_length(self, entries: int) -> ArrayMetadata:
        """The metadata of an array along time with another number of entries; of every other array its own."""
        return self._replace(shape=(entries, *self.shape[1:])) if self.is_along_time else self

    def to_json(self) -> Table:
        """The table that Zarr's format 3 demands."""
        is_text, fill = self.dtype.kind == "T", self.fill
        fill = "NaN" if self.dtype.kind == "f" else [float(fill)] * 2 if self.dtype.kind == "c" else fill
        as_bytes = {"name": "bytes"} | ({"configuration": {"endian": "little"}} if self.dtype.itemsize > 1 else {})
        return {
            "shape": list(self.shape),
            "data_type": _TEXT if is_text else self.dtype.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunks)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": fill,
            "codecs": [
                {"name": "vlen-utf8", "configuration": {}} if is_text else as_bytes,
                {"name": "zstd", "configuration": {"level": _LEVEL, "checksum": False}},
                {"name": "crc32c"},
            ],
            "attributes": self.attributes,
            **({"dimension_names": list(self.dims)} if self.dims else {}),
            "zarr_format": 3,
            "node_type": "array",
            "storage_transformers": [],
        }

    @classmethod
    def from_json(cls, table: Any) -> Self:
        """The inverse of `to_json`.

        Raises:
            ValueError: it is not a result of `to_json`, or its sizes are beyond all limits.
        """
        try:
            shape, chunks = (*table["shape"],), (*table["chunk_grid"]["configuration"]["chunk_shape"],)
            kind, dims, missing = table["data_type"], (*table.get("dimension_names", ()),), table["fill_value"]
            dtype = np.dtypes.StringDType() if kind == _TEXT else np.dtype(kind)
            missing = missing if type(missing) is int and dtype.kind == "i" else None
            found = cls(shape, dtype, chunks, dims, table["attributes"], missing)
            lengths_are_counts = all(type(n) is int and 0 <= n <= _MAX_LENGTH for n in (*shape, *chunks))
            if dtype.kind not in "fiubcT" or not lengths_are_counts or found.to_json() != table:
                raise ValueError("another table")
        except (TypeError, KeyError, AttributeError, ValueError):
            raise ValueError("this is not the description of an array that lieint_jax wrote") from None
        if not len(shape) == len(chunks) == len(dims) or 0 in chunks:
            raise ValueError(f"chunks of {chunks} do not fit the shape {shape}")
        if math.prod(chunks) * 8 > _CHUNK_BYTES:
            raise ValueError(f"chunks of {chunks} are larger than those of any run")
        return found

    @property
    def num_chunks(self) -> int:
        """The number of chunks."""
        return math.prod(-(-n // size) for n, size in zip(self.shape, self.chunks, strict=True))

    def files(self, name: str, only: Mapping[str, range] | None = None) -> list[str]:
        """The files of the chunks of the array of this name, relative to the store.

        With `only`, those whose numbers along the dimensions of these names are in these ranges.
        """
        spans = [range(-(-n // size)) for n, size in zip(self.shape, self.chunks, strict=True)]
        dims = self.dims or ("",) * len(spans)
        spans = [(only or {}).get(dim, span) for dim, span in zip(dims, spans, strict=True)]
        if math.prod(map(len, spans)) > _MAX_FILES:
            raise ValueError(f"{name} of shape {self.shape} has too many chunks")
        return [chunk_file(name, key) for key in itertools.product(*spans)]

    def blocks(self, values: np.ndarray, at: Sequence[int]) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
        """The numbers and the values of the chunks of a part of the array, which begins with a chunk at index `at`."""
        sizes = values.shape
        for key in itertools.product(*(range(-(-n // size)) for n, size in zip(sizes, self.chunks, strict=True))):
            place = tuple(slice(k * size, (k + 1) * size) for k, size in zip(key, self.chunks, strict=True))
            yield tuple(a // size + k for a, k, size in zip(at, key, self.chunks, strict=True)), values[place]

    def encode(self, values: np.ndarray) -> bytes:
        """The content of the file of a chunk of these values; a chunk at the end of an axis may have fewer than fit."""
        import google_crc32c
        from numcodecs import zstd  # pyright: ignore[reportAttributeAccessIssue]

        if values.shape != self.chunks:
            whole = np.full(self.chunks, self.fill, self.dtype)
            whole[tuple(map(slice, values.shape))] = values
            values = whole
        raw: Any = _encode_texts(values.ravel().tolist()) if self.dtype.kind == "T" else values
        if self.dtype.kind != "T":
            raw = np.ascontiguousarray(values, self.dtype.newbyteorder("<"))
        data = zstd.compress(raw, _LEVEL)
        return data + google_crc32c.value(data).to_bytes(4, "little")

    def decode(self, data: bytes) -> np.ndarray:
        """The inverse of `encode`, for numbers.

        Raises:
            ValueError: the checksum is wrong, or it is the chunk of another array.
        """
        from numcodecs import zstd  # pyright: ignore[reportAttributeAccessIssue]

        if not is_whole(data):
            raise ValueError("its checksum is wrong")
        values = np.zeros(self.chunks, self.dtype.newbyteorder("<"))  # a chunk of fewer bytes leaves zeros
        try:
            zstd.decompress(data[:-4], values)
        except RuntimeError as error:
            raise ValueError(f"it cannot be decompressed: {error}") from None
        return values.astype(self.dtype, copy=False)


class StoredArray:
    """An array of numbers in a store, read where it is asked for."""

    def __init__(self, storage: Storage, name: str, meta: ArrayMetadata) -> None:
        self._storage, self._name, self.meta = storage, name, meta

    @classmethod
    def open(cls, storage: Storage, name: str) -> Self:
        """The array of this name, by its own metadata."""
        return cls(storage, name, ArrayMetadata.from_json(parse_json(storage.read(f"{name}/{ROOT}"))))

    def read(self, *numbers: np.ndarray, where: np.ndarray | None = None) -> np.ndarray:
        """The values at these numbers along the first axes, and over the whole of the others.

        Args:
            numbers: indices ≥ 0 along each of the first axes.
            where: which values to read, a mask over the first axes; others are the missing ones. None: all.

        Raises:
            ValueError: a chunk is missing or altered.
        """
        meta = self.meta
        picks = [*numbers, *map(np.arange, meta.shape[len(numbers) :])]
        found = np.full([len(pick) for pick in picks], meta.fill, meta.dtype)
        chunks = [pick // size for pick, size in zip(picks, meta.chunks, strict=True)]

        def place(key: tuple[int, ...]) -> None:
            at = [np.flatnonzero(chunk == k) for chunk, k in zip(chunks, key, strict=True)]
            mask = None if where is None else where[np.ix_(*at[: where.ndim])]
            if mask is not None and not mask.any():
                return
            file = chunk_file(self._name, key)
            try:
                block = meta.decode(self._storage.read(file))
            except (ValueError, FileNotFoundError) as error:
                reason = "missing" if isinstance(error, OSError) else f"altered: {error}"
                raise ValueError(f"{self._storage.address} is damaged: {file} is {reason}") from None
            inside = (pick[a] - k * size for pick, a, k, size in zip(picks, at, key, meta.chunks, strict=True))
            block = block[_orthogonal(inside)]
            if mask is not None and not mask.all():
                mask = mask.reshape(*mask.shape, *[1] * (block.ndim - mask.ndim))
                block = np.where(mask, block, np.asarray(meta.fill, meta.dtype))
            found[_orthogonal(at)] = block

        keys = itertools.product(*(np.unique(chunk).tolist() for chunk in chunks))
        deque(in_threads(place, keys, self._storage), maxlen=0)
        return found


def _orthogonal(numbers: Iterable[np.ndarray]) -> tuple[Any, ...]:
    """The index of the values at these numbers along each axis: slices, which cost no copy, of consecutive ones."""
    numbers = list(numbers)
    if all(len(n) == n[-1] - n[0] + 1 and (np.diff(n) == 1).all() for n in numbers):
        return tuple(slice(int(n[0]), int(n[-1]) + 1) for n in numbers)
    return np.ix_(*numbers)


def _encode_texts(texts: Sequence[str]) -> bytes:
    """Texts as in the codec "vlen-utf8": their number, and each after the number of its bytes."""
    parts = [text.encode() for text in texts]
    return struct.pack("<I", len(parts)) + b"".join(struct.pack("<I", len(part)) + part for part in parts)


def chunk_file(name: str, key: Sequence[int]) -> str:
    """The file of a chunk, by its numbers along the axes of the array of this name."""
    return "/".join((name, "c", *map(str, key)))


def digest(data: bytes) -> str:
    """The digest of the bytes of a file, or of checksums."""
    return hashlib.sha256(data).hexdigest()[:16]


def digest_of(checksums: Iterable[int]) -> str:
    """The digest of the checksums of an array's chunks, in order."""
    return digest(np.array(list(checksums), "<u4").tobytes())


def tail(data: bytes) -> int:
    """The checksum at the end of a chunk."""
    return int.from_bytes(data[-4:], "little")


def is_whole(data: bytes) -> bool:
    """True for the content of a chunk whose checksum is right."""
    import google_crc32c

    return len(data) >= 4 and google_crc32c.value(data[:-4]) == tail(data)


def part_of_array(file: str, metas: Mapping[str, ArrayMetadata]) -> str:
    """The part of an array in a chunk's file, in words."""
    name, _, key = file.rpartition("/c")
    meta, keys = metas[name], [int(k) for k in key.split("/")[1:]]
    axes = meta.dims or [f"axis {i}" for i in range(len(keys))]
    part = [
        f"{axis} {k * size} … {min((k + 1) * size, n) - 1}"
        for axis, k, size, n in zip(axes, keys, meta.chunks, meta.shape, strict=True)
        if n > size or axis in ("time", "member")
    ]
    return f"{name} of {', '.join(part)}" if part else name


def checksum_of(storage: Storage, file: str) -> int | str:
    """The checksum at the end of a chunk, or a word if its file is missing, unreadable or altered.

    Of files in a folder all bytes are compared with the checksum; of objects, of which a request transfers four bytes,
    only these are looked at.
    """
    try:
        data = storage.tail(file) if storage.is_remote else storage.read(file)
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror or error})"
    return tail(data) if storage.is_remote or is_whole(data) else "altered"


def damage_of_chunks(
    storage: Storage, expected: Mapping[str, int], metas: Mapping[str, ArrayMetadata]
) -> Iterator[str]:
    """A line for each chunk that is missing, altered or of another place, by the checksums of all."""
    checksums = in_threads(lambda file: checksum_of(storage, file), expected, storage)
    for (file, wanted), found in zip(expected.items(), checksums, strict=True):
        if found != wanted:
            what = found if isinstance(found, str) else "the chunk of another place or another run"
            yield f"{file} is {what} ({part_of_array(file, metas)})"


def damage_of_constants(
    storage: Storage, digests: Mapping[str, str], metas: Mapping[str, ArrayMetadata]
) -> Iterator[str]:
    """A line for each file of the arrays that a run does not change that is missing, altered or of another run."""
    for name, expected in digests.items():
        files = metas[name].files(name)
        found = [checksum_of(storage, file) for file in files]
        lost = [(file, x) for file, x in zip(files, found, strict=True) if isinstance(x, str)]
        yield from (f"{file} is {x} ({part_of_array(file, metas)})" for file, x in lost)
        if not lost and digest_of(x for x in found if isinstance(x, int)) != expected:
            yield f"{name} is not as the run wrote it: it was replaced, or copied while a run was writing it"


def in_threads(function: Callable[[_S], _T], values: Iterable[_S], storage: Storage) -> Iterator[_T]:
    """The results of a function that makes requests, in order; many requests at the same time to object storage.

    The values are asked for as they are needed, since slabs of a run that wait are in memory.
    """
    if not storage.is_remote:
        yield from map(function, values)
        return
    with ThreadPoolExecutor(REQUESTS) as pool:
        waiting: deque[Future[_T]] = deque()
        for value in values:
            waiting.append(pool.submit(function, value))
            if len(waiting) > REQUESTS:
                yield waiting.popleft().result()
        for future in waiting:
            yield future.result()


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
