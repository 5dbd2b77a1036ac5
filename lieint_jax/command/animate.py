"""The command `animate`: it draws the rotating bodies of a stored run, as GIF, MP4 or HTML for use offline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from lieint_jax.command import info
from lieint_jax.command.plot import check_folder, check_replaceable, path_in_folder
from lieint_jax.command.printer import show, show_written
from lieint_jax.core import Trajectory
from lieint_jax.plots import film, solids
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import UnknownNameError


def animate(
    path: tyro.conf.Positional[str],
    out: Path | None = None,
    member: int = 0,
    first: Annotated[float | None, tyro.conf.arg(name="from")] = None,
    last: Annotated[float | None, tyro.conf.arg(name="to")] = None,
    seconds: float | None = None,
    fps: int = 20,
    shape: tuple[Path, ...] = (),
    force: bool = False,
) -> None:
    """Draw the rotating bodies of a stored run, with the paths of their axes: GIF, MP4 or HTML.

    Args:
        path: the store, NAME.zarr or NAME.zip, by its path or URL.
        out: NAME.gif, NAME.mp4 or NAME.html; by default a GIF next to the store, or here if that is at a URL.
        member: the index of the member, from 0.
        first: the time of the first frame; by default the start.
        last: the time of the last frame; by default as far as is smooth.
        seconds: the duration, shorter if the run has fewer states to show; by default 6, or with --to as many as show
            it smoothly, up to 30.
        fps: frames per second.
        shape: files with the surfaces of the bodies in the axes of their inertia: .obj, .stl, .ply.
        force: replace an existing file.
    """
    place = archives.address(path)
    named = path_in_folder(place, None)
    out = Path(f"{named.parent / named.stem}.gif") if out is None else out
    film.check_format(out)
    check_folder(out.parent)
    check_replaceable([out], force)
    run, metadata = archives.load_store(place)
    if not isinstance(run, Trajectory):
        raise ValueError(f"{path} holds a run with `reduce`, which stores no states: there is nothing to animate")
    if len(run.t) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to animate yet")
    if not 0 <= member < run.state.p.shape[1]:
        raise ValueError(f"the run has members 0 to {run.state.p.shape[1] - 1}, got --member {member}")
    try:
        one = info.select_from(place, run, metadata)(members=slice(member, member + 1)).member(0)
    except UnknownNameError as error:
        raise ValueError(f'{error}; li.plots.animate(run, "{out.name}") draws that run') from None
    surfaces = [solids.read(file) for file in shape]
    scene = film.make_scene(one, info.title_of(place, metadata), seconds, fps, (first, last), surfaces)
    show(f"{scene.title}, member {member}: {scene.clock(0)} … {scene.clock(-1)}, {len(scene.t)} frames")
    show(*(f"  {note}" for note in scene.notes))
    if scene.needed > len(scene.t):
        longer = f"--seconds {np.ceil(scene.needed / fps):.0f}"
        part = f"{longer} shows all, --to T all up to T, --from T another part"
        show(f"  the rest does not fit at this speed: {part}" if last is None else f"  {longer} shows it smoothly")
    show("  drawing; 100 frames need about ten seconds …")
    film.write(scene, out, fps)
    show_written(out, about=f"{out.stat().st_size / 1e6:.3g} MB")
