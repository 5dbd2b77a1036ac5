"""Plots of arrays on axes of matplotlib, in the style of this package."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from lieint_jax import _checks

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
SpatialAxes: TypeAlias = Any  # matplotlib's Axes3D, some of whose declared types are wrong
_MARKED = 8  # markers on each curve of `series`
_COMPARABLE = 30  # works with peaks of such a ratio are drawn on a linear axis
_LAYOUTS = 4  # drawings after which a constrained layout has settled: each moves the panels less
_DOTS = 2000  # so many dots and more are the smallest and palest
_NEAR = 1e6  # a curve with errors below so many round-offs is drawn with the line of round-off


@contextmanager
def style() -> Iterator[None]:
    """Give the figures made in this context, or in a function decorated with it, the style `lieint.mplstyle`.

    Matplotlib's settings are restored on exit. Within the context, the path of ffmpeg remains the user's.
    """
    ffmpeg = {"animation.ffmpeg_path": matplotlib.rcParams["animation.ffmpeg_path"]}
    with matplotlib.style.context([_STYLE, ffmpeg], after_reset=True):
        yield


def figure(
    columns: int = 1, rows: int = 1, size: tuple[float, float] | None = None, **axes: Any
) -> tuple[Figure, np.ndarray]:
    """Make a figure and its array of axes, (rows, columns), without pyplot, so that no window system is needed.

    `size` is that of a panel in inches, by default that of the style; `axes` are options of `Figure.subplots`.
    """
    width, height = size or _LOOK["figure.figsize"]
    fig = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return fig, fig.subplots(rows, columns, squeeze=False, **axes)


def letter_panels(axes: np.ndarray, titles: Sequence[str]) -> None:
    """Title the panels of an array of axes in their order: (a), (b), …, each with its text of `titles`."""
    for ax, letter, title in zip(axes.flat, "abcdefghij", titles, strict=False):
        ax.set_title(f"({letter}) {title}", loc="left")


def save(fig: Figure, path: str | Path) -> list[Path]:
    """Write a figure as PNG at `path`, and as PDF next to it, and return the paths of both files."""
    path = Path(path)
    with style():
        for _ in range(_LAYOUTS):
            fig.draw_without_rendering()
        layout = fig.get_layout_engine()
        fig.set_layout_engine("none")  # or it would move the panels again, in each file by another amount
        fig.savefig(path)
        fig.savefig(files(path)[1], metadata={"CreationDate": None})  # the same bytes every time
        fig.set_layout_engine(layout)
    return files(path)


def files(path: Path) -> list[Path]:
    """The files that `save` writes for a PNG at `path`."""
    return [path, path.with_suffix(".pdf")]


def caption(fig: Figure, text: str) -> None:
    """Write a caption below a figure, wrapped to its width."""
    characters = int(15 * fig.get_figwidth())
    fig.supxlabel(textwrap.fill(text, characters), fontsize=matplotlib.rcParams["legend.fontsize"])


def legend_below(axes: np.ndarray) -> None:
    """Replace the legends of several panels by one below the figure, so that it covers no curve."""
    shown = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    for ax in axes.flat:
        if ax.get_legend():
            ax.get_legend().remove()
    axes.flat[0].figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=2)


def series(ax: Axes, t: ArrayLike, curves: Mapping[str, np.ndarray], ylabel: str, time_unit: str = "") -> Axes:
    """Plot at most eight curves against time, each in its own color, dashes and marker. Masked values are left out."""
    _check_number(curves)
    for k, ((label, y), look) in enumerate(zip(curves.items(), STYLES, strict=False)):
        shown = ~np.ma.getmaskarray(y)
        x = np.asarray(t)[shown]
        places = _marker_indices(ax, x, (k + 0.5) / len(curves)) if len(curves) > 1 and len(x) else []
        marks: dict[str, Any] = {} if len(curves) > 1 else {"marker": ""}
        ax.plot(x, np.asarray(y)[shown], label=label, markevery=places, **(look | marks))
    ax.set(xlabel=f"t ({time_unit})" if time_unit else "t", ylabel=ylabel)
    if len(curves) > 1:
        ax.legend()
    return ax


def _check_number(curves: Mapping[str, object]) -> None:
    if len(curves) > len(STYLES):
        raise ValueError(f"{len(curves)} curves cannot be distinguished on one panel: at most {len(STYLES)}")


def _marker_indices(ax: Axes, t: np.ndarray, shift: float) -> list[int]:
    """Indices of a curve's markers: evenly spaced along the axis, the first at the fraction `shift` of a spacing."""
    x = np.log10(abs(t)) if ax.get_xscale() == "log" else np.asarray(t, float)
    wanted = x[0] + (x[-1] - x[0]) * (np.arange(_MARKED) + shift) / _MARKED
    return np.unique(abs(x - wanted[:, None]).argmin(axis=1)).tolist()


def works(ax: Axes, t: ArrayLike, works: Mapping[str, np.ndarray], unit: str = "", time_unit: str = "") -> Axes:
    """Plot the cumulative work of each law of torque, by name; of more than eight, the least are added up in one curve.

    If the laws differ much, the axis is logarithmic, and linear about zero up to the peak of the least, or to 10⁻⁶ of
    the greatest.
    """
    peaks = {name: float(np.abs(work).max()) for name, work in works.items()}
    count = len(works) if len(works) <= len(STYLES) else len(STYLES) - 1
    greatest = sorted(peaks, key=lambda name: -peaks[name])[:count]
    shown = {name.replace("_", " "): work for name, work in works.items() if name in greatest}
    if rest := [work for name, work in works.items() if name not in greatest]:
        shown[f"{len(rest)} others"] = np.sum(rest, axis=0)
    series(ax, t, shown, f"work of each law ({unit})" if unit else "work of each law", time_unit)
    acting = [peak for peak in peaks.values() if peak > 0]
    if acting and max(acting) > _COMPARABLE * min(acting):
        linear = max(min(acting), 1e-6 * max(acting))
        ax.set_yscale("symlog", linthresh=10.0 ** np.floor(np.log10(linear)))
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return ax


def paths(ax: Axes, curves: Mapping[str, np.ndarray], plane: tuple[int, int] = (0, 1)) -> Axes:
    """Plot at most eight paths of points (n, 3), by label, in the plane of two coordinates; a marker ends each path."""
    _check_number(curves)
    i, j = plane
    for (label, x), look in zip(curves.items(), STYLES, strict=False):
        ax.plot(x[:, i], x[:, j], label=label, **look, markevery=[len(x) - 1])
    ax.set(xlabel="xyz"[i], ylabel="xyz"[j], aspect="equal")
    ax.locator_params(nbins=5)  # labels of five digits do not touch
    return ax


def log_error(
    ax: Axes,
    t: ArrayLike,
    curves: Mapping[str, np.ndarray],
    ylabel: str,
    time_unit: str = "",
    *,
    size: float = 1.0,
    of: str = "",
) -> Axes:
    """Plot absolute errors on a logarithmic axis, with a line at round-off if a curve comes near it.

    A logarithmic axis has no zero: exact zeros are left out, and a curve that is zero throughout appears only in the
    legend, as "exactly 0".

    `curves` are at most eight errors (n,) by label, of a quantity of the magnitude `size`, 1 for relative errors, whose
    symbol is `of`, such as "|H₀|".
    """
    epsilon = size * float(np.finfo(np.result_type(*curves.values(), np.float32)).eps)
    errors = {f"{label}: exactly 0" if not np.any(y) else label: abs(np.asarray(y)) for label, y in curves.items()}
    series(ax, t, {label: np.ma.masked_equal(y, 0) for label, y in errors.items()}, ylabel, time_unit)
    ax.set_yscale("log")
    if not any(np.any(y) for y in curves.values()):
        ax.set(
            xlim=np.asarray(t)[[0, -1]], ylim=(epsilon / 10, 10 * epsilon)
        )  # no curve is drawn that would set the limits
    if min(np.abs(y).max() for y in curves.values()) >= _NEAR * epsilon:
        return ax
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, epsilon / 10), max(high, 10 * epsilon))  # at least a decade on both sides of the line
    return round_off(ax, epsilon, of)


def round_off(ax: Axes, epsilon: float = float(np.finfo(float).eps), of: str = "") -> Axes:
    """Draw a line at the round-off `epsilon` of numbers of the size `of`; by default at that of 1 in float64."""
    ax.axhline(epsilon, color=GRAY, lw=1.2, zorder=1, label=f"round-off, ε{of} = {epsilon:.1e}".replace("e-", "e−"))
    ax.legend()
    return ax


def sphere_path(
    ax: SpatialAxes,
    path: np.ndarray,
    pole: np.ndarray | None = None,
    *,
    eye: np.ndarray | None = None,
    pole_label: str = "angular momentum",
    joined: bool = True,
) -> SpatialAxes:
    """Draw a path of unit vectors (n, 3) on the sphere, paler on the far side, and the axis `pole` that it circles.

    The vectors are joined by a curve; without `joined` they are dots. The axis is drawn as a pin in the sphere.

    The view is from the direction `eye`; by default from the mean of the path, rotated by 25° in both angles. Meridians
    and parallels are drawn every 30°, on the near side only.
    """
    x, y, z = path.mean(axis=0) if eye is None else eye
    aside = 25 if eye is None else 0
    ax.view_init(elev=np.rad2deg(np.arctan2(z, np.hypot(x, y))) + aside, azim=np.rad2deg(np.arctan2(y, x)) + aside)
    grid = _meridians_and_parallels()
    ax.plot(*np.where((grid @ _view_direction(ax) < 0)[:, None], np.nan, grid).T, color=GRAY, lw=0.4)
    ax.plot(*_outline(_view_direction(ax)).T, color=GRAY, lw=0.8)
    hidden = path @ _view_direction(ax) < 0
    for side, alpha in ((hidden, 0.25), (~hidden, 0.9)):
        look: dict[str, Any] = {"lw": 0.8} if joined else {"ls": "", "marker": "o", "ms": 1.5}
        ax.plot(*np.where(side[:, None], path, np.nan).T, color=BLUE, alpha=alpha, **look)
    if pole is not None:
        pin = np.outer([1.01, 1.25], pole)
        alpha = 1.0 if pin[0] @ _view_direction(ax) >= 0 else 0.4
        ax.plot(*pin.T, color=RED, lw=1.5, marker="o", ms=3.5, markevery=[0], alpha=alpha, label=pole_label)
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))  # equal ranges, or the sphere is drawn as an ellipsoid
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()
    return ax


def _meridians_and_parallels() -> np.ndarray:
    """Points (n, 3) of the meridians and parallels of the unit sphere every 30°; NaN ends each circle."""
    around, along = np.linspace(0, 2 * np.pi, 73), np.linspace(-np.pi / 2, np.pi / 2, 37)
    circles = [unit_vectors(np.full(37, longitude), along) for longitude in np.deg2rad(range(0, 360, 30))]
    circles += [unit_vectors(around, np.full(73, latitude)) for latitude in np.deg2rad(range(-60, 90, 30))]
    return np.concatenate([np.vstack([circle, [[np.nan] * 3]]) for circle in circles])


def _outline(direction: np.ndarray) -> np.ndarray:
    """The great circle (n, 3) that bounds the unit sphere as seen from a direction."""
    _, _, (_, a, b) = np.linalg.svd(direction[None])
    angle = np.linspace(0, 2 * np.pi, 145)[:, None]
    return np.cos(angle) * a + np.sin(angle) * b


def unit_vectors(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) with the longitudes and latitudes (n,), in radians."""
    c = np.cos(latitude)
    return np.stack([c * np.cos(longitude), c * np.sin(longitude), np.sin(latitude)], axis=-1)


def _look_of_dots(count: int, look: dict[str, Any]) -> dict[str, Any]:
    """The look of so many dots, 2 to 4 points across, unless their size `s` is given."""
    share = min(count / _DOTS, 1.0) ** 0.5
    return look if "s" in look else {"s": 16 - 12 * share, "alpha": 0.9 - 0.6 * share, "lw": 0} | look


def sky(ax: Axes, center: float = 0.0) -> Any:
    """Label axes in Mollweide's equal-area projection as a map of the sphere centered on a longitude (°)."""
    ticks = range(-120, 121, 60)
    ax.set_xticks(np.deg2rad(ticks), [f"{(tick + center) % 360:g}°" for tick in ticks])
    ax.set_yticks(np.deg2rad(range(-60, 61, 30)), [f"{y}°".replace("-", "−") for y in range(-60, 61, 30)])
    for label in ax.get_xticklabels():  # they are inside the map: on top of its curves, with a white outline
        label.set(color="#404040", path_effects=[withStroke(linewidth=2.5, foreground="white")])
    ax.xaxis.set_zorder(5)
    ax.grid(True)
    return ax


def sky_path(ax: Axes, path: np.ndarray, label: str, center: float = 0.0, **look: Any) -> Any:
    """Draw a path of unit vectors (n, 3) on the map of `sky`; at an edge it goes on at the other one."""
    longitude, latitude = _map_coordinates(path, center)
    last = np.flatnonzero(abs(np.diff(longitude)) > np.pi)  # before a crossing
    side = np.cos(latitude) * np.sin(longitude)  # 0 at the edge
    share = (side[last] / (side[last] - side[last + 1]))[:, None]
    crossing = (1 - share) * path[last] + share * path[last + 1]
    edge = np.arcsin(crossing[:, 2] / np.linalg.norm(crossing, axis=1))
    end, gap, places = np.sign(longitude[last]) * np.pi, np.full(len(last), np.nan), np.repeat(last + 1, 3)
    longitude = np.insert(longitude, places, np.stack([end, gap, -end], axis=1).ravel())
    latitude = np.insert(latitude, places, np.stack([edge, gap, edge], axis=1).ravel())
    ax.plot(longitude, latitude, label=label, **look)
    return ax


def sky_points(ax: Axes, points: np.ndarray, label: str, center: float = 0.0, **look: Any) -> Any:
    """Mark unit vectors (n, 3) on the map of `sky`, by default in a look that suits their number."""
    ax.scatter(*_map_coordinates(points, center), label=label, **_look_of_dots(len(points), look))
    return ax


def _map_coordinates(points: np.ndarray, center: float) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes relative to `center` (°), in (−π, π], and latitudes of unit vectors (n, 3), in radians."""
    longitude = np.arctan2(points[:, 1], points[:, 0]) - np.deg2rad(center)
    return np.angle(np.exp(1j * longitude)), np.arcsin(np.clip(points[:, 2], -1, 1))


def sphere_points(ax: SpatialAxes, points: np.ndarray, label: str, **look: Any) -> SpatialAxes:
    """Draw unit vectors (n, 3) as dots on the sphere of `sphere_path`; those on the far side are left out."""
    seen = points[points @ _view_direction(ax) >= 0]
    ax.scatter(*(1.01 * seen.T), label=label, depthshade=False, **_look_of_dots(len(points), look))
    return ax


def sphere_ends(ax: SpatialAxes, path: np.ndarray) -> SpatialAxes:
    """Mark the start and the end of a path of unit vectors (n, 3) on the sphere, paler on the far side."""
    for point, mark, label, color in ((path[0], "o", "start", GREEN), (path[-1], "s", "end", RED)):
        alpha = 1.0 if point @ _view_direction(ax) >= 0 else 0.4
        ax.plot(*(1.01 * point[:, None]), ls="", marker=mark, color=color, alpha=alpha, label=label)
    return ax


def sphere_axes(ax: SpatialAxes) -> SpatialAxes:
    """Label the axes of space on the near side of the sphere: x, y, z, or −x where that end is nearer."""
    for k, name in enumerate("xyz"):
        sign = 1 if _view_direction(ax)[k] >= 0 else -1
        ax.text(*(1.08 * sign * np.eye(3)[k]), name if sign > 0 else f"−{name}", color=INK, ha="center", va="center")
    return ax


def _view_direction(ax: SpatialAxes) -> np.ndarray:
    """The unit vector from the sphere toward the viewer."""
    a, e = np.deg2rad(ax.azim), np.deg2rad(ax.elev)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def delay_plot(ax: SpatialAxes, series: ArrayLike, lag: int, symbol: str = "x") -> SpatialAxes:
    """Plot the points (x_n, x_{n+N}, x_{n+2N}) of a series x as dots, relative to the middle of their range.

    Args:
        ax: axes in three dimensions.
        series: x at equal times, (times,).
        lag: N, in entries of the series.
        symbol: the name of x on the axes, in TeX.

    Raises:
        ValueError: the series has no more than 2N entries, or more than one axis.
    """
    lag, x = _checks.count("lag", lag, 1), np.asarray(series)
    if x.ndim != 1 or len(x) <= 2 * lag:
        raise ValueError(f"a delay plot of lag {lag} needs a series of more than {2 * lag} numbers, got {x.shape}")
    points = np.stack([x[k * lag : len(x) - (2 - k) * lag] for k in range(3)], axis=1)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    power = int(np.floor(np.log10(np.ptp(points) / 2 or 1.0)))
    power = power if abs(power) > 1 else 0
    x, y, z = ((points - middle) / 10.0**power).T
    ax.scatter(x, y, z, s=1.5, color=BLUE, alpha=0.7, depthshade=False, linewidths=0, rasterized=True)
    unit = rf"\,/\,10^{{{power}}}" if power else ""
    names = (rf"$\Delta {symbol}_{{{index}}}{unit}$" for index in ("n", "n+N", "n+2N"))
    ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), names, strict=True)))
    return cube(ax)


def cube(ax: SpatialAxes) -> SpatialAxes:
    """Give axes in three dimensions equal sides and few small ticks."""
    ax.set_box_aspect((1, 1, 1), zoom=0.85)  # room for the labels
    ax.tick_params(labelsize="small", pad=-2)
    ax.tick_params(axis="z", pad=1)  # or the axis crosses the minus signs
    ax.locator_params(nbins=4)
    return ax


def loglog_lines(
    ax: Axes,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    styles: Mapping[str, Mapping[str, Any]] | None = None,
) -> Axes:
    """Plot at most eight lines with markers on logarithmic axes, such as error against cost.

    `styles` overrides the look of lines by label.
    """
    _check_number(curves)
    for (label, (x, y)), look in zip(curves.items(), STYLES, strict=False):
        ax.loglog(x, y, **(look | {"label": label} | dict((styles or {}).get(label, {}))))
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.legend()
    return ax
