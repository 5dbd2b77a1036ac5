"""The command `animate`: it draws the rotating bodies of a stored run, as GIF, MP4 or HTML for use offline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lieint_jax.app.command import files, info, meshes
from lieint_jax.app.printer import show, show_written
from lieint_jax.plots import film
from lieint_jax.plots.scene import Span
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address
from lieint_jax.types import Trajectory


def animate(
    path: Address,
    out: Path | None = None,
    member: int = 0,
    seconds: float | None = None,
    fps: int = 20,
    force: bool = False,
    span: Span = (None, None),
    shapes: Sequence[Path] = (),
    own_kind: str = "",
) -> None:
    """Write an animation of one member of a stored run, with the paths of body axes and the momentum vectors.

    Args:
        path: the file of results.
        out: NAME.gif, NAME.mp4 or NAME.html; by default a GIF next to the file, or here if that is at a URL.
        member: the index of the member.
        seconds: the duration of the animation; it is shorter if the run has fewer states to show. By default 6, or with
            the end of a span as many as show it smoothly, up to 30.
        fps: frames per second.
        force: replace an existing file.
        span: the times to show, from the first to the second, all of it. Without the second, as much as is smooth.
        shapes: files with the shapes of the bodies, see `meshes.read`.
        own_kind: the kind of its scenario, FILE.py:CLASS, if it is a user's.

    Raises:
        ValueError: `out` cannot be written, the run has no rigid bodies or no states, or a program is not installed.
    """
    named = files.path_in_folder(path, None)
    out = Path(f"{named.parent / named.stem}.gif") if out is None else out
    _check(out, force)
    run, metadata = archives.load_results(path)
    if not isinstance(run, Trajectory):
        raise ValueError(f"{path} holds a run with `reduce`, which stores no states: there is nothing to animate")
    if len(run.t) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to animate yet")
    if not 0 <= member < run.state.p.shape[1]:
        raise ValueError(f"the run has members 0 to {run.state.p.shape[1] - 1}, got --member {member}")
    title, select = info.title_and_states(path, run, metadata, info.own_scenario(path, metadata, own_kind))
    one, found = select(members=slice(member, member + 1)).member(0), [meshes.read(file) for file in shapes]
    scene = film.make_scene(one, title, seconds, fps, span, found)
    show(f"{scene.title}, member {member}: {scene.clock(0)} … {scene.clock(-1)}, {len(scene.t)} frames")
    show(*(f"  {note}" for note in scene.notes))
    if scene.needed > len(scene.t):
        longer = f"--seconds {np.ceil(scene.needed / fps):.0f}"
        part = f"{longer} shows all, --to T all up to T, --from T another part"
        show(f"  the rest does not fit at this speed: {part}" if span[1] is None else f"  {longer} shows it smoothly")
    show("  drawing; 100 frames need about ten seconds …")
    film.write(scene, out, fps)
    show_written(out, about=files.megabytes(out))


def _check(out: Path, force: bool) -> None:
    """Raise ValueError if `out` cannot be written, or the program that writes it is not installed."""
    film.check_format(out)
    files.check_folder(out.parent)
    if out.exists() and not force:
        raise ValueError(f"{out} exists and is not overwritten; --force replaces it, --out chooses another name")
