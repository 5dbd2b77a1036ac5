"""The check of a store against its own description, before it is read: a folder NAME.zarr, or one file NAME.zip."""

from __future__ import annotations

import contextlib
import json
import math
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lieint_jax import _checks
from lieint_jax.runs._storage.chunks import raise_if_damaged
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.kinds import (
    ARRAY_KEYS,
    COUNTS,
    LENGTHS,
    NAME,
    PROGRESS_KEYS,
    REALS,
    RUN_KEYS,
    STORE_KEYS,
    check_run,
    check_table,
    expect,
)
from lieint_jax.runs._storage.leaves import Table, store_name
from lieint_jax.runs._storage.storage import Address, Storage
from lieint_jax.runs._storage.untrusted import JSON_BYTES, UnreadableError, parse_json, refuse_special, wrap_errors
from lieint_jax.runs._storage.zipped import checked_sizes
from lieint_jax.runs._summary import SERIES
from lieint_jax.runs.store._root import ROOT, Root, read_root

_CHUNK_BYTES = 2**30
_MAX_PARTS, _MOST_FILES = 10**6, 10**12
_OF_MEMBERS = ("least", "greatest", "total", "excess", "last")


def check_store(path: Address) -> Root:
    """Check the files of the store at `path`, and return its root.

    Of a run in parts only the description is checked: `_published.load` checks its parts one by one.

    Raises:
        UnreadableError: not a store of lieint, or one that is being created; its description does not fit its arrays.
        ValueError: a damaged store; the message names the files.
    """
    root = described_root(path)
    with wrap_errors(path):
        if not root.in_parts:
            lost = list(root.damage())
        elif lost := list(root.damage_of_root()):
            if not root.storage.sizes("parts"):  # a bucket gets the root first, and results after all other files
                raise UnreadableError(
                    f"{path} has no results yet, and not all of its files: it is being created. Open it again when it "
                    "has; if its run was stopped, start that again"
                )
            lost = list(root.damage_of_root())
    raise_if_damaged(path, lost)
    return root


def described_root(path: Address) -> Root:
    """The root of the store at `path`, whose description is checked."""
    storage = open_storage(path)
    if isinstance(path, Path):
        refuse_special(path)
        if path.is_dir() == (path.suffix == ".zip"):
            raise UnreadableError(f"{path} is not the store of a run: that is a folder NAME.zarr, or a file NAME.zip")
        with wrap_errors(path):
            count = _check_files(path, storage)
    else:
        count = _MOST_FILES
    with wrap_errors(path, passed=(ValueError,)):
        root = read_root(storage)
    if root is None:
        raise UnreadableError(
            f"there is no store {path}; li.run(…, store=…) and `lieint run NAME --out {path}` write one"
            if storage.is_remote
            else f"{path} does not exist, or is not the store of a run"
        )
    attributes, in_parts = root["attributes"], "parts" in root["attributes"]
    if storage.is_remote and not in_parts:
        raise UnreadableError(f"{path} is a copy of a store that was written on a disk: copy it to a disk to read it")
    with wrap_errors(path):
        shown = _check_arrays(root["consolidated_metadata"]["metadata"], None if in_parts else count)
        check_table("the description", attributes, STORE_KEYS)
        if in_parts and attributes["parts"] > min(attributes["members"], _MAX_PARTS):
            raise ValueError(f"it has {attributes['parts']} parts of {attributes['members']} members")
        _check_attributes(attributes, shown)
        return Root(storage, root)


def _check_files(path: Path, storage: Storage) -> int:
    """The number of files in a store, which must be ordinary files, with descriptions of bounded size."""
    count = 0
    for name, size in checked_sizes(path).items() if path.suffix == ".zip" else _ordinary_files(path):
        count += 1
        if name.endswith(ROOT):
            if size > JSON_BYTES:
                raise ValueError(f"{name} has {_checks.spoken_size(size)}")
            with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError, FileNotFoundError):
                parse_json(storage.read(name))  # text that is not JSON is reported later, with what can be read
    return count


def _ordinary_files(path: Path) -> Iterator[tuple[str, int]]:
    """The names and sizes of the files in a folder, which must be no devices, pipes or links to folders."""
    for folder, folders, names in os.walk(path):
        for link in (Path(folder, name) for name in folders if os.path.islink(Path(folder, name))):
            raise ValueError(f"{link.relative_to(path)} is a link to a folder")
        for file in (Path(folder, name) for name in names):
            try:
                status = file.stat()
            except FileNotFoundError:
                if file.is_symlink():
                    raise ValueError(f"{file.relative_to(path)} is a link to nothing") from None
                continue  # a temporary file of a run that is writing
            if not stat.S_ISREG(status.st_mode):
                raise ValueError(f"{file.relative_to(path)} is a device, a pipe or a socket")
            yield file.relative_to(path).as_posix(), status.st_size


def _check_arrays(shown: Any, files: int | None) -> Table:
    """The descriptions of a store's arrays by name, which must be valid and need no more files than the store has.

    Args:
        shown: the consolidated metadata.
        files: the number of files in the store; None if it may lack some.
    """
    for name, array in shown.items():
        if not NAME.fullmatch(name):
            raise ValueError(f"{name!r} is not the name of an array")
        check_table(name, array, ARRAY_KEYS)
        grid = array["chunk_grid"]
        chunk = grid["configuration"]["chunk_shape"]
        if grid["name"] != "regular" or not LENGTHS.accepts(chunk) or len(chunk) != len(array["shape"]) or 0 in chunk:
            raise ValueError(f"{name} has chunks that do not fit its shape {tuple(array['shape'])}")
        if math.prod(chunk) * 8 > _CHUNK_BYTES:
            raise ValueError(f"{name} has chunks of {_checks.spoken_size(math.prod(chunk) * 8)}")
        chunks = math.prod(-(-n // size) for n, size in zip(array["shape"], chunk, strict=True))
        if files is not None and chunks > files:
            raise ValueError(f"{name} of shape {tuple(array['shape'])} has more chunks than there are files")
    return shown


def _check_attributes(found: Table, shown: Mapping[str, Table]) -> None:
    """Raise ValueError unless the attributes of a store describe a run with these arrays."""
    check_table("progress", found["progress"], PROGRESS_KEYS)
    check_table("run", found["run"], RUN_KEYS)
    leaves, constants = found["leaves"], found["constants"]
    bad = [name for name in (*leaves, *constants) if not (isinstance(name, str) and NAME.fullmatch(name))]
    if bad:
        raise ValueError(f"{bad[0]!r} is not the name of an array")
    kinds = {name: (tuple(array["shape"]), str(array["data_type"])) for name, array in shown.items()}
    leaves = [store_name(name) for name in leaves]
    missing = set(constants) - set(kinds)
    if missing:
        raise ValueError(f"it has no array {min(missing)}")
    in_parts = "parts" in found
    entries, members = found["num_entries"] if in_parts else found["progress"]["entries"], found["members"]
    if found["reduce"] is not None:
        of_members = _OF_MEMBERS if found["per"] else ()
        names = {*(SERIES[3:] if of_members else SERIES), "time"}
        if not names <= set(kinds):
            raise ValueError(f"it has no array {min(names - set(kinds))}")
        for name in names:
            shape = (found["parts"], entries) if in_parts and name != "time" else (entries,)
            expect(name, kinds, COUNTS if name == "unconverged" else REALS, shape)
        if found.get("parts", 1) > 1 and not of_members and kinds["sums"][0][:2] != (found["parts"], entries):
            raise ValueError("it has no sums of its parts")
        for name in {*leaves, "first_failure", *of_members} - ({"t"} - set(kinds)):
            expect(name, kinds, COUNTS if name == "first_failure" else REALS, (members,), least=1)
        return
    check_run(kinds, set(leaves) - ({"t"} - set(kinds)))
    if kinds["p"][0][:2] != (entries, members):
        raise ValueError(f"p has shape {kinds['p'][0]}, not ({entries}, {members}, …)")
