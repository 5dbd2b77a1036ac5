"""The picture of the study of Toutatis: six panels."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.studies._report import draw_pulls, ellipse
from lieint_jax.app.studies._toutatis import FITTED, HUDSON_OSTRO, MIDDLE, SpinFit, later_fixes, radar_epochs

_MARKS = {"fitted": ("o", plots.INK), "Zhao et al. 2015": ("^", plots.RED), "Takahashi et al. 2013": ("s", plots.BLUE)}
_DECEMBER = 20.2571  # days from the published epoch, 1992-11-09 17:49:47, to 1992-11-30 00:00
_TITLES = (
    "17 radar fixes of 1992: attitudes",
    "the same: body rates",
    "torque-free to the fixes of 2004, 2008 and 2012",
    "mean periods",
    "direction of the angular momentum",
    "reported errors in synthetic data",
)


@plots.style()
def draw(found: SpinFit) -> Figure:
    """Plot the residuals, the prediction, momentum and periods with published values, and the test of the errors."""
    fig, axes = plots.figure(3, 2)
    for kind, (ax, label) in enumerate(zip(axes[0, :2], ("attitude error (°)", "body rate error (°/d)"), strict=True)):
        _draw_residuals(ax, found, kind, label)
    _draw_prediction(axes[0, 2], found)
    _draw_pair(axes[1, 0], found, 0, "precession of the long axis (d)", "rotation about the long axis (d)")
    axes[1, 0].plot(*HUDSON_OSTRO, "D", color=plots.GRAY, mec=plots.INK, ms=6, label="Hudson & Ostro 1995")
    _draw_pair(axes[1, 1], found, 2, "ecliptic longitude (°)", "ecliptic latitude (°)")
    for ax in axes[1, :2]:
        ax.legend(loc="best")
    draw_pulls(axes[1, 2], found.coverage.pulls[:, :8])
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(found.scenario.title)
    return fig


def _look(name: str) -> tuple[str, Any]:
    """The marker of a state, and its look."""
    mark, color = _MARKS[name]
    return mark, {"color": color, "mfc": color if name == "fitted" else "none", "ms": 5}


def _draw_residuals(ax: Axes, found: SpinFit, kind: int, label: str) -> None:
    """Plot the size of each residual by date, with outliers ringed, and the fitted noise level."""
    day, outlier = radar_epochs().t[:FITTED] - _DECEMBER, found.outlier[kind]
    sizes = {name: np.linalg.norm(found.residuals[name][kind], axis=-1) for name in _MARKS}
    for name, size in sizes.items():
        mark, look = _look(name)
        ax.plot(day, size, mark, label=name, **look)
    ringed = day[outlier], sizes["fitted"][outlier]
    ax.plot(*ringed, "o", ms=13, mfc="none", mec=plots.INK, mew=1.0, label="outlier of the fit")
    level = np.sqrt(3) * float(found.estimate.noise[kind])
    ax.axhline(level, color=plots.INK, lw=0.8, ls="--", label="√3 × fitted noise")
    top = max(size.max() for size in sizes.values())
    ax.set(xlabel="December 1992 (UTC)", ylabel=label, ylim=(0, 1.55 * top), xticks=range(3, 19, 3))
    ax.legend(ncols=2, loc="upper center")


def _draw_prediction(ax: Axes, found: SpinFit) -> None:
    """Plot the spread of the members against time, and the angles of predictions from the later fixes."""
    p, (dates, t, _) = found.prediction, later_fixes()
    label = "members about the estimate, 5–95 %"
    ax.fill_between(p.t, p.spread[0], p.spread[2], color=plots.GRAY, alpha=0.5, lw=0, label=label)
    ax.plot(p.t, p.rms, color=plots.INK, lw=1.2, label="the same, rms")
    later = t - radar_epochs().t[MIDDLE]
    for name, label in zip(_MARKS, ("predictions from the fix, marks as in (a)", None, None), strict=True):
        mark, look = _look(name)
        ax.plot(later, p.fix_angles[name], mark, label=label, **look)
    for day, date, height in zip(later, dates, (190, 204, 218), strict=True):
        ax.annotate(date[:4], (day, height), ha="center", va="bottom", fontsize="x-small")
        ax.plot([day, day], [0, height], color=plots.GRAY, lw=0.6, zorder=0)
    ax.set(xscale="log", xlim=(5, 14000), ylim=(0, 270), yticks=range(0, 181, 30))
    ax.set(xlabel="days after 1992-12-10", ylabel="angle (°)")
    ax.legend(loc="upper left")


def _draw_pair(ax: Axes, found: SpinFit, first: int, xlabel: str, ylabel: str) -> None:
    """Plot two derived quantities with their 1σ and 2σ ellipses, and the published states and values."""
    pair = slice(first, first + 2)
    center, matrix = found.estimate.derived[pair], found.estimate.derived_covariance[pair, pair]
    for radius, dashes in ((1, "-"), (2, "--")):
        ax.plot(*ellipse(center, matrix, radius).T, dashes, color=plots.INK, lw=1)
    ax.plot(*center, "o", color=plots.INK, ms=5, label="fitted, ellipses of 1σ, 2σ")
    for name, values in found.published.items():
        mark, look = _look(name)
        ax.plot(*values[pair], mark, label=f"state of {name}", **{**look, "ms": 6})
    x, y = list(found.scenario.published.values())[pair]
    ax.errorbar(x.value, y.value, y.error, x.error, "x", color=plots.RED, ms=5, lw=1, label="Zhao et al., as published")
    (x, y), (dx, dy) = center, 2.4 * np.sqrt(np.diagonal(matrix))
    ax.locator_params(nbins=6)
    ax.set(xlabel=xlabel, ylabel=ylabel, xlim=(x - dx, x + dx), ylim=(y - dy, y + 2 * dy))
