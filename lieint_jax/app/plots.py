"""Plots of arrays, all in one look. Functions that take axes draw on them and return them.

A function that makes a figure is decorated with `style()`, and `save` writes it as PNG and PDF:

    @plots.style()
    def draw(t, error):
        fig, axes = plots.figure()
        plots.log_error(axes[0, 0], t, {"midpoint": error}, "relative energy error", "s")
        return fig

    plots.save(draw(t, error), Path("error.png"))
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_STYLE = Path(__file__).with_name("lieint.mplstyle")
_LOOK = matplotlib.rc_params_from_file(_STYLE, use_default_template=False)
COLORS: tuple[str, ...] = tuple(_LOOK["axes.prop_cycle"].by_key()["color"])
INK, RED, BLUE, GREEN, PURPLE, ORANGE, SKY, WINE = COLORS
GRAY: str = _LOOK["grid.color"]
MARKS = "os^Dv<>P"
_DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", "-", (0, (6, 3)), (0, (1, 2)), (0, (8, 2, 2, 2)))
STYLES: tuple[dict[str, Any], ...] = tuple(
    {"color": color, "ls": dashes, "marker": mark} for color, dashes, mark in zip(COLORS, _DASHES, MARKS, strict=True)
)
_MARKED = 8  # marks on each curve of `series`
_NEAR = 1e6  # errors below so many round-offs are shown beside the line of one


@contextmanager
def style() -> Iterator[None]:
    """Within it, or in a function decorated with it, figures have the look of this package: `lieint.mplstyle`.

    Matplotlib's settings are what they were afterwards. Where ffmpeg is stays the user's setting.
    """
    ffmpeg = {"animation.ffmpeg_path": matplotlib.rcParams["animation.ffmpeg_path"]}
    with matplotlib.style.context([_STYLE, ffmpeg], after_reset=True):
        yield


def figure(columns: int = 1, rows: int = 1, size: tuple[float, float] | None = None, **axes: Any) -> tuple[Figure, Any]:
    """A figure and its array of axes, made without pyplot, so that no window system is needed.

    Args:
        columns: of panels.
        rows: of panels.
        size: of a panel, in inches; by default that of the style.
        axes: as `Figure.subplots` takes them.
    """
    width, height = size or _LOOK["figure.figsize"]
    fig = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return fig, fig.subplots(rows, columns, squeeze=False, **axes)


def letter_panels(axes: Any, titles: Sequence[str]) -> None:
    """Titles (a), (b), … of the panels of a figure, in the order of an array of axes."""
    for ax, letter, title in zip(axes.flat, "abcdefghij", titles, strict=False):
        ax.set_title(f"({letter}) {title}", loc="left")


def save(fig: Figure, path: Path) -> list[Path]:
    """Write a figure as PNG and as PDF; the paths of both files.

    Args:
        fig: the figure.
        path: of the PNG; the PDF stands beside it.
    """
    with style():
        fig.savefig(path)
        fig.savefig(files(path)[1], metadata={"CreationDate": None})  # the same bytes every time
    return files(path)


def files(path: Path) -> list[Path]:
    """The files that `save` writes for a PNG at `path`."""
    return [path, path.with_suffix(".pdf")]


def caption(fig: Figure, text: str) -> None:
    """A caption below a figure, in lines of its width."""
    characters = int(15 * fig.get_figwidth())
    fig.supxlabel(textwrap.fill(text, characters), fontsize=matplotlib.rcParams["legend.fontsize"])


def series(ax: Axes, t: np.ndarray, curves: Mapping[str, np.ndarray], ylabel: str, time_unit: str = "") -> Axes:
    """At most eight curves against time; each has a color, dashes and a mark of its own. Masked values are left out."""
    _few(curves)
    for k, ((label, y), look) in enumerate(zip(curves.items(), STYLES, strict=False)):
        shown = ~np.ma.getmaskarray(y)
        x = np.asarray(t)[shown]
        places = _places(ax, x, (k + 0.5) / len(curves)) if len(curves) > 1 and len(x) else []
        ax.plot(x, np.asarray(y)[shown], label=label, markevery=places, **look)
    ax.set(xlabel=f"t ({time_unit})" if time_unit else "t", ylabel=ylabel)
    if len(curves) > 1:
        ax.legend()
    return ax


def _few(curves: Mapping[str, Any]) -> None:
    if len(curves) > len(STYLES):
        raise ValueError(f"{len(curves)} curves cannot be told apart on one panel: at most {len(STYLES)}")


def _places(ax: Axes, t: np.ndarray, shift: float) -> list[int]:
    """The indices of the marks of a curve: evenly spaced on the axis, `shift` of a space from its beginning."""
    x = np.log10(abs(t)) if ax.get_xscale() == "log" else np.asarray(t, float)
    wanted = x[0] + (x[-1] - x[0]) * (np.arange(_MARKED) + shift) / _MARKED
    return np.unique(abs(x - wanted[:, None]).argmin(axis=1)).tolist()


def paths(ax: Axes, curves: Mapping[str, np.ndarray], plane: tuple[int, int] = (0, 1)) -> Axes:
    """At most eight paths of points (n, 3) by label, on the plane of two of their axes; a mark at the end of each."""
    _few(curves)
    i, j = plane
    for (label, x), look in zip(curves.items(), STYLES, strict=False):
        ax.plot(x[:, i], x[:, j], label=label, **look, markevery=[len(x) - 1])
    ax.set(xlabel="xyz"[i], ylabel="xyz"[j], aspect="equal")
    return ax


def log_error(
    ax: Axes,
    t: np.ndarray,
    curves: Mapping[str, np.ndarray],
    ylabel: str,
    time_unit: str = "",
    size: float = 1.0,
    of: str = "",
) -> Axes:
    """Absolute errors on a logarithmic axis, and the line of round-off if a curve stays near it.

    Such an axis has no zero: exact zeros are left out, and a curve of nothing but zeros is in the legend only, as
    "exactly 0".

    Args:
        ax: the axes.
        t: times (n,).
        curves: errors (n,) by label, at most eight.
        ylabel: what the errors are of.
        time_unit: of t.
        size: of the numbers whose errors these are; 1 for relative errors.
        of: the symbol of `size`, such as "|H₀|".
    """
    epsilon = size * float(np.finfo(np.result_type(*curves.values(), np.float32)).eps)
    errors = {f"{label}: exactly 0" if not np.any(y) else label: abs(np.asarray(y)) for label, y in curves.items()}
    series(ax, t, {label: np.ma.masked_equal(y, 0) for label, y in errors.items()}, ylabel, time_unit)
    ax.set_yscale("log")
    if not any(np.any(y) for y in curves.values()):
        ax.set(xlim=(t[0], t[-1]), ylim=(epsilon / 10, 10 * epsilon))  # no curve sets them
    if min(np.abs(y).max() for y in curves.values()) >= _NEAR * epsilon:
        return ax
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, epsilon / 10), max(high, 10 * epsilon))  # a decade at least, or it is all round-off
    return round_off(ax, epsilon, of)


def round_off(ax: Axes, epsilon: float = float(np.finfo(float).eps), of: str = "") -> Axes:
    """A line at the round-off of numbers of the size `of`: `epsilon`, that of 1 in float64 by default."""
    ax.axhline(epsilon, color=GRAY, lw=1.2, zorder=1, label=f"round-off, ε{of} = {epsilon:.1e}".replace("e-", "e−"))
    ax.legend()
    return ax


def sphere_path(
    ax: Any,
    path: np.ndarray,
    pole: np.ndarray | None = None,
    eye: np.ndarray | None = None,
    pole_label: str = "angular momentum",
    joined: bool = True,
) -> Any:
    """A path of unit vectors (n, 3) on the sphere, paler on the far side, and the axis `pole` about which it rotates.

    The vectors are joined by a curve, or drawn as dots. The axis is a pin in the sphere.

    The view is from the direction `eye`; by default from the mean of the path, turned by 25° in both angles. Meridians
    and parallels, 30° apart, are drawn on the near side only.
    """
    x, y, z = path.mean(axis=0) if eye is None else eye
    aside = 25 if eye is None else 0
    ax.view_init(elev=np.rad2deg(np.arctan2(z, np.hypot(x, y))) + aside, azim=np.rad2deg(np.arctan2(y, x)) + aside)
    grid = _meridians_and_parallels()
    ax.plot(*np.where((grid @ _sight(ax) < 0)[:, None], np.nan, grid).T, color=GRAY, lw=0.4)
    ax.plot(*_outline(_sight(ax)).T, color=GRAY, lw=0.8)
    hidden = path @ _sight(ax) < 0
    for side, alpha in ((hidden, 0.25), (~hidden, 0.9)):
        look: dict[str, Any] = {"lw": 0.8} if joined else {"ls": "", "marker": "o", "ms": 1.5}
        ax.plot(*np.where(side[:, None], path, np.nan).T, color=BLUE, alpha=alpha, **look)
    if pole is not None:
        pin = np.outer([1.01, 1.25], pole)
        alpha = 1.0 if pin[0] @ _sight(ax) >= 0 else 0.4
        ax.plot(*pin.T, color=RED, lw=1.5, marker="o", ms=3.5, markevery=[0], alpha=alpha, label=pole_label)
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))  # equal ranges, or the sphere is drawn as an ellipsoid
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()
    return ax


def _meridians_and_parallels() -> np.ndarray:
    """Points (n, 3) of the circles on the unit sphere that are 30° apart; NaN ends each circle."""
    around, along = np.linspace(0, 2 * np.pi, 73), np.linspace(-np.pi / 2, np.pi / 2, 37)
    circles = [on_sphere(np.full(37, longitude), along) for longitude in np.deg2rad(range(0, 360, 30))]
    circles += [on_sphere(around, np.full(73, latitude)) for latitude in np.deg2rad(range(-60, 90, 30))]
    return np.concatenate([np.vstack([circle, [[np.nan] * 3]]) for circle in circles])


def _outline(sight: np.ndarray) -> np.ndarray:
    """The great circle (n, 3) that is seen as the edge of the unit sphere from the direction `sight`."""
    _, _, (_, a, b) = np.linalg.svd(sight[None])
    angle = np.linspace(0, 2 * np.pi, 145)[:, None]
    return np.cos(angle) * a + np.sin(angle) * b


def on_sphere(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) of angles (n,) in radians."""
    return np.stack(
        [np.cos(longitude) * np.cos(latitude), np.sin(longitude) * np.cos(latitude), np.sin(latitude)], axis=-1
    )


def sky(ax: Any, center: float = 0.0) -> Any:
    """Label axes with Mollweide's projection, which is equal-area, as a map of the sphere about a longitude (°)."""
    ticks = range(-120, 121, 60)
    ax.set_xticks(np.deg2rad(ticks), [f"{(tick + center) % 360:g}°" for tick in ticks])
    ax.set_yticks(np.deg2rad(range(-60, 61, 30)), [f"{y}°".replace("-", "−") for y in range(-60, 61, 30)])
    ax.tick_params(axis="x", labelcolor="#606060")
    ax.grid(True)
    return ax


def sky_path(ax: Any, path: np.ndarray, label: str, center: float = 0.0, **look: Any) -> Any:
    """A path of unit vectors (n, 3) on the map of `sky`, broken where it leaves the map on one side."""
    longitude, latitude = _on_map(path, center)
    leaves = np.flatnonzero(abs(np.diff(longitude)) > np.pi) + 1
    ax.plot(np.insert(longitude, leaves, np.nan), np.insert(latitude, leaves, np.nan), label=label, **look)
    return ax


def sky_points(ax: Any, points: np.ndarray, label: str, center: float = 0.0, **look: Any) -> Any:
    """Unit vectors (n, 3) as marks on the map of `sky`."""
    ax.scatter(*_on_map(points, center), label=label, **look)
    return ax


def _on_map(points: np.ndarray, center: float) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes from `center` (°), in (−π, π], and latitudes, in radians."""
    longitude = np.arctan2(points[:, 1], points[:, 0]) - np.deg2rad(center)
    return np.angle(np.exp(1j * longitude)), np.arcsin(np.clip(points[:, 2], -1, 1))


def sphere_points(ax: Any, points: np.ndarray, label: str, **style: Any) -> Any:
    """Unit vectors (n, 3) as dots on the sphere of `sphere_path`; those on the far side are left out."""
    seen = points[points @ _sight(ax) >= 0]
    ax.scatter(*(1.01 * seen.T), label=label, depthshade=False, **style)
    return ax


def sphere_ends(ax: Any, path: np.ndarray) -> Any:
    """Marks at the start and the end of a path of unit vectors (n, 3) on the sphere, paler on the far side."""
    for point, mark, label, color in ((path[0], "o", "start", GREEN), (path[-1], "s", "end", RED)):
        alpha = 1.0 if point @ _sight(ax) >= 0 else 0.4
        ax.plot(*(1.01 * point[:, None]), ls="", marker=mark, color=color, alpha=alpha, label=label)
    return ax


def sphere_axes(ax: Any) -> Any:
    """The names x, y, z of the axes of space at their ends on the near side of the sphere, −x for the end of −x."""
    for k, name in enumerate("xyz"):
        sign = 1 if _sight(ax)[k] >= 0 else -1
        ax.text(*(1.08 * sign * np.eye(3)[k]), name if sign > 0 else f"−{name}", color=INK, ha="center", va="center")
    return ax


def _sight(ax: Any) -> np.ndarray:
    """The unit vector from the sphere toward the viewer."""
    a, e = np.deg2rad(ax.azim), np.deg2rad(ax.elev)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def delay_plot(ax: Any, points: np.ndarray, symbol: str = "x") -> Any:
    """The points (x_n, x_{n+N}, x_{n+2N}) of a series, shape (n, 3), less the middle of their range, as small dots.

    Args:
        ax: axes in three dimensions.
        points: as `diagnostics.delay` returns them.
        symbol: of x, in TeX.
    """
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    power = int(np.floor(np.log10(np.ptp(points) or 1.0)))
    power = power if abs(power) > 1 else 0
    x, y, z = ((points - middle) / 10.0**power).T
    ax.scatter(x, y, z, s=1.5, color=BLUE, alpha=0.7, depthshade=False, linewidths=0, rasterized=True)
    unit = rf"\,/\,10^{{{power}}}" if power else ""
    names = (rf"$\Delta {symbol}_{{{index}}}{unit}$" for index in ("n", "n+N", "n+2N"))
    ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), names, strict=True)))
    return cube(ax)


def cube(ax: Any) -> Any:
    """Equal sides and few small ticks on axes in three dimensions."""
    ax.set_box_aspect((1, 1, 1), zoom=0.85)  # room for the labels
    ax.tick_params(labelsize="xx-small", pad=-2)
    ax.locator_params(nbins=4)
    return ax


def loglog_lines(
    ax: Axes,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    styles: Mapping[str, Mapping[str, Any]] | None = None,
) -> Axes:
    """At most eight lines with marks on logarithmic axes, such as error against cost; `styles`, by label, override."""
    _few(curves)
    for (label, (x, y)), look in zip(curves.items(), STYLES, strict=False):
        ax.loglog(x, y, **(look | {"label": label} | dict((styles or {}).get(label, {}))))
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.legend()
    return ax
