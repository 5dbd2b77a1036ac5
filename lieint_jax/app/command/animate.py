"""The command `animate`: turning bodies of a stored run, as GIF, MP4 or a page of HTML that needs no network."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.command import files, info, scene
from lieint_jax.app.command.scene import Scene, Span
from lieint_jax.types import Trajectory

SUFFIXES = (".gif", ".mp4", ".html")
_DPI = 100
_INCHES = 4.8


def animate(
    path: Path,
    out: Path | None = None,
    member: int = 0,
    seconds: float = 6.0,
    fps: int = 20,
    force: bool = False,
    span: Span = (None, None),
) -> None:
    """Write a moving picture of one member of a file of results, with the paths of axes and the momentum vectors.

    Args:
        path: the file.
        out: NAME.gif, NAME.mp4 or NAME.html; by default a GIF beside the file.
        member: which one.
        seconds: how long it lasts, unless the run has fewer states to show.
        fps: frames a second.
        force: replace a file that exists.
        span: the times to show, from the first to the second; None is that of the run.

    Raises:
        ValueError: a name that cannot be written, a run that has no rigid bodies or no states, something not installed.
    """
    out = path.with_suffix(".gif") if out is None else out
    _check(out, force)
    if not 0 < seconds < float("inf"):
        raise ValueError(f"--seconds must be positive, got {seconds:g}")
    run, metadata = files.load(path)
    if not isinstance(run, Trajectory):
        raise ValueError(f"{path} is of a run with `reduce`, which keeps no states: there is nothing to animate")
    if len(run.t) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to animate yet")
    found = scene.scene_of(info.stored_run(path, run, metadata), member, max(2, round(seconds * fps)), span)
    print(f"{found.title}, member {member}: {found.clock(0)} … {found.clock(-1)}, {len(found.t)} frames")
    print("\n".join(f"  {note}" for note in found.notes))
    if found.needed > len(found.t):
        longer = f"--seconds {np.ceil(found.needed / fps):.0f} shows all, --from and --to another part"
        print(f"  the rest does not fit at this speed: {longer}")
    print("  drawing; 100 frames take some ten seconds …", flush=True)
    (_write_html if out.suffix == ".html" else _write_film)(found, out, fps)
    print(f"\nwritten: {out} ({files.megabytes(out)})")


def _check(out: Path, force: bool) -> None:
    """ValueError if `out` cannot be written, or what writes it is not installed."""
    from matplotlib.animation import FFMpegWriter

    if out.suffix not in SUFFIXES:
        raise ValueError(f"an animation is written as {', '.join(SUFFIXES)}, got {out}")
    if not out.parent.is_dir():
        raise ValueError(f"the folder {out.parent} does not exist; make it first")
    if out.exists() and not force:
        raise ValueError(f"{out} exists and is not overwritten; --force replaces it, --out takes another name")
    if out.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ValueError("MP4 needs ffmpeg, which is not installed: install it (apt install ffmpeg, …), or take .gif")
    if out.suffix == ".html":
        _graph_objects()


def _graph_objects() -> Any:
    try:
        return importlib.import_module("plotly.graph_objects")
    except ImportError as error:
        raise ValueError('HTML needs plotly: pip install "lieint_jax[animate]", or take .gif') from error


def _bar(frames: int) -> Iterator[int]:
    """The indices of the frames, with a progress bar on a terminal."""
    from tqdm import tqdm

    return iter(tqdm(range(frames), unit=" frames", disable=None, leave=False, dynamic_ncols=True))


def _caption(found: Scene) -> str:
    return ". ".join(note[0].upper() + note[1:] for note in found.notes) + "."


@plots.style()
def _write_film(found: Scene, out: Path, fps: int) -> None:
    """GIF or MP4, by matplotlib."""
    from matplotlib.animation import FFMpegWriter, PillowWriter

    fig, axes = plots.figure(size=(_INCHES, _INCHES), subplot_kw={"projection": "3d"})
    moving = _draw(fig, axes[0, 0], found)
    writer = (PillowWriter if out.suffix == ".gif" else FFMpegWriter)(fps=fps)
    with writer.saving(fig, str(out), _DPI):
        for frame in _bar(len(found.t)):
            _move(axes[0, 0], moving, found, frame)
            writer.grab_frame()


def _draw(fig: Figure, ax: Any, found: Scene) -> list[tuple[Any, ...]]:
    """Draw what stands still; the surface, path so far, axis and momentum vector of each body, to be moved."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    moving = []
    for body, solid in enumerate(found.solids):
        surface = Poly3DCollection(_polygons(found, 0, body), facecolors=solid.colors, edgecolors=plots.INK, lw=0.3)
        ax.add_collection3d(surface)
        ax.plot(*found.paths[:, body].T, color=plots.BLUE, lw=0.5, alpha=0.3)
        [path] = ax.plot([], [], [], color=plots.BLUE, lw=1.0)
        end: dict[str, Any] = {"lw": 1.8, "marker": "o", "markevery": [1]}
        axis, arrow = (ax.plot([], [], [], color=color, **end)[0] for color in (plots.BLUE, plots.RED))
        moving.append((surface, path, axis, arrow))
    limits = np.stack([found.middle - found.reach, found.middle + found.reach], axis=1)
    ax.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()
    fig.suptitle(found.title)
    plots.caption(fig, _caption(found))
    return moving


def _move(ax: Any, moving: list[tuple[Any, ...]], found: Scene, frame: int) -> None:
    for body, (surface, path, axis, arrow) in enumerate(moving):
        surface.set_verts(_polygons(found, frame, body))
        path.set_data_3d(*found.paths[: frame * found.fine + 1, body].T)
        axis.set_data_3d(*found.axis(frame, body).T)
        arrow.set_data_3d(*found.arrow(frame, body).T)
    ax.set_title(found.clock(frame))


def _polygons(found: Scene, frame: int, body: int) -> list[np.ndarray]:
    corners = found.corners(frame, body)
    return [corners[list(face)] for face in found.solids[body].faces]


def _write_html(found: Scene, out: Path, fps: int) -> None:
    """A page with a button to play and a slider, by plotly, whose script it contains."""
    go = _graph_objects()
    names = [f"{k}" for k in range(len(found.t))]
    frames = [
        go.Frame(name=names[k], data=_traces(go, found, k), traces=list(range(3 * len(found.solids))))
        for k in _bar(len(found.t))
    ]
    line = {"mode": "lines", "line": {"color": plots.BLUE, "width": 2}, "hoverinfo": "skip"}
    whole = [go.Scatter3d(**_xyz(found.paths[:, body]), **line) for body in range(len(found.solids))]
    at_once: dict[str, Any] = {"mode": "immediate", "fromcurrent": True, "transition": {"duration": 0}}
    pace = at_once | {"frame": {"duration": 1000 / fps, "redraw": True}}
    buttons = [
        {"label": "▶", "method": "animate", "args": [None, pace]},
        {"label": "❚❚", "method": "animate", "args": [[None], at_once | {"frame": {"duration": 0, "redraw": False}}]},
    ]
    steps = [
        {"label": found.clock(k), "method": "animate", "args": [[name], at_once | {"frame": {"duration": 0}}]}
        for k, name in enumerate(names)
    ]
    hidden = {"visible": False}
    ranges = [[m - found.reach, m + found.reach] for m in found.middle]
    fig = go.Figure(data=[*_traces(go, found, 0), *whole], frames=frames)
    fig.update_layout(
        title={"text": f"{found.title}<br><sup>{_caption(found)}</sup>"},
        scene={f"{name}axis": hidden | {"range": between} for name, between in zip("xyz", ranges, strict=True)}
        | {"aspectmode": "cube", "camera": {"eye": {"x": 1.1, "y": 1.1, "z": 0.6}}},
        showlegend=False,
        updatemenus=[{"type": "buttons", "direction": "left", "x": 0, "y": 0, "xanchor": "left", "buttons": buttons}],
        sliders=[{"x": 0.15, "len": 0.85, "steps": steps, "currentvalue": {"prefix": ""}, "ticklen": 0}],
        uirevision="one",  # a view that the reader has turned stays while it plays
    )
    play = {"frame": pace["frame"], "transition": {"duration": 0}, "mode": "immediate"}
    fig.write_html(out, include_plotlyjs=True, animation_opts=play, config={"displaylogo": False})


def _traces(go: Any, found: Scene, frame: int) -> list[Any]:
    """The surface, the axis and the momentum vector of each body in a frame."""
    traces = []
    for body, solid in enumerate(found.solids):
        triangles = [(face[0], *face[k : k + 2]) for face in solid.faces for k in range(1, len(face) - 1)]
        colors = [c for c, face in zip(solid.colors, solid.faces, strict=True) for _ in range(len(face) - 2)]
        i, j, k = np.array(triangles).T
        surface = _xyz(found.corners(frame, body)) | {"i": i, "j": j, "k": k, "facecolor": colors}
        traces.append(go.Mesh3d(**surface, flatshading=True, hoverinfo="skip"))
        for ends, color in ((found.axis(frame, body), plots.BLUE), (found.arrow(frame, body), plots.RED)):
            look = {"line": {"color": color, "width": 8}, "marker": {"size": [0, 6], "color": color}}
            traces.append(go.Scatter3d(**_xyz(ends), mode="lines+markers", hoverinfo="skip", **look))
    return traces


def _xyz(points: np.ndarray) -> dict[str, np.ndarray]:
    """Points (n, 3) as plotly takes them, in single precision: a page is half as large."""
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))
