"""The only place where files of results are opened: each is checked against its own description before it is read.

Whatever is wrong with a file becomes a ValueError of one sentence. Devices and pipes are never read, no name in a file
leads outside of it, and no size in a file is trusted before it is compared with the number of bytes.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import _checks
from lieint_jax.ensemble import _integrity, _store
from lieint_jax.ensemble._integrity import Table
from lieint_jax.ensemble._part_reading import PublishedArray
from lieint_jax.ensemble._parts import PartsRoot, read_root
from lieint_jax.ensemble._storage import Address, Bucket, Disk, Storage, Url
from lieint_jax.ensemble._store import state_from_leaves, store_name
from lieint_jax.types import StepInfo, System, Trajectory

SUFFIXES = (".npz", ".zarr")
TIME = "state.t"  # the times of the states in an .npz, where t is the time of the trajectory

_JSON_BYTES, _JSON_DEPTH = 2**26, 64
_MAX_RATIO, _SMALL = 100, 2**20  # an archive may expand by this factor, or to this many bytes
_CHUNK_BYTES = 2**30
_MAX_LENGTH = 10**15  # of an axis of an array
_MAX_PARTS = 10**6
_REALS, _FLAGS, _COUNTS = ("float32", "float64"), ("bool",), ("int32", "int64")
_SERIES = ("least", "greatest", "mean", "residual")
_ZIP_ENCRYPTED = 0x1


class UnreadableError(ValueError):
    """A file of results that cannot be read; the message is a sentence that names it."""


@contextlib.contextmanager
def wrap_errors(
    path: Address,
    what: str = "is no file of results that lieint wrote, or is damaged",
    passed: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """A context that turns every error into an `UnreadableError`, one sentence about the file at `path`.

    Errors of the operating system and of the types `passed` are raised unchanged.
    """
    try:
        yield
    except (UnreadableError, OSError, *passed):
        raise
    except Exception as error:  # a crafted file can make numpy, zipfile, zarr and json raise anything
        [reason, *_] = str(error).splitlines() or [""]
        if not isinstance(error, ValueError):
            reason = f"its content is invalid, {type(error).__name__} ({reason})"
        raise UnreadableError(f"{path} {what}: {reason}") from error


def refuse_special(path: Path) -> None:
    """Raise UnreadableError unless there is an ordinary file or a folder at `path`."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        if path.is_symlink():
            raise UnreadableError(f"{path} is a link to {os.readlink(path)}, which does not exist") from None
        named = path if path.suffix in SUFFIXES else path.with_suffix(".npz") if path.name else "NAME.npz"
        raise UnreadableError(f"there is no file {path}; lieint run NAME --out {named} writes one") from None
    except ValueError as error:  # a null character
        raise UnreadableError(f"{str(path)!r} is not the name of a file: {error}") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnreadableError(f"{path} is a device, a pipe or a socket; give a file NAME.npz or a store NAME.zarr")


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text of bounded size and depth."""
    if len(text) > _JSON_BYTES:
        raise ValueError(f"its description has {_checks.spoken_size(len(text))}, more than that of any run")
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("its description is nested too deeply") from None
    level = [found]
    for _ in range(_JSON_DEPTH):
        if not level:
            return found
        level = [
            part for x in level if isinstance(x, dict | list) for part in (x.values() if isinstance(x, dict) else x)
        ]
    raise ValueError("its description is nested too deeply")


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
        if headers["metadata"][1].itemsize > 4 * _JSON_BYTES:
            raise ValueError("its description is too long")
        with np.load(path, allow_pickle=False) as file:
            found = parse_json(str(file["metadata"]))
        _check_table("its metadata", found, _ARCHIVE_KEYS)
        return Archive(path, headers, {key: x for key, x in found.items() if key not in _STORE_KEYS})


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
        _check_run(kinds, {"q", "p"} | named, "t")
        if TIME in kinds:
            n, m = kinds["p"][0][:2]
            _expect(TIME, kinds, _REALS, (n, 1), (n, m))
        _check_scenario(found.metadata.get("scenario", {}), *kinds["p"][0][:2])
    read = found.read(*sorted(named | {"t", "residual", "converged"} | ({TIME} & set(kinds))))
    with wrap_errors(found.path):
        leaves = {name: read[name] for name in named}
        if TIME in read:
            leaves["t"] = np.broadcast_to(read[TIME], leaves["p"].shape[:2])
        _check_times(read["t"])
        return Trajectory(read["t"], state_from_leaves(leaves), StepInfo(read["residual"], read["converged"]))  # pyright: ignore[reportArgumentType]


_Kinds = Mapping[str, tuple[tuple[int, ...], str]]  # shape and dtype by name


def _check_run(kinds: _Kinds, leaves: set[str], time: str) -> None:
    """Raise ValueError unless all arrays of a run have the same number of entries and of members."""
    missing = ({time, "residual", "converged"} | leaves) - set(kinds)
    if missing:
        raise ValueError(f"it has no array {min(missing)}")
    (n, *_), (members, *_) = kinds["p"][0] or (0,), kinds["p"][0][1:] or (0,)
    if not members or (time == "t" and not n):
        raise ValueError(f"p has shape {kinds['p'][0]}, not (entries, members, …)")
    _expect(time, kinds, _REALS, (n,))
    _expect("residual", kinds, _REALS, (n, members))
    _expect("converged", kinds, _FLAGS, (n, members))
    for name in sorted(leaves):
        _expect(name, kinds, _REALS, (n, members), least=3 if name in ("q", "p") else 2)


def _expect(name: str, kinds: _Kinds, dtypes: tuple[str, ...], *shapes: tuple[int, ...], least: int = 0) -> None:
    """Raise ValueError unless an array has one of these dtypes and shapes; with `least`, at least so many axes."""
    shape, dtype = kinds[name]
    if dtype not in dtypes:
        raise ValueError(f"{name} is of {dtype}, not {' or '.join(dtypes)}")
    found = shape[: len(shapes[0])] if least else shape
    if found not in shapes or len(shape) < least:
        wanted = f"({', '.join(map(str, shapes[0]))}, …)" if least > len(shapes[0]) else " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {shape}, not {wanted}")


def _check_scenario(scenario: Table, entries: int, members: int) -> None:
    """Raise ValueError if the scenario of a file, where it has one of `lieint run`, plans a different run."""
    if "system" not in scenario:
        return
    _check_table("scenario", scenario, {"members": _COUNT, "steps": _COUNT, "save_every": _COUNT})
    save_at = scenario.get("save_at")
    if not (save_at is None or isinstance(save_at, list)):
        raise ValueError("save_at of its scenario is not a list")
    planned = scenario["steps"] // scenario["save_every"] + 1 if save_at is None else len(save_at) + 1
    if (planned, scenario["members"]) != (entries, members):
        raise ValueError(
            f"it has {entries} entries of {members} members, and its scenario {planned} of {scenario['members']}"
        )


def _check_times(t: np.ndarray) -> None:
    if not (np.isfinite(t).all() and ((np.diff(t) >= 0).all() or (np.diff(t) <= 0).all())):
        raise ValueError("its times are not finite and in order")


def check_store(path: Address) -> Table:
    """Check every file of the store at `path`, and return the store's attributes.

    For a store in parts only the description of the run is checked: `_part_reading.load` checks its parts one by one.

    Raises:
        UnreadableError: not a store of lieint, or its description does not fit its arrays.
        ValueError: a damaged store; the message names the files.
    """
    if isinstance(path, Url):
        return _check_bucket(path)
    refuse_special(path)
    if not path.is_dir():
        raise UnreadableError(f"{path} does not exist, or is not the store of a run: that is a folder NAME.zarr")
    with wrap_errors(path):
        count = _check_files(path)
    with wrap_errors(path, passed=(ValueError,)):
        root = _store.read_root(path)
    if "parts" in root["attributes"]:
        return _check_parts(Disk(path), root)
    with wrap_errors(path):
        shown = _check_arrays(root["consolidated_metadata"]["metadata"], count)
        _check_attributes(root["attributes"], shown)
    with wrap_errors(path, passed=(ValueError,)):
        _store.check(path)
    with wrap_errors(path):
        for name in root["attributes"].get("constants", ()):  # whose lengths do not grow
            if parse_json((path / name / "zarr.json").read_bytes())["shape"] != shown[name]["shape"]:
                raise ValueError(f"the shape of {name} differs from its description")
    return root["attributes"]


def _check_bucket(url: Url) -> Table:
    """Check the description of the run in a store in object storage, and return its attributes."""
    storage = Bucket(url)
    root = read_root(storage)
    if root is None:
        raise UnreadableError(f"there is no store {url}; lieint run NAME --out {url} writes one")
    if "parts" not in root["attributes"]:
        raise UnreadableError(f"{url} is a copy of a store that was written on a disk: copy it to a disk to read it")
    return _check_parts(storage, root)


def _check_parts(storage: Storage, root: Table) -> Table:
    """Check the description of a store in parts, and return its attributes."""
    found = root["attributes"]
    with wrap_errors(storage.address):
        shown = _check_arrays(root["consolidated_metadata"]["metadata"], None)
        _check_table("the description", found, _PARTS_KEYS)
        if found["parts"] > min(found["members"], _MAX_PARTS):
            raise ValueError(f"it has {found['parts']} parts of {found['members']} members")
        _check_attributes(found, shown)
        own = PartsRoot(storage, root)
        lost = list(own.damage_of_root())
    _integrity.raise_if_damaged(storage.address, lost)
    return found


def _check_files(path: Path) -> int:
    """The number of files in a store, which must be ordinary files, with descriptions of bounded size."""
    count = 0
    for folder, _, names in os.walk(path):
        for file in (Path(folder, name) for name in names):
            try:
                status = file.stat()
            except FileNotFoundError:
                if file.is_symlink():
                    raise ValueError(f"{file.relative_to(path)} is a link to nothing") from None
                continue  # a temporary file of a run that is writing
            if not stat.S_ISREG(status.st_mode):
                raise ValueError(f"{file.relative_to(path)} is a device, a pipe or a socket")
            count += 1
            if file.name == "zarr.json":
                if status.st_size > _JSON_BYTES:
                    raise ValueError(f"{file.relative_to(path)} has {_checks.spoken_size(status.st_size)}")
                with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError, FileNotFoundError):
                    parse_json(file.read_bytes())  # text that is not JSON is reported later, with what can be read
    return count


def _check_arrays(shown: Any, files: int | None) -> Table:
    """The descriptions of a store's arrays by name, which must be valid and need no more files than the store has.

    Args:
        shown: the consolidated metadata.
        files: the number of files in the store; None if it may lack some.
    """
    for name, array in shown.items():
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r} is not the name of an array")
        _check_table(
            name, array, {"shape": _LENGTHS, "data_type": _TEXT_OR_TABLE, "codecs": _TABLES, "node_type": _TEXT}
        )
        grid = array["chunk_grid"]
        chunk = grid["configuration"]["chunk_shape"]
        if grid["name"] != "regular" or not _LENGTHS.accepts(chunk) or len(chunk) != len(array["shape"]) or 0 in chunk:
            raise ValueError(f"{name} has chunks that do not fit its shape {tuple(array['shape'])}")
        if math.prod(chunk) * 8 > _CHUNK_BYTES:
            raise ValueError(f"{name} has chunks of {_checks.spoken_size(math.prod(chunk) * 8)}")
        chunks = math.prod(-(-n // size) for n, size in zip(array["shape"], chunk, strict=True))
        if files is not None and chunks > files:
            raise ValueError(f"{name} of shape {tuple(array['shape'])} has more chunks than there are files")
    return shown


def _check_attributes(found: Table, shown: Mapping[str, Table]) -> None:
    """Raise ValueError unless the attributes of a store describe a run with these arrays."""
    _check_table("the description", found, _STORE_KEYS)
    _check_table("progress", found["progress"], _PROGRESS_KEYS)
    _check_table("run", found["run"], _RUN_KEYS)
    leaves, constants = found.get("leaves", ["q", "p"]), found.get("constants", [])
    bad = [name for name in (*leaves, *constants) if not (isinstance(name, str) and _NAME.fullmatch(name))]
    if bad:
        raise ValueError(f"{bad[0]!r} is not the name of an array")
    kinds = {name: (tuple(array["shape"]), str(array["data_type"])) for name, array in shown.items()}
    leaves = [name if name in kinds else store_name(name) for name in leaves]  # format 2 has the names of states
    missing = set(constants) - set(kinds)
    if missing:
        raise ValueError(f"it has no array {min(missing)}")
    in_parts = "parts" in found
    entries, members = found["num_entries"] if in_parts else found["progress"]["entries"], found["members"]
    if found["reduce"] is not None:
        names = {*_SERIES, "unconverged", "time"}
        if not names <= set(kinds):
            raise ValueError(f"it has no array {min(names - set(kinds))}")
        for name in names:
            shape = (found["parts"], entries) if in_parts and name != "time" else (entries,)
            _expect(name, kinds, _COUNTS if name == "unconverged" else _REALS, shape)
        if in_parts and kinds.get("sums", ((),))[0][:2] != (found["parts"], entries):
            raise ValueError("it has no sums of its parts")
        if found["progress"]["complete"] or in_parts:
            for name in {*leaves, "first_failure"} - ({"t"} - set(kinds)):
                _expect(name, kinds, _COUNTS if name == "first_failure" else _REALS, (members,), least=1)
        return
    _check_run(kinds, set(leaves) - ({"t"} - set(kinds)), "time")
    if kinds["p"][0][:2] != (entries, members):
        raise ValueError(f"p has shape {kinds['p'][0]}, not ({entries}, {members}, …)")


class _Kind(NamedTuple):
    """The values that a description may have for a key: a test, and the test in words."""

    accepts: Callable[[object], bool]
    words: str
    required: bool = True


def _is_count(x: object) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and 0 <= x <= _MAX_LENGTH


_NAME = re.compile(r"(?!\.)[^/\\\0]+")
_NATURAL = _Kind(_is_count, "an integer ≥ 0")
_COUNT = _Kind(lambda x: _is_count(x) and x > 0, "a positive integer")
_TEXT = _Kind(lambda x: isinstance(x, str), "text")
_TABLE = _Kind(lambda x: isinstance(x, dict), "a table")
_TABLES = _Kind(lambda x: isinstance(x, list) and bool(x) and all(map(_TABLE.accepts, x)), "a list of tables")
_LIST = _Kind(lambda x: isinstance(x, list), "a list", required=False)
_LENGTHS = _Kind(lambda x: isinstance(x, list) and all(map(_is_count, x)), "a list of lengths")
_TEXT_OR_TABLE = _Kind(lambda x: isinstance(x, str | dict), "text")
_FLAG = _Kind(lambda x: isinstance(x, bool), "true or false")
_ARCHIVE_KEYS = {
    "scenario": _TABLE._replace(required=False),
    **dict.fromkeys(("title", "study", "lieint_jax", "jax"), _TEXT._replace(required=False)),
    "quick": _FLAG._replace(required=False),
    "tree": _Kind(lambda _: True, "a tree", required=False),
}
_STORE_KEYS = {
    "progress": _TABLE,
    "run": _TABLE,
    "members": _COUNT,
    "num_steps": _NATURAL,
    "num_entries": _NATURAL._replace(required=False),
    "save_every": _Kind(lambda x: x is None or _COUNT.accepts(x), "a positive integer or null"),
    "dt": _Kind(lambda x: x is None or (isinstance(x, int | float) and not isinstance(x, bool)), "a number or null"),
    "reduce": _Kind(lambda x: x is None or isinstance(x, str), "text or null"),
    "scheme": _TEXT,
    "system": _TEXT,
    "time_unit": _TEXT._replace(required=False),
    "leaves": _LIST,
    "constants": _LIST,
    "description": _TABLE._replace(required=False),
}
_PARTS_KEYS = dict.fromkeys(("parts", "num_entries", "member_chunk", "time_chunk"), _COUNT) | {"digests": _TABLE}
_PROGRESS_KEYS = dict.fromkeys(("commits", "entries", "steps"), _NATURAL) | {"complete": _FLAG}
_ARRAY = {"shape": _LENGTHS, "data_type": _TEXT_OR_TABLE, "codecs": _TABLES, "node_type": _TEXT}
_RUN_KEYS = {
    "versions": _Kind(lambda x: isinstance(x, dict) and all(map(_TEXT.accepts, x.values())), "a table of text"),
    "device": _TEXT,
    "step_axis": _Kind(lambda x: x is None or (_is_count(x) and x == 0), "null or 0"),
    "engine": _TEXT._replace(required=False),
    "compiler_options": _TABLE,
}


def _check_table(where: str, found: object, kinds: Mapping[str, _Kind]) -> None:
    """Raise ValueError if a table in a description lacks a key, or has a value of another kind."""
    if not isinstance(found, dict):
        raise ValueError(f"{where} is not a table")
    for key, (accepts, words, required) in kinds.items():
        if key not in found and required:
            raise ValueError(f"{where} has no {key}")
        if key in found and not accepts(found[key]):
            raise ValueError(f"{key} of {where} is not {words}")


def check_system(path: Address, system: System, run: Trajectory, own_system: bool) -> None:
    """Raise UnreadableError unless the run in a file has states of this system.

    Args:
        path: the file.
        system: the system; with the member axis on its numbers if `own_system`.
        run: the run.
        own_system: True if each member has a system of its own.
    """
    members = run.state.p.shape[1]
    with wrap_errors(path):
        if own_system and any(np.shape(leaf)[:1] != (members,) for leaf in jax.tree.leaves(system)):
            raise ValueError(f"its system does not have one value for each of its {members} members")
        m = run.state.p.first_published if isinstance(run.state.p, PublishedArray) else 0
        first = jax.tree.map(lambda x: x[m], system) if own_system else system
        state = jax.tree.map(lambda x: jnp.asarray(x[0, m]), run.state)
        first.check(state)
        if jax.eval_shape(lambda s, z: s.energy(z), first, state).shape != ():
            raise ValueError("the energy of its system is not defined for these states")
