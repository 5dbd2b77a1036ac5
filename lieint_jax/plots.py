"""Plots of arrays. Every function draws on the axes that it is given and returns them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, BLUE, RED, GREY = "#222222", "#2a6f97", "#c8553d", "#b8b8b8"
STYLES: tuple[dict[str, Any], ...] = (
    {"color": INK, "lw": 1.0},
    {"color": RED, "lw": 1.0, "ls": "--"},
    {"color": BLUE, "lw": 1.8, "ls": ":"},
    {"color": "#5a8f3c", "lw": 1.0, "ls": "-."},
    {"color": "#8a5aa8", "lw": 1.4},
    {"color": "#c79a1e", "lw": 1.2, "ls": (0, (6, 3))},
)


def figure(columns: int = 1, rows: int = 1, **axes: Any) -> tuple[Figure, Any]:
    """A figure and its array of axes, made without pyplot, so that no window system is needed."""
    fig = Figure(figsize=(4.6 * columns, 3.6 * rows), layout="constrained")
    return fig, fig.subplots(rows, columns, squeeze=False, **axes)


def series(ax: Axes, t: np.ndarray, curves: Mapping[str, np.ndarray], ylabel: str, time_unit: str = "") -> Axes:
    """Curves against time, in the paper's line styles: solid, dashed, dotted, and three more."""
    for (label, y), style in zip(curves.items(), itertools.cycle(STYLES), strict=False):
        ax.plot(t, y, label=label, **style)
    ax.set(xlabel=f"t ({time_unit})" if time_unit else "t", ylabel=ylabel)
    if len(curves) > 1:
        ax.legend(frameon=False, fontsize="small")
    return ax


def log_error(ax: Axes, t: np.ndarray, curves: Mapping[str, np.ndarray], ylabel: str, time_unit: str = "") -> Axes:
    """Absolute errors on a logarithmic axis; exact zeros are drawn at a tenth of round-off."""
    tiny = np.finfo(float).eps / 10
    series(ax, t, {label: np.maximum(np.abs(y), tiny) for label, y in curves.items()}, ylabel, time_unit)
    ax.set_yscale("log")
    return ax


def sphere_path(
    ax: Any,
    path: np.ndarray,
    pole: np.ndarray | None = None,
    eye: np.ndarray | None = None,
    pole_label: str = "angular momentum",
) -> Any:
    """A path of unit vectors (n, 3) on the sphere, paler on the far side, and the axis `pole` about which it turns.

    The view is from the direction `eye`; by default from the mean of the path, turned by 25° in both angles.
    """
    u, v = np.mgrid[0 : 2 * np.pi : 37j, 0 : np.pi : 19j]
    ax.plot_wireframe(np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v), color=GREY, lw=0.3, alpha=0.6)
    x, y, z = path.mean(axis=0) if eye is None else eye
    aside = 25 if eye is None else 0
    ax.view_init(elev=np.rad2deg(np.arctan2(z, np.hypot(x, y))) + aside, azim=np.rad2deg(np.arctan2(y, x)) + aside)
    hidden = path @ _sight(ax) < 0
    for side, alpha in ((hidden, 0.25), (~hidden, 0.9)):
        ax.plot(*np.where(side[:, None], path, np.nan).T, color=BLUE, lw=0.7, alpha=alpha)
    if pole is not None:
        end = 1.3 * np.asarray(pole)
        ax.plot(*np.stack([0 * end, end]).T, color=RED, lw=1.5, label=pole_label)
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))  # equal ranges, or the sphere is drawn as an ellipsoid
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_axis_off()
    return ax


def sphere_points(ax: Any, points: np.ndarray, label: str, **style: Any) -> Any:
    """Unit vectors (n, 3) as dots on the sphere of `sphere_path`; those on the far side are left out."""
    seen = points[points @ _sight(ax) >= 0]
    ax.scatter(*(1.01 * seen.T), label=label, depthshade=False, **style)
    return ax


def _sight(ax: Any) -> np.ndarray:
    """The unit vector from the sphere towards the viewer."""
    a, e = np.deg2rad(ax.azim), np.deg2rad(ax.elev)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def delay_plot(ax: Any, points: np.ndarray) -> Any:
    """The points (x_n, x_{n+N}, x_{n+2N}) of a series, shape (n, 3), less the middle of their range, as small dots."""
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    ax.scatter(*(points - middle).T, s=1.5, color=BLUE, alpha=0.7, depthshade=False, linewidths=0)
    ax.set_box_aspect((1, 1, 1))
    ax.tick_params(labelsize="xx-small", pad=-2)
    ax.ticklabel_format(style="sci", scilimits=(-2, 2), useMathText=True)
    return ax


def loglog_lines(
    ax: Axes,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    styles: Mapping[str, Mapping[str, Any]] | None = None,
) -> Axes:
    """Lines with markers on two logarithmic axes, such as error against cost; `styles`, by label, override some."""
    for (label, (x, y)), marker in zip(curves.items(), itertools.cycle("os^Dv<>Pp*hX"), strict=False):
        ax.loglog(
            x, y, **({"marker": marker, "ms": 4, "lw": 1.0, "label": label} | dict((styles or {}).get(label, {})))
        )
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.grid(True, which="major", lw=0.3, color=GREY)
    ax.legend(frameon=False, fontsize="small")
    return ax
