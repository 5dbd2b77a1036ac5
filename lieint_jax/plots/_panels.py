"""Panels that several pictures have in common: curves of members, histograms, balances, chains, paths on spheres."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np

from lieint_jax.plots import _axes as plots

_SHAPES = 13  # of a chain in a picture
_PARTS = [plots.BLUE, plots.RED, plots.GREEN, plots.WINE]  # colors
_BINS = 50  # largest number of a histogram
_FEW = 20  # members whose lines are drawn as clearly as those of others


def member_series(ax: Any, t: np.ndarray, x: np.ndarray, label: str, unit: str) -> None:
    """Plot a series (times, members): the nominal member in black, the first hundred others as thin lines."""
    thin: Any = {"lw": 0.4, "alpha": 0.4} if x.shape[1] > _FEW else {"lw": 0.8, "alpha": 0.7}
    others = ax.plot(t, x[:, 1:100], color=plots.BLUE, rasterized=True, **thin)
    [nominal] = ax.plot(t, x[:, 0], color=plots.INK, lw=1.0)
    ax.set(xlabel=f"t ({unit})", ylabel=label)
    if others:
        ax.legend([nominal, others[0]], ["nominal member", "other members"])


def space_paths(ax: Any, paths: Mapping[str, np.ndarray]) -> None:
    """Plot at most five paths of points (n, 3) by label: in space on a panel of three axes, else over x and y."""
    if ax.name != "3d":
        plots.paths(ax, paths).legend()
        return
    for (name, x), color in zip(paths.items(), (plots.INK, *_PARTS), strict=False):
        ax.plot(*np.asarray(x).T, color=color, lw=0.8, label=name)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=2)
    plots.cube(ax).set(xlabel="x", ylabel="y", zlabel="z")


def histogram(
    ax: Any,
    parts: Mapping[str, np.ndarray],
    label: str,
    marks: Mapping[str, float] | None = None,
    *,
    shown: float = 1.0,
) -> None:
    """Plot how a number of each member is distributed; members without a value (NaN) are counted in the label.

    Args:
        ax: the axes.
        parts: values of members (m,), stacked, by at most four labels; "" for all members.
        label: of the number, with its unit.
        marks: values to mark by their labels, such as the nominal or a published one.
        shown: the share of the members that is shown, from the lowest value on, without the tail.
    """
    every = np.concatenate(list(parts.values()))
    values = every[np.isfinite(every)]
    if len(values):
        low_part = values[values <= np.quantile(values, shown)]
        bins = np.histogram_bin_edges(low_part, min(_BINS, 5 + int(np.sqrt(len(values)))))
        finite = [x[np.isfinite(x)] for x in parts.values()]
        ax.hist(finite, bins, stacked=True, color=_PARTS[: len(parts)], label=list(parts))
    for (name, x), style in zip((marks or {}).items(), ("--", ":", "-."), strict=False):
        ax.axvline(x, color=plots.INK, ls=style, lw=1.0, label=name)
    none = len(every) - len(values)
    ax.set(xlabel=f"{label}; {none} of {len(every)} have none" if none else label, ylabel="members")
    ax.yaxis.get_major_locator().set_params(integer=True)
    if marks or any(parts):
        ax.legend()


def balance(
    axes: np.ndarray,
    t: np.ndarray,
    energy: np.ndarray,
    works: np.ndarray,
    names: Sequence[str],
    *,
    unit: str = "",
    time_unit: str = "",
) -> None:
    """Plot the work of each law on the first member, and the relative change of energy less all work, in two panels.

    The energy is (times, members), the works are (times, members, laws), all in `unit`.
    """
    left, right = axes
    left.plot(t, energy[:, 0] - energy[0, 0], color=plots.GRAY, lw=3.5, label="change of energy")
    plots.works(left, t, {name: works[:, 0, k] for k, name in enumerate(names)}, unit, time_unit)
    left.set_title("first member")
    largest = abs(energy).max(axis=0)
    less_work = energy - works.sum(axis=-1)
    change = abs(less_work - less_work[0]) / np.where(largest > 0, largest, 1)
    curves = {"worst member": change.max(axis=1), "median": np.median(change, axis=1)}
    curves = curves if change.shape[1] > 1 else {"": change[:, 0]}
    plots.log_error(right, t, curves, "H − ΣW, relative change", time_unit)
    right.set_title("energy less the work of all laws")


def chain(axes: np.ndarray, t: np.ndarray, x: np.ndarray, name: str) -> None:
    """Plot the line of centers (times, bodies, 3) of a chain at several times, in two planes of the space axes."""
    shown = np.unique(np.linspace(0, len(t) - 1, _SHAPES).astype(int))
    x, t = x[shown], t[shown]
    extent = np.ptp(x, axis=(0, 1))
    along, *across = np.argsort(-extent)
    half = 0.55 * max(extent[across].max(), extent[along] / 8)
    for k, axis in zip(across, axes, strict=True):
        for line, color in zip(x, matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(t))), strict=True):
            axis.plot(line[:, along], line[:, k], color=color, marker=".", ms=3, lw=1.2)
        middle = (x[..., k].min() + x[..., k].max()) / 2
        axis.set(ylabel="xyz"[k], ylim=(middle - half, middle + half), aspect="equal")
    axes[0].set_title(f"{name} at equal intervals, from t = {t[0]:.4g} (dark) to {t[-1]:.4g}")
    axes[1].set_xlabel("xyz"[along])


def on_sphere(
    axes: Sequence[Any] | np.ndarray,
    t: np.ndarray,
    path: np.ndarray,
    end: float,
    ends: np.ndarray,
    pole: np.ndarray,
    *,
    unit: str,
    pole_label: str = "γ",
    angle_label: str = "angle from γ (°)",
    eye: np.ndarray | None = None,
    bounds: Iterable[float] | np.ndarray = (),
) -> None:
    """Plot a path of unit vectors on the sphere, the members' vectors at time `end`, and its angle from the pole."""
    left, right = axes
    plots.sphere_path(left, path, pole, eye=pole + 0.8 * path[0] if eye is None else eye, pole_label=pole_label)
    if len(ends) > 1:
        when = f"{end:.4g} {unit}".rstrip()
        plots.sphere_points(left, ends, f"{len(ends)} members at t = {when}", color=plots.INK)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, 0.03), ncols=2)
    plots.series(right, t, {"": np.rad2deg(np.arccos(np.clip(path @ pole, -1, 1)))}, angle_label, unit)
    for bound in bounds:
        right.axhline(bound, color=plots.RED, lw=0.7, ls="--", zorder=3)
