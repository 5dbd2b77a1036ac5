"""Stores that older versions wrote as a whole: 0.2 (format 2) and 0.3.0 (format 3). They are read, and not resumed.

Their root lists the arrays with their published lengths. Those of 0.3.0 also have the array `checksums`, the checksums
of all chunks along time with one row for each row of chunks, and digests of it and of all else in the root.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lieint_jax.runs._storage.chunks import chunk_files, damage_of_chunks, damage_of_constants, digest, is_along_time
from lieint_jax.runs._storage.files import open_zarr
from lieint_jax.runs._storage.leaves import Saves, Table, states_in
from lieint_jax.runs._storage.storage import Storage
from lieint_jax.types import StepInfo, Trajectory

LAST = 3  # the last format of such stores


def load(path: Path, attributes: Table) -> Saves:
    """The published part of the run in a store of these attributes."""
    import zarr

    group: Any = zarr.open_group(str(path), mode="r", use_consolidated=True)
    if attributes["reduce"] is not None:
        return Saves({name: array[...] for name, array in group.arrays()}, None, attributes)
    times, info = group["time"][...], StepInfo(group["residual"], group["converged"])
    failed = group["first_failure"][...] if attributes["progress"]["complete"] and "first_failure" in group else None
    return Saves(Trajectory(times, states_in(group, times, attributes), info), failed, attributes)


def damage(storage: Storage, root: Table) -> Iterator[str]:
    """A line for each missing or altered file of the published results, with the part that is lost."""
    attributes, shown = root["attributes"], root["consolidated_metadata"]["metadata"]
    present = storage.sizes()
    yield from (f"{name}/zarr.json is missing" for name in shown if f"{name}/zarr.json" not in present)
    if "digests" not in attributes:  # version 0.2, whose last chunks may lack a checksum
        for name, meta in shown.items():
            expected = dict.fromkeys(chunk_files(name, meta))
            yield from damage_of_chunks(storage, expected, shown, whole=meta["codecs"][-1]["name"] == "crc32c")
        return
    yield from damage_of_constants(storage, attributes["digests"]["arrays"], shown)
    recorded = _recorded_checksums(storage, attributes)
    if recorded is None:
        yield "checksums is not that of the last commit: it was replaced, or copied while a run was writing it"
        return
    names = sorted(name for name, meta in shown.items() if is_along_time(meta))
    for row, checksums in enumerate(recorded.tolist()):
        files = [f for name in names for f in chunk_files(name, shown[name], {"time": range(row, row + 1)})]
        yield from damage_of_chunks(storage, dict(zip(files, checksums, strict=False)), shown)


def _recorded_checksums(storage: Storage, attributes: Table) -> np.ndarray | None:
    """The checksums of the chunks along time, a row for each row of chunks; None if they are not those of the root."""
    import zarr

    rows = math.ceil(attributes["progress"]["entries"] / attributes["time_chunk"])
    array: Any = zarr.open_array(open_zarr(storage), path="checksums", mode="r")
    recorded = np.asarray(array[:rows], "<u4")
    return recorded if digest(recorded.tobytes()) == attributes["digests"]["rows"] else None
