"""The picture of the study of Toutatis: six panels."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from lieint_jax.app import plots
from lieint_jax.app.studies._pulls import draw_pulls
from lieint_jax.app.studies._radar import FITTED, MIDDLE, later_fixes, radar_epochs
from lieint_jax.app.studies._toutatis_report import HUDSON_OSTRO
from lieint_jax.app.studies._toutatis_result import SpinFit

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
    for kind, (ax, unit) in enumerate(zip(axes[0, :2], ("attitude error (°)", "body rate error (°/d)"), strict=True)):
        _draw_residuals(ax, found, kind, unit)
    _draw_prediction(axes[0, 2], found)
    _draw_pair(axes[1, 0], found, (0, 1), "precession of the long axis (d)", "rotation about the long axis (d)")
    axes[1, 0].plot(*HUDSON_OSTRO, "D", color=plots.GRAY, mec=plots.INK, ms=6, label="Hudson & Ostro 1995")
    _draw_pair(axes[1, 1], found, (2, 3), "ecliptic longitude (°)", "ecliptic latitude (°)")
    for ax in axes[1, :2]:
        ax.legend(loc="best")
    draw_pulls(axes[1, 2], found.coverage.pulls[:, :8])
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(found.scenario.title)
    return fig


def _draw_residuals(ax: Axes, found: SpinFit, kind: int, label: str) -> None:
    """Plot the size of each residual by date, with outliers ringed, and the fitted noise level."""
    day = radar_epochs().t[:FITTED] - _DECEMBER
    for name, (mark, color) in _MARKS.items():
        size = np.linalg.norm(found.residuals[name][kind], axis=-1)
        fill = color if name == "fitted" else "none"
        ax.plot(day, size, mark, color=color, ms=5, mfc=fill, label=name)
    size = np.linalg.norm(found.residuals["fitted"][kind], axis=-1)
    outlier = found.outlier[kind]
    ax.plot(day[outlier], size[outlier], "o", ms=13, mfc="none", mec=plots.INK, mew=1.0, label="outlier of the fit")
    level = np.sqrt(3) * float(found.estimate.noise[kind])
    ax.axhline(level, color=plots.INK, lw=0.8, ls="--", label="√3 × fitted noise")
    top = max(np.linalg.norm(e[kind], axis=-1).max() for e in found.residuals.values())
    ax.set(xlabel="December 1992 (UTC)", ylabel=label, ylim=(0, 1.55 * top), xticks=range(3, 19, 3))
    ax.legend(ncols=2, loc="upper center")


def _draw_prediction(ax: Axes, found: SpinFit) -> None:
    """Plot the spread of the members against time, and the angles of predictions from the later fixes."""
    p = found.prediction
    label = "members about the estimate, 5–95 %"
    ax.fill_between(p.t, p.spread[0], p.spread[2], color=plots.GRAY, alpha=0.5, lw=0, label=label)
    ax.plot(p.t, p.rms, color=plots.INK, lw=1.2, label="the same, rms")
    fixes = later_fixes()
    later = fixes.t - radar_epochs().t[MIDDLE]
    for name, (mark, color) in _MARKS.items():
        fill = color if name == "fitted" else "none"
        ax.plot(
            later,
            p.fix_angles[name],
            mark,
            color=color,
            ms=5,
            mfc=fill,
            label="predictions from the fix, marks as in (a)" if name == "fitted" else None,
        )
    for t, date, height in zip(later, fixes.date, (190, 204, 218), strict=True):
        ax.annotate(date[:4], (t, height), ha="center", va="bottom", fontsize="x-small")
        ax.plot([t, t], [0, height], color=plots.GRAY, lw=0.6, zorder=0)
    ax.set(xscale="log", xlim=(5, 14000), ylim=(0, 270), yticks=range(0, 181, 30))
    ax.set(xlabel="days after 1992-12-10", ylabel="angle (°)")
    ax.legend(loc="upper left")


def _draw_pair(ax: Axes, found: SpinFit, which: tuple[int, int], xlabel: str, ylabel: str) -> None:
    """Plot two derived quantities with their 1σ and 2σ ellipses, and the published states and values."""
    which_axes = list(which)
    center = np.asarray(found.estimate.derived)[which_axes]
    matrix = np.asarray(found.estimate.derived_covariance)[np.ix_(which_axes, which_axes)]
    values, vectors = np.linalg.eigh(matrix)
    angle = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
    for scale, style in ((1, "-"), (2, "--")):
        width, height = 2 * scale * np.sqrt(values[::-1])
        ax.add_patch(Ellipse(tuple(center), width, height, angle=angle, fill=False, ls=style, ec=plots.INK, lw=1))
    ax.plot(*center, "o", color=plots.INK, ms=5, label="fitted, ellipses of 1σ, 2σ")
    for name, values_of in found.published.items():
        mark, color = _MARKS[name]
        ax.plot(*values_of[which_axes], mark, color=color, mfc="none", ms=6, label=f"state of {name}")
    published = [list(found.scenario.published.values())[k] for k in which]
    x, y = published
    ax.errorbar(x.value, y.value, y.error, x.error, "x", color=plots.RED, ms=5, lw=1, label="Zhao et al., as published")
    reach = 2.4 * np.sqrt(np.diagonal(matrix))
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.locator_params(nbins=6)
    ax.set(xlim=(center[0] - reach[0], center[0] + reach[0]), ylim=(center[1] - reach[1], center[1] + 2 * reach[1]))
