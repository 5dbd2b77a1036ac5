"""Files of results: NAME.npz holds a finished run, the folder NAME.zarr is a store that grows."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from lieint_jax import plots
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address, Url


def check_writable(path: Address, kinds: Iterable[str] = (), resume: bool = False) -> Address:
    """Check that results can be written to `path`, and return it.

    The path must end in .npz or .zarr, neither it nor its pictures may exist, and its folder must be writable. With
    `resume`, a .zarr may exist. A URL is not checked here: the run itself does that.

    Raises:
        ValueError: results cannot be written there; the message has the reason and the remedy.
    """
    if isinstance(path, Url):
        return path
    if path.suffix not in archives.SUFFIXES:
        raise ValueError(f"results are written as .npz or .zarr, got {path}")
    if resume and path.suffix != ".zarr":
        raise ValueError(f"only a run written as .zarr can be resumed, got {path}")
    found = [] if resume else [path]
    for file in (*found, *(pictures(path, kinds) if path.suffix == ".npz" else [])):
        if file.is_symlink() and not file.exists():
            raise ValueError(f"{file} is a broken link; move it away or choose another --out")
        if file.exists():
            more = "; resume continues it" if file.suffix == ".zarr" else ""
            raise ValueError(f"{file} exists and is not overwritten; move it away or choose another --out{more}")
    check_folder(path.parent)
    _check_access(path.parent)
    return path


def make_folder(folder: Path) -> None:
    """Make a folder for results, if it does not exist; ValueError if nothing can be written to it."""
    folder.mkdir(parents=True, exist_ok=True)
    _check_access(folder)


def _check_access(folder: Path) -> None:
    if not os.access(folder, os.W_OK):
        raise ValueError(f"the folder {folder} cannot be written to; choose another --out")


def check_folder(folder: Path) -> None:
    """Raise ValueError if there is no such folder."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, not a folder; choose another --out")
    if not folder.is_dir():
        raise ValueError(f"the folder {folder} does not exist; make it first")


def picture(path: Path, kind: str) -> Path:
    """The path of a picture next to results at `path`, such as NAME-path.png for the kind "path"."""
    return path.with_name(f"{path.stem}-{kind}.png")


def pictures(path: Path, kinds: Iterable[str]) -> list[Path]:
    """The files of the pictures next to results at `path`: each is written as PNG and as PDF."""
    return [file for kind in kinds for file in plots.files(picture(path, kind))]


def path_in_folder(path: Address, folder: Path | None) -> Path:
    """The path after which pictures of results at `path` are named: in `folder` if one is given, which must exist.

    Without a folder, the pictures of results at a URL are written to the current folder.
    """
    if isinstance(path, Url):
        path = Path(path.name)
    if folder:
        check_folder(folder)
    return folder / path.name if folder else path


def check_replaceable(found: Iterable[Path], force: bool) -> None:
    """Raise ValueError if one of these files exists, unless `force` allows its replacement."""
    for file in found:
        if file.exists() and not force:
            raise ValueError(f"{file} exists and is not overwritten; --force replaces it, --out chooses another folder")


def read_numbers(path: Path) -> list[float]:
    """Read the numbers of a text file, one per line; # begins a comment."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}: give a text file with one number per line")
    try:
        return np.loadtxt(path, ndmin=1).ravel().tolist()
    except ValueError as error:
        raise ValueError(f"{path} must hold one number per line: {error}") from error


def megabytes(path: Address) -> str:
    """The size of a file, or of all files of a folder or below a URL, in megabytes, as text."""
    if isinstance(path, Url):
        size = sum(archives.open_storage(path).sizes().values())
    else:
        size = sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())
    return f"{size / 1e6:.3g} MB"


def unused_path(path: Path, companions: Callable[[Path], Iterable[Path]]) -> Path:
    """`path`, or the first of path-2, path-3, … for which neither the file nor its `companions` exist."""
    candidate, k = path, 1
    while any(file.exists() for file in (candidate, *companions(candidate))):
        k += 1
        candidate = path.with_stem(f"{path.stem}-{k}")
    return candidate
