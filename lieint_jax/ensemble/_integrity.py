"""Whether the files of a store are all there, and as they were written."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_NAMED = 5  # the most damaged files that a message names


def checksum(root: Mapping[str, Any]) -> str:
    """The checksum of a store's root metadata, itself left out."""
    attributes = {key: value for key, value in root["attributes"].items() if key != "checksum"}
    text = json.dumps({**root, "attributes": attributes}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def check(path: Path, root: Mapping[str, Any]) -> None:
    """ValueError if a file of the published part of a store is missing or altered; every one is read.

    Args:
        path: the store.
        root: its root metadata.
    """
    lost = list(_damage(path, root))
    if lost:
        more = f"; and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        raise ValueError(
            f"{path} is damaged: {'; '.join(lost[:_NAMED])}{more}. All else can still be read, by xarray.open_zarr for "
            "one; put the files back from a copy, or run again into another store"
        )


def _damage(path: Path, root: Mapping[str, Any]) -> Iterator[str]:
    """A line for each file that is missing or altered, and what is lost with it."""
    progress, shown = root["attributes"]["progress"], root["consolidated_metadata"]["metadata"]
    for name, meta in shown.items():
        own = _json(path / name / "zarr.json")
        if own is None or {**own, "shape": own["shape"][1:]} != {**meta, "shape": meta["shape"][1:]}:
            yield f"{name}/zarr.json is missing or altered"
        yield from _chunks(path, name, meta, range(*meta["shape"][:1] or [1]))
    if progress["commits"] and not progress["complete"]:
        slot = progress["commits"] % 2
        for folder in sorted((path / "checkpoint").glob("*/")):
            name, meta = f"checkpoint/{folder.name}", _json(folder / "zarr.json")
            if meta is None:
                yield f"{name}/zarr.json is missing or altered"
            else:
                yield from _chunks(path, name, meta, range(slot, slot + 1))


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _chunks(path: Path, name: str, meta: Mapping[str, Any], rows: range) -> Iterator[str]:
    """The damaged chunks of an array that hold `rows` along its first axis."""
    sizes, summed = meta["chunk_grid"]["configuration"]["chunk_shape"], meta["codecs"][-1]["name"] == "crc32c"
    if not summed and meta["data_type"] not in ("float32", "float64"):
        return  # stores of version 0.1 have no file for a chunk of fill values, and only NaN is no value of a run
    spans = [range(rows.start // size, -(-rows.stop // size)) if rows else range(0) for size in sizes[:1]]
    spans += [range(math.ceil(n / size)) for n, size in zip(meta["shape"][1:], sizes[1:], strict=True)]
    for key in itertools.product(*spans):
        file = path.joinpath(name, "c", *map(str, key))
        state = _state(file, summed)
        if state:
            axes = meta.get("dimension_names") or [f"axis {i}" for i in range(len(key))]
            part = [
                f"{axis} {k * size} … {min((k + 1) * size, n) - 1}"
                for axis, k, size, n in zip(axes, key, sizes, meta["shape"], strict=True)
                if n > size or axis in ("time", "member")
            ]
            yield f"{file.relative_to(path)} is {state} ({name} of {', '.join(part)})"


def _state(file: Path, summed: bool) -> str:
    """Empty if a chunk's file is there and has the checksum that it ends with; else what is wrong."""
    import google_crc32c  # of zarr

    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror})"
    if summed and (len(data) < 4 or google_crc32c.value(data[:-4]) != int.from_bytes(data[-4:], "little")):
        return "altered"
    return ""
