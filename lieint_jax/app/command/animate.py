"""The command `animate`: it draws the rotating bodies of a stored run, as GIF, MP4 or HTML for use offline."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lieint_jax import plots
from lieint_jax.app.command import files, info, meshes
from lieint_jax.app.command.scene import Scene, Span, scene_of
from lieint_jax.app.printer import show, show_written
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import Address
from lieint_jax.types import Trajectory

SUFFIXES = (".gif", ".mp4", ".html")
_DPI = 100
_INCHES = 4.8
_SECONDS, _LONGEST = 6.0, 30.0  # durations of an animation without --seconds: with --to it is as long as is smooth
_MOST_FRAMES = 5000  # 5 GB of memory for a GIF, and minutes
_EDGES = 60  # faces of a body, up to which their edges are drawn


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
    if seconds is not None and not 0 < seconds < float("inf"):
        raise ValueError(f"--seconds must be positive, got {seconds:g}")
    frames = max(2, round((seconds or _SECONDS) * fps))
    if frames > _MOST_FRAMES:
        raise ValueError(
            f"{seconds or _SECONDS:g} seconds of {fps} frames are {frames:.7g} frames, the most are {_MOST_FRAMES}: "
            "give fewer --seconds or --fps"
        )
    run, metadata = archives.load_results(path)
    if not isinstance(run, Trajectory):
        raise ValueError(f"{path} holds a run with `reduce`, which stores no states: there is nothing to animate")
    if len(run.t) < 2:
        raise ValueError(f"{path} holds the initial states only: there is nothing to animate yet")
    if not 0 <= member < run.state.p.shape[1]:
        raise ValueError(f"the run has members 0 to {run.state.p.shape[1] - 1}, got --member {member}")
    title, select = info.title_and_states(path, run, metadata, info.own_scenario(path, metadata, own_kind))
    one, found = select(members=slice(member, member + 1)).member(0), [meshes.read(file) for file in shapes]
    scene = scene_of(one, title, frames, span, found)
    if seconds is None and span[1] is not None and scene.needed > len(scene.t):
        scene = scene_of(one, title, min(scene.needed, round(_LONGEST * fps), _MOST_FRAMES), span, found)
    show(f"{scene.title}, member {member}: {scene.clock(0)} … {scene.clock(-1)}, {len(scene.t)} frames")
    show(*(f"  {note}" for note in scene.notes))
    if scene.needed > len(scene.t):
        longer = f"--seconds {np.ceil(scene.needed / fps):.0f}"
        part = f"{longer} shows all, --to T all up to T, --from T another part"
        show(f"  the rest does not fit at this speed: {part}" if span[1] is None else f"  {longer} shows it smoothly")
    show("  drawing; 100 frames need about ten seconds …")
    (_write_html if out.suffix == ".html" else _write_film)(scene, out, fps)
    show_written(out, about=files.megabytes(out))


def _check(out: Path, force: bool) -> None:
    """Raise ValueError if `out` cannot be written, or the program that writes it is not installed."""
    from matplotlib.animation import FFMpegWriter

    if out.suffix not in SUFFIXES:
        raise ValueError(f"an animation is written as {', '.join(SUFFIXES)}, got {out}")
    files.check_folder(out.parent)
    if out.exists() and not force:
        raise ValueError(f"{out} exists and is not overwritten; --force replaces it, --out chooses another name")
    if out.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ValueError("MP4 needs ffmpeg, which is not installed: install it (apt install ffmpeg, …), or write .gif")
    if out.suffix == ".html":
        _graph_objects()


def _graph_objects() -> Any:
    try:
        return importlib.import_module("plotly.graph_objects")
    except ImportError as error:
        raise ValueError('HTML needs plotly: pip install "lieint_jax[animate]", or write .gif') from error


def _frame_numbers(frames: int) -> Iterator[int]:
    """The indices of the frames, with a progress bar on a terminal."""
    from tqdm import tqdm

    return iter(tqdm(range(frames), unit=" frames", disable=None, leave=False, dynamic_ncols=True))


def _caption(scene: Scene) -> str:
    return ". ".join(note[0].upper() + note[1:] for note in scene.notes) + "."


@plots.style()
def _write_film(scene: Scene, out: Path, fps: int) -> None:
    """Write a GIF or an MP4, by matplotlib."""
    from matplotlib.animation import FFMpegWriter, PillowWriter

    fig, axes = plots.figure(size=(_INCHES, _INCHES), subplot_kw={"projection": "3d"})
    moving = _draw(fig, axes[0, 0], scene)
    writer = (PillowWriter if out.suffix == ".gif" else FFMpegWriter)(fps=fps)
    with writer.saving(fig, str(out), _DPI):
        for frame in _frame_numbers(len(scene.t)):
            _move(axes[0, 0], moving, scene, frame)
            writer.grab_frame()


def _draw(fig: Figure, ax: Any, scene: Scene) -> list[tuple[Any, ...]]:
    """Draw what does not move, and return the surface, past path, axis and momentum vector of each body, which do."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    moving = []
    for body, solid in enumerate(scene.solids):
        edges = plots.INK if len(solid.faces) <= _EDGES else solid.colors
        surface = Poly3DCollection(_polygons(scene, 0, body), facecolors=solid.colors, edgecolors=edges, lw=0.3)
        ax.add_collection3d(surface)
        ax.plot(*scene.paths[:, body].T, color=plots.BLUE, lw=0.5, alpha=0.3)
        [path] = ax.plot([], [], [], color=plots.BLUE, lw=1.0)
        end: dict[str, Any] = {"lw": 1.8, "marker": "o", "markevery": [1]}
        axis, arrow = (ax.plot([], [], [], color=color, **end)[0] for color in (plots.BLUE, plots.RED))
        moving.append((surface, path, axis, arrow))
    limits = np.stack([scene.middle - scene.reach, scene.middle + scene.reach], axis=1)
    ax.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()
    fig.suptitle(scene.title)
    plots.caption(fig, _caption(scene))
    return moving


def _move(ax: Any, moving: list[tuple[Any, ...]], scene: Scene, frame: int) -> None:
    for body, (surface, path, axis, arrow) in enumerate(moving):
        surface.set_verts(_polygons(scene, frame, body))
        path.set_data_3d(*scene.paths[: frame * scene.fine + 1, body].T)
        axis.set_data_3d(*scene.axis(frame, body).T)
        arrow.set_data_3d(*scene.arrow(frame, body).T)
    ax.set_title(scene.clock(frame))


def _polygons(scene: Scene, frame: int, body: int) -> list[np.ndarray]:
    corners = scene.corners(frame, body)
    return [corners[list(face)] for face in scene.solids[body].faces]


def _write_html(scene: Scene, out: Path, fps: int) -> None:
    """Write a page with a play button and a slider, by plotly, whose script the page contains."""
    go = _graph_objects()
    names = [f"{k}" for k in range(len(scene.t))]
    frames = [
        go.Frame(name=names[k], data=_traces(go, scene, k), traces=list(range(3 * len(scene.solids))))
        for k in _frame_numbers(len(scene.t))
    ]
    line = {"mode": "lines", "line": {"color": plots.BLUE, "width": 2}, "hoverinfo": "skip"}
    whole = [go.Scatter3d(**_xyz(scene.paths[:, body]), **line) for body in range(len(scene.solids))]
    at_once: dict[str, Any] = {"mode": "immediate", "fromcurrent": True, "transition": {"duration": 0}}
    pace = at_once | {"frame": {"duration": 1000 / fps, "redraw": True}}
    buttons = [
        {"label": "▶", "method": "animate", "args": [None, pace]},
        {"label": "❚❚", "method": "animate", "args": [[None], at_once | {"frame": {"duration": 0, "redraw": False}}]},
    ]
    steps = [
        {"label": scene.clock(k), "method": "animate", "args": [[name], at_once | {"frame": {"duration": 0}}]}
        for k, name in enumerate(names)
    ]
    hidden = {"visible": False}
    ranges = [[m - scene.reach, m + scene.reach] for m in scene.middle]
    fig = go.Figure(data=[*_traces(go, scene, 0), *whole], frames=frames)
    fig.update_layout(
        title={"text": f"{scene.title}<br><sup>{_caption(scene)}</sup>"},
        scene={f"{name}axis": hidden | {"range": between} for name, between in zip("xyz", ranges, strict=True)}
        | {"aspectmode": "cube", "camera": {"eye": {"x": 1.1, "y": 1.1, "z": 0.6}}},
        showlegend=False,
        updatemenus=[{"type": "buttons", "direction": "left", "x": 0, "y": 0, "xanchor": "left", "buttons": buttons}],
        sliders=[{"x": 0.15, "len": 0.85, "steps": steps, "currentvalue": {"prefix": ""}, "ticklen": 0}],
        uirevision="one",  # the view that the reader has chosen does not change while the animation plays
    )
    play = {"frame": pace["frame"], "transition": {"duration": 0}, "mode": "immediate"}
    fig.write_html(out, include_plotlyjs=True, animation_opts=play, config={"displaylogo": False})


def _traces(go: Any, scene: Scene, frame: int) -> list[Any]:
    """The surface, the axis and the momentum vector of each body in a frame, as traces of plotly."""
    traces = []
    for body, solid in enumerate(scene.solids):
        triangles = [(face[0], *face[k : k + 2]) for face in solid.faces for k in range(1, len(face) - 1)]
        colors = [c for c, face in zip(solid.colors, solid.faces, strict=True) for _ in range(len(face) - 2)]
        i, j, k = np.array(triangles).T
        surface = _xyz(scene.corners(frame, body)) | {"i": i, "j": j, "k": k, "facecolor": colors}
        traces.append(go.Mesh3d(**surface, flatshading=True, hoverinfo="skip"))
        for ends, color in ((scene.axis(frame, body), plots.BLUE), (scene.arrow(frame, body), plots.RED)):
            look = {"line": {"color": color, "width": 8}, "marker": {"size": [0, 6], "color": color}}
            traces.append(go.Scatter3d(**_xyz(ends), mode="lines+markers", hoverinfo="skip", **look))
    return traces


def _xyz(points: np.ndarray) -> dict[str, np.ndarray]:
    """The arguments x, y, z of a trace for points (n, 3), in single precision, which halves the size of the page."""
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))
