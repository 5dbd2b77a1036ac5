"""Archives NAME.npz of `lieint run` and `lieint study`, written, and checked before their numbers are read."""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lieint_jax import _checks
from lieint_jax.runs._storage.kinds import ARCHIVE_KEYS, COUNT, REALS, STORE_KEYS, check_run, check_table, expect
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._storage.untrusted import JSON_BYTES, UnreadableError, parse_json, refuse_special, wrap_errors
from lieint_jax.types import StepInfo, Trajectory, leaves_by_name, state_from_leaves

TIME = "state.t"  # the times of the states in an .npz, where t is the time of the trajectory
_NO_PATH = str.maketrans("/\\", "__")  # of the characters that the name of an array cannot have
_MAX_RATIO, _SMALL = 100, 2**20  # an archive may expand by this factor, or to this many bytes
_ZIP_ENCRYPTED = 0x1


class Archive(NamedTuple):
    """An .npz file whose headers have been read and checked, but none of its numbers.

    Attributes:
        path: the file.
        headers: shape and dtype of each array.
        metadata: its description, without the keys that only stores have.
    """

    path: Path
    headers: dict[str, tuple[tuple[int, ...], np.dtype]]
    metadata: Table

    def read(self, *names: str) -> dict[str, np.ndarray]:
        """The arrays of these names."""
        with wrap_errors(self.path), np.load(self.path, allow_pickle=False) as file:
            return {name: file[name] for name in names}


def open_archive(path: Path) -> Archive:
    """Open the .npz file of `lieint run` or `lieint study` at `path`."""
    refuse_special(path)
    if path.is_dir():
        raise UnreadableError(f"{path} is a folder without results; pass a file NAME.npz or a store NAME.zarr")
    with wrap_errors(path):
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an npz archive")
        with zipfile.ZipFile(path) as file:
            _check_expansion(file.infolist(), path.stat().st_size)
            headers = dict(_header(file, info) for info in file.infolist())
            if len(headers) != len(file.infolist()):
                raise ValueError("two of its arrays have the same name")
        if headers.get("metadata", ((0,), np.dtype(bool)))[0] != () or headers["metadata"][1].kind != "U":
            raise ValueError("it has no metadata")
        if headers["metadata"][1].itemsize > 4 * JSON_BYTES:
            raise ValueError("its description is too long")
        with np.load(path, allow_pickle=False) as file:
            found = parse_json(str(file["metadata"]))
        check_table("its metadata", found, ARCHIVE_KEYS)
        return Archive(path, headers, {key: x for key, x in found.items() if key not in STORE_KEYS})


def _check_expansion(infos: list[zipfile.ZipInfo], size: int) -> None:
    """Raise ValueError unless an archive can be read, and expands to no more bytes than a file of `size` bytes may."""
    for info in infos:
        if not re.fullmatch(r"[^/\\\0]+\.npy", info.filename):
            raise ValueError(f"{info.filename!r} is not the name of an array")
        if info.flag_bits & _ZIP_ENCRYPTED:
            raise ValueError(f"{info.filename} is encrypted")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{info.filename} is compressed by method {info.compress_type}; numpy uses 0 or 8")
    total = sum(info.file_size for info in infos)
    if total > max(_MAX_RATIO * size, _SMALL) or total > _checks.memory_of_machine():
        raise ValueError(f"its {_checks.spoken_size(size)} would expand to {_checks.spoken_size(total)}")


def _header(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[str, tuple[tuple[int, ...], np.dtype]]:
    """The name of an array in an archive, and its shape and dtype, which must agree with its number of bytes."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with file.open(info) as array:
        shape, _, dtype = readers[np.lib.format.read_magic(array)](array)
        begun = array.tell()
    if dtype.hasobject:
        raise ValueError("it contains Python objects")
    if begun + math.prod(shape) * dtype.itemsize != info.file_size:
        raise ValueError(f"{info.filename} has {info.file_size - begun} bytes for shape {shape} of {dtype}")
    return info.filename.removesuffix(".npy"), (shape, dtype)


def read_trajectory(found: Archive) -> Trajectory:
    """The run in an archive of `lieint run`."""
    with wrap_errors(found.path):
        arrays = {name: x for name, x in found.headers.items() if name != "metadata"}
        kinds = {name: (shape, str(dtype) if dtype.isnative else dtype.str) for name, (shape, dtype) in arrays.items()}
        named = {name for name in kinds if name in ("q", "p", "work") or name.startswith("extra.")}
        check_run(kinds, {"q", "p"} | named, "t")
        if TIME in kinds:
            n, m = kinds["p"][0][:2]
            expect(TIME, kinds, REALS, (n, 1), (n, m))
        _check_scenario(found.metadata.get("scenario", {}), *kinds["p"][0][:2])
    read = found.read(*sorted(named | {"t", "residual", "converged"} | ({TIME} & set(kinds))))
    with wrap_errors(found.path):
        leaves = {name: read[name] for name in named}
        if TIME in read:
            leaves["t"] = np.broadcast_to(read[TIME], leaves["p"].shape[:2])
        t = read["t"]
        if not (np.isfinite(t).all() and ((np.diff(t) >= 0).all() or (np.diff(t) <= 0).all())):
            raise ValueError("its times are not finite and in order")
        return Trajectory(t, state_from_leaves(leaves), StepInfo(read["residual"], read["converged"]))  # pyright: ignore[reportArgumentType]


def write_trajectory(
    path: Path, trajectory: Trajectory, metadata: dict[str, Any], members: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write a trajectory as .npz: arrays t, q, p, residual, converged, and `metadata` as JSON text.

    Further arrays are written if the states have these leaves: work, extra.NAME, and state.t, (entries, members), or
    (entries, 1) if all members have the same times. The members' own numbers are written as member.NAME, (members, …).
    An existing file is not replaced.
    """
    own: dict[str, Any] = {f"member.{name.translate(_NO_PATH)}": values for name, values in (members or {}).items()}
    arrays = leaves_by_name(trajectory.state)
    if "t" in arrays:
        t = np.asarray(arrays.pop("t"))
        arrays[TIME] = t[:, :1] if (t == t[:, :1]).all() else t
    arrays |= own | trajectory.info._asdict() | {"metadata": np.array(json.dumps(metadata))}
    write_archive(path, {"t": trajectory.t, **arrays})


def write_archive(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as a new .npz. An existing file is not replaced, and nothing is left where writing fails.

    Raises:
        OSError: the file exists or cannot be written, as on a full disk.
    """
    file = path.open("xb")
    try:
        with file:
            np.savez(file, allow_pickle=False, **arrays)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def _check_scenario(scenario: Table, entries: int, members: int) -> None:
    """Raise ValueError if the scenario of a file, where it has one of `lieint run`, plans a different run."""
    if "system" not in scenario:
        return
    check_table("scenario", scenario, {"members": COUNT, "steps": COUNT, "save_every": COUNT})
    save_at = scenario.get("save_at")
    if not (save_at is None or isinstance(save_at, list)):
        raise ValueError("save_at of its scenario is not a list")
    planned = scenario["steps"] // scenario["save_every"] + 1 if save_at is None else len(save_at) + 1
    if (planned, scenario["members"]) != (entries, members):
        raise ValueError(
            f"it has {entries} entries of {members} members, and its scenario {planned} of {scenario['members']}"
        )
