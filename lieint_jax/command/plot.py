"""The command `plot`: it reports on the run in a store and draws it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import tyro

from lieint_jax import plots, report
from lieint_jax.command import info
from lieint_jax.command.printer import show, show_written
from lieint_jax.core import Trajectory
from lieint_jax.plots.runs import pictures_of, reduced_change
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address, UnknownNameError, Url

_SHOWN = 2**28  # largest number of bytes that are read from a store to draw it


def plot(path: tyro.conf.Positional[str], out: Path | None = None, force: bool = False) -> None:
    """Report on the run in a store and draw it: errors of energy and momentum, the motion, works of laws.

    Args:
        path: the store, NAME.zarr or NAME.zip, by its path or URL.
        out: the folder of the pictures; by default that of the store.
        force: replace existing pictures.
    """
    place = archives.address(path)
    run, metadata = archives.load_store(place)
    if len(info.times_of(run)) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to draw yet")
    named, title = path_in_folder(place, out), info.title_of(place, metadata)
    if not isinstance(run, Trajectory):
        picture = named.with_name(f"{named.stem}-change.png")
        check_replaceable(plots.files(picture), force)
        show(info.text(place))
        show_written(*plots.save(reduced_change(run, title, info.time_unit_of(metadata)), picture))
        return
    pictures = [named.with_name(f"{named.stem}-{kind}.png") for kind in pictures_of(run.state)]
    check_replaceable([file for picture in pictures for file in plots.files(picture)], force)
    members = run.state.p.shape[1]
    drawn = _count_drawn(run)
    try:
        chosen = info.select_from(place, run, metadata)(members=slice(drawn))
    except UnknownNameError as error:
        raise ValueError(f'{error}; li.plots.overview(run, "{place.name}") draws that run') from None
    show(report.text(title, chosen, changed=report.changes(chosen), time_unit=info.time_unit_of(metadata)))
    if drawn < members:
        show(f"  the first {drawn} of {members} members")
    show_written(*plots.overview(chosen, named, title))


def _count_drawn(run: Any) -> int:
    """How many members are drawn: as many, from the first on, as `_SHOWN` allows."""
    return max(1, min(_SHOWN // sum(x[:, 0].nbytes for x in jax.tree.leaves(run.state)), run.state.p.shape[1]))


def path_in_folder(path: Address, folder: Path | None) -> Path:
    """The path after which pictures of a store are named: in `folder` if one is given, which must exist.

    Without a folder, the pictures of a store at a URL are written to the current folder.
    """
    if isinstance(path, Url):
        path = Path(path.name)
    if folder is None:
        return path
    check_folder(folder)
    return folder / path.name


def check_folder(folder: Path) -> None:
    """Raise ValueError if there is no such folder."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, not a folder; choose another --out")
    if not folder.is_dir():
        raise ValueError(f"the folder {folder} does not exist; make it first")


def check_replaceable(files: list[Path], force: bool) -> None:
    """Raise ValueError if one of these files exists, unless `force` allows its replacement."""
    for file in files:
        if file.exists() and not force:
            raise ValueError(f"{file} exists and is not overwritten; --force replaces it, --out chooses another place")
