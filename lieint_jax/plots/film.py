"""Animations of rotating bodies, as GIF, MP4 or HTML for use offline."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lieint_jax.plots import _axes as plots
from lieint_jax.plots import solids
from lieint_jax.plots.scene import Scene, Span, scene_of
from lieint_jax.runs import Run

SUFFIXES = (".gif", ".mp4", ".html")
MOST_FRAMES = 5000  # 5 GB of memory for a GIF, and minutes
SECONDS, LONGEST = 6.0, 30.0  # durations without `seconds`; the longer one where a span with an end needs it
_DPI = 100
_INCHES = 4.8
_EDGES = 60  # faces of a body, up to which their edges are drawn


def check_format(out: Path) -> None:
    """Raise ValueError if `out` has no format of an animation, or the program that writes it is not installed."""
    from matplotlib.animation import FFMpegWriter

    if out.suffix not in SUFFIXES:
        raise ValueError(f"an animation is written as {', '.join(SUFFIXES)}, got {out}")
    if out.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ValueError("MP4 needs ffmpeg, which is not installed: install it (apt install ffmpeg, …), or write .gif")
    if out.suffix == ".html":
        _graph_objects()


def make_scene(
    run: Run,
    title: str,
    seconds: float | None = None,
    fps: int = 20,
    span: Span = (None, None),
    shapes: Sequence[solids.BodyShape] = (),
) -> Scene:
    """The scene of an animation of a run of one body, or of one system of bodies: see `animate`."""
    if seconds is not None and not 0 < seconds < float("inf"):
        raise ValueError(f"the duration in seconds must be positive, got {seconds:g}")
    frames = max(2, round((seconds or SECONDS) * fps))
    if frames > MOST_FRAMES:
        raise ValueError(
            f"{seconds or SECONDS:g} seconds of {fps} frames are {frames:.7g} frames, the most are {MOST_FRAMES}: "
            "give fewer seconds or frames per second"
        )
    scene = scene_of(run, title, frames, span, shapes)
    if seconds is None and span[1] is not None and scene.needed > len(scene.t):
        scene = scene_of(run, title, min(scene.needed, round(LONGEST * fps), MOST_FRAMES), span, shapes)
    return scene


def write(scene: Scene, out: Path, fps: int = 20) -> None:
    """Write the animation of a scene, in the format of the ending of `out`."""
    (_write_html if out.suffix == ".html" else _write_film)(scene, out, fps)


def animate(
    run: Run,
    out: str | Path,
    shape: str | Path | Sequence[str | Path] = (),
    *,
    member: int = 0,
    title: str = "",
    seconds: float | None = None,
    fps: int = 20,
    span: Span = (None, None),
) -> Path:
    """Draw the rotating bodies of one member of a run, with the paths of their axes and their momentum vectors.

    Args:
        run: of rigid bodies, tops, gyrostats or satellites.
        out: NAME.gif, NAME.mp4 (with ffmpeg) or NAME.html (with plotly), which is replaced where it exists.
        shape: files with the shapes of the bodies, in the axes of their inertia, as `li.shapes.surface` reads them; by
            default bodies are drawn as boxes or ellipsoids of their inertia.
        member: the index of the member.
        title: the title.
        seconds: the duration; it is shorter if the run has fewer states to show. By default 6, or with the end of a
            span as many as show it smoothly, up to 30.
        fps: frames per second.
        span: the times to show, from the first to the second, all of it. Without the second, as much as is smooth.

    Returns:
        The path of the animation.

    Raises:
        ValueError: `out` cannot be written, the run has no rigid bodies, or a program is not installed.
    """
    out = Path(out)
    check_format(out)
    given = [shape] if isinstance(shape, str | Path) else shape
    one = run if run.members is None else run.member(member)
    scene = make_scene(one, title, seconds, fps, span, [solids.read(Path(file)) for file in given])
    write(scene, out, fps)
    return out


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
