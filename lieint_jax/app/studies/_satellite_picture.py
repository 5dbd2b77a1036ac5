"""The picture of the study of a satellite: six panels."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.studies._period_search import HARMONICS, find_combination
from lieint_jax.app.studies._report import draw_pulls
from lieint_jax.app.studies._satellite_fit import SatelliteFit

_COLORS = {"as it is": plots.INK, "mirror": plots.RED, "exchange": plots.GREEN, "mirror and exchange": plots.ORANGE}
_TITLES = (
    "light before the shadow",
    "spectrum of all the light",
    "pairs of frequencies",
    "ends of the starts, first session",
    "whole night, from each image of the best end",
    "estimate less truth",
)
_SMALL = {"frameon": False, "fontsize": "x-small", "loc": "upper left"}


@plots.style()
def draw(found: SatelliteFit) -> Figure:
    """Plot the light and its minima, both searches for periods, the ends of all starts, the images, and the errors."""
    fig, axes = plots.figure(3, 2)
    panels = (_draw_light, _draw_spectrum, _draw_pairs, _draw_first_session, _draw_night)
    for ax, draw_panel in zip(axes.flat, panels, strict=False):
        draw_panel(ax, found)
    e = found.estimate
    draw_pulls(axes[1, 2], e.errors, (e.value - e.truth) / e.sigma)
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(f"{found.title}, simulated", fontsize="medium")
    return fig


def _draw_light(ax: Axes, found: SatelliteFit) -> None:
    e, c = found.estimate, found.curve
    fine, seen = e.fine_t <= found.session, c.t <= found.session
    ax.plot(e.fine_t[fine], e.fine_light[fine], color=plots.BLUE, lw=0.8, label="fit")
    ax.plot(c.t[seen], c.magnitude[seen], ".", color=plots.INK, ms=3, label="exposures")
    for t in found.minima.t:
        ax.axvline(t, color=plots.GRAY, lw=0.6, zorder=0, label="true minima" if t == found.minima.t[0] else None)
    ax.set(xlabel="t (min)", ylabel="magnitude, zero point unknown")
    ax.set_ylim(e.fine_light.max() + 0.1, e.fine_light.min() - 0.5)
    ax.legend(ncols=3, **_SMALL)


def _draw_spectrum(ax: Axes, found: SatelliteFit) -> None:
    f, power, true = found.search.frequencies, found.search.power, 1 / found.periods
    ax.plot(f, 100 * power, color=plots.BLUE, lw=0.8)
    for value, name in zip(true, "fg", strict=True):
        ax.axvline(value, color=plots.RED, lw=0.8, ls="--")
        ax.annotate(f"{name} ", (value, 0.94), xycoords=("data", "axes fraction"), ha="right", fontsize="small")
    for peak in (p.frequency for p in found.search.peaks[:7]):
        top = (peak, 100 * power[np.abs(f - peak) < 1.5 * (f[1] - f[0])].max())
        near_line = np.abs(peak - true).min() < 0.03 * np.ptp(f)  # there the label is drawn to the right of the line
        place = {"xytext": (3, 2), "ha": "left"} if near_line else {"xytext": (0, 2), "ha": "center"}
        ax.annotate(_name(found, peak), top, textcoords="offset points", va="bottom", fontsize="xx-small", **place)
    ax.set(xlabel="frequency (1/min)", ylabel="variance explained (%)", ylim=(0, 115 * power.max()))
    note = "f, g: true precession, rotation\n(j, k): the simplest jf + kg"
    ax.text(0.97, 0.95, note, transform=ax.transAxes, ha="right", va="top", fontsize="x-small")


def _draw_pairs(ax: Axes, found: SatelliteFit) -> None:
    pairs, left = found.search.pairs.pairs, 100 * found.search.pairs.left
    y = np.arange(len(pairs))[::-1]
    ax.barh(y, left, color=plots.BLUE, height=0.6)
    for height, pair, value in zip(y, pairs, left, strict=True):
        names = " and ".join(_name(found, f) for f in pair)
        ax.text(value + 0.3, height, names, va="center", fontsize="x-small")
    ax.set(xlabel="variance left by a double series of order 2 (%)", xlim=(0, 1.5 * left.max()))
    ax.set_yticks(y, [f"{p[0]:.4f}, {p[1]:.4f}" for p in pairs], fontsize="x-small")
    ax.set_ylabel("frequencies (1/min)")


def _name(found: SatelliteFit, frequency: float) -> str:
    """The combination (j, k) of the true frequencies that a frequency is."""
    j, k, _ = find_combination(frequency, 1 / found.periods, HARMONICS, 1 / found.curve.t[-1])
    return f"({j}, {k})".replace("-", "−")


def _split_names(found: SatelliteFit) -> list[tuple[str, str]]:
    """Of each change the change in space, and the new names of the axes."""
    parts = (change.name.partition(", axes ") for change in found.changes)
    return [(space, axes or "xyz") for space, _, axes in parts]


def _draw_first_session(ax: Axes, found: SatelliteFit) -> None:
    order, names = np.argsort(found.first.loss), _split_names(found)
    chi = 2 * found.first.loss[order] / (found.curve.t <= found.session).sum()
    change, rank = found.first.change[order], np.arange(1, len(order) + 1)
    ax.loglog(rank, chi, ".", color=plots.GRAY, ms=3, label=f"elsewhere ({(change < 0).sum()})")
    for space, color in _COLORS.items():
        for own, mark in ((True, "o"), (False, "x")):
            which = np.array([k >= 0 and (names[k][0], names[k][1] == "xyz") == (space, own) for k in change])
            if which.any():
                label = f"{space}{'' if own else ', axes exchanged'} ({which.sum()})"
                ax.loglog(rank[which], chi[which], mark, color=color, ms=4, label=label)
    ax.set(xlabel="start, by its χ²", ylabel="χ² per exposure")
    ax.legend(**_SMALL)


def _draw_night(ax: Axes, found: SatelliteFit) -> None:
    excess, names = 2 * (found.images.loss - found.night.loss.min()), _split_names(found)
    columns = sorted({axes for _, axes in names})
    for begin, value, end in zip(found.named, excess, found.images.change, strict=True):
        if begin < 0:  # the best end of the first session is no image of that of the night
            continue
        space, axes = names[begin]
        fill = _COLORS[space] if end >= 0 and names[end] == (space, axes) else "none"
        x = columns.index(axes) + 0.15 * (list(_COLORS).index(space) - 1.5)
        ax.plot(x, max(value, 0.5), "o", color=_COLORS[space], mfc=fill, ms=5)
    for space, color in _COLORS.items():
        ax.plot([], [], "o", color=color, ms=5, label=space)
    ax.plot([], [], "o", color=plots.GRAY, mfc="none", ms=5, label="ended elsewhere")
    ax.set(yscale="log", ylim=(0.3, 3e7), ylabel="χ² above the best (0 drawn at 0.5)")
    ax.set_xlabel("principal axes, by their new names")
    ax.set_xticks(range(len(columns)), columns)
    ax.legend(ncols=2, **_SMALL)
