"""Stores that older versions wrote as a whole: 0.2 (format 2) and 0.3.0 (format 3). They are read, and not resumed.

Their root lists the arrays with their published lengths. Those of 0.3.0 also have the array `checksums`, the checksums
of all chunks along time with one row for each row of chunks, and digests of it and of all else in the root.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lieint_jax.runs.store._chunks import (
    checksum_of_bytes,
    chunk_files,
    digest,
    digest_of,
    is_along_time,
    part_of_array,
)
from lieint_jax.runs.store._leaves import Table, states_in
from lieint_jax.types import StepInfo, Trajectory

LAST = 3  # the last format of such stores


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


def load(path: Path, attributes: Table) -> Loaded:
    """The published part of the run in a store of these attributes."""
    import zarr

    group: Any = zarr.open_group(str(path), mode="r", use_consolidated=True)
    if attributes["reduce"] is not None:
        return Loaded({name: array[...] for name, array in group.arrays()}, None, attributes)
    times, info = group["time"][...], StepInfo(group["residual"], group["converged"])
    failed = group["first_failure"][...] if attributes["progress"]["complete"] and "first_failure" in group else None
    return Loaded(Trajectory(times, states_in(group, times, attributes), info), failed, attributes)


def damage(path: Path, root: Table) -> Iterator[str]:
    """A line for each missing or altered file of the published results, with the part that is lost."""
    attributes, shown = root["attributes"], root["consolidated_metadata"]["metadata"]
    for name in shown:
        if not (path / name / "zarr.json").is_file():
            yield f"{name}/zarr.json is missing"
    if "digests" not in attributes:  # version 0.2, whose last chunks may lack a checksum
        for name, meta in shown.items():
            yield from _damage_of_files(path, chunk_files(name, meta), shown, meta["codecs"][-1]["name"] == "crc32c")
        return
    for name, expected in attributes["digests"]["arrays"].items():
        files = chunk_files(name, shown[name])
        lost = list(_damage_of_files(path, files, shown))
        yield from lost
        if not lost and digest_of(int(_checksum(path / file)) for file in files) != expected:
            yield f"{name} is not as the run wrote it: it was replaced, or copied while a run was writing it"
    yield from _damage_along_time(path, root, shown)


def _damage_along_time(path: Path, root: Table, shown: Mapping[str, Table]) -> Iterator[str]:
    """A line for each missing, altered or misplaced file of the arrays along time."""
    import zarr

    rows = math.ceil(root["attributes"]["progress"]["entries"] / root["attributes"]["time_chunk"])
    recorded = np.asarray(zarr.open_array(str(path / "checksums"), mode="r")[:rows], "<u4")
    if digest(recorded.tobytes()) != root["attributes"]["digests"]["rows"]:
        yield "checksums is not that of the last commit: it was replaced, or copied while a run was writing it"
        return
    names = sorted(name for name, meta in shown.items() if is_along_time(meta))
    for row in range(rows):
        files = [f for name in names for f in chunk_files(name, shown[name], {"time": range(row, row + 1)})]
        lost = list(_damage_of_files(path, files, shown))
        yield from lost
        for file, expected in zip(files, recorded[row].tolist(), strict=False):
            if not lost and _checksum(path / file) != expected:
                yield f"{file} is the chunk of another place or another run ({part_of_array(file, shown)})"


def _damage_of_files(path: Path, files: list[str], metas: Mapping[str, Table], summed: bool = True) -> Iterator[str]:
    for file in files:
        found = _checksum(path / file, summed)
        if isinstance(found, str):
            yield f"{file} is {found} ({part_of_array(file, metas)})"


def _checksum(file: Path, summed: bool = True) -> int | str:
    """The checksum of a chunk's file, 0 if it has none; a word if the file is missing, unreadable or altered."""
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"unreadable ({error.strerror})"
    return checksum_of_bytes(data) if summed else 0
