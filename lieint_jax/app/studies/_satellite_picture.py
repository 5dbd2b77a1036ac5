"""The picture of the study of a satellite: six panels."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.studies._period_search import HARMONICS, find_combination
from lieint_jax.app.studies._pulls import draw_pulls
from lieint_jax.app.studies._satellite_result import SatelliteFit

_COLORS = {"as it is": plots.INK, "mirror": plots.RED, "exchange": plots.GREEN, "mirror and exchange": plots.ORANGE}
_TITLES = (
    "light before the shadow",
    "spectrum of all the light",
    "pairs of frequencies",
    "ends of the starts, first session",
    "whole night, from each image of the best end",
    "estimate less truth",
)


@plots.style()
def draw(found: SatelliteFit) -> Figure:
    """Plot the light and its minima, both searches for periods, the ends of all starts, the images, and the errors."""
    fig, axes = plots.figure(3, 2)
    panels = (_draw_light, _draw_spectrum, _draw_pairs, _draw_first_session, _draw_night, _draw_errors)
    for ax, draw_panel in zip(axes.flat, panels, strict=True):
        draw_panel(ax, found)
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(f"{found.title}, simulated", fontsize="medium")
    return fig


def _draw_light(ax: Axes, found: SatelliteFit) -> None:
    session = found.session
    fine, seen = found.estimate.fine_t <= session, found.curve.t <= session
    ax.plot(found.estimate.fine_t[fine], found.estimate.fine_light[fine], color=plots.BLUE, lw=0.8, label="fit")
    ax.plot(found.curve.t[seen], found.curve.magnitude[seen], ".", color=plots.INK, ms=3, label="exposures")
    for t in found.minima.t:
        ax.axvline(t, color=plots.GRAY, lw=0.6, zorder=0, label="true minima" if t == found.minima.t[0] else None)
    ax.set(xlabel="t (min)", ylabel="magnitude, zero point unknown")
    top, bottom = found.estimate.fine_light.min(), found.estimate.fine_light.max()
    ax.set_ylim(bottom + 0.1, top - 0.5)
    ax.legend(frameon=False, fontsize="x-small", ncols=3, loc="upper left")


def _draw_spectrum(ax: Axes, found: SatelliteFit) -> None:
    f, power = found.search.frequencies, found.search.power
    ax.plot(f, 100 * power, color=plots.BLUE, lw=0.8)
    true = 1 / found.periods
    for value, name in zip(true, "fg", strict=True):
        ax.axvline(value, color=plots.RED, lw=0.8, ls="--")
        ax.annotate(f"{name} ", (value, 0.94), xycoords=("data", "axes fraction"), ha="right", fontsize="small")
    for peak in (p.frequency for p in found.search.peaks[:7]):
        j, k, _off = find_combination(peak, true, HARMONICS, 1 / found.curve.t[-1])
        step = f[1] - f[0]
        top = (peak, 100 * power[np.abs(f - peak) < 1.5 * step].max())
        near_line = np.abs(peak - true).min() < 0.03 * np.ptp(f)  # there the label is drawn to the right of the line
        x, side = (3, "left") if near_line else (0, "center")
        ax.annotate(
            _pair_name(j, k), top, (x, 2), textcoords="offset points", ha=side, va="bottom", fontsize="xx-small"
        )
    ax.set(xlabel="frequency (1/min)", ylabel="variance explained (%)", ylim=(0, 115 * power.max()))
    note = "f, g: true precession, rotation\n(j, k): the simplest jf + kg"
    ax.text(0.97, 0.95, note, transform=ax.transAxes, ha="right", va="top", fontsize="x-small")


def _draw_pairs(ax: Axes, found: SatelliteFit) -> None:
    pairs, left = found.search.pairs.pairs, 100 * found.search.pairs.left
    true = 1 / found.periods
    y = np.arange(len(pairs))[::-1]
    ax.barh(y, left, color=plots.BLUE, height=0.6)
    for height, pair, value in zip(y, pairs, left, strict=True):
        names = " and ".join(_pair_name(*find_combination(f, true, HARMONICS, 1 / found.curve.t[-1])[:2]) for f in pair)
        ax.text(value + 0.3, height, names, va="center", fontsize="x-small")
    ax.set(xlabel="variance left by a double series of order 2 (%)", xlim=(0, 1.5 * left.max()))
    ax.set_yticks(y, [f"{p[0]:.4f}, {p[1]:.4f}" for p in pairs], fontsize="x-small")
    ax.set_ylabel("frequencies (1/min)")


def _pair_name(j: int, k: int) -> str:
    return f"({j}, {k})".replace("-", "−")


def _split_name(name: str) -> tuple[str, str]:
    """The two parts of a change's name: the change in space, and the new names of the axes."""
    space, _, axes = name.partition(", axes ")
    return space, axes or "xyz"


def _draw_first_session(ax: Axes, found: SatelliteFit) -> None:
    order = np.argsort(found.first.loss)
    chi = 2 * found.first.loss[order] / (found.curve.t <= found.session).sum()
    change, rank = found.first.change[order], np.arange(1, len(order) + 1)
    ax.loglog(rank, chi, ".", color=plots.GRAY, ms=3, label=f"elsewhere ({(change < 0).sum()})")
    kinds = [_split_name(found.changes[k].name) if k >= 0 else None for k in change]
    for space, color in _COLORS.items():
        for own, mark in ((True, "o"), (False, "x")):
            which = np.array([kind is not None and kind[0] == space and (kind[1] == "xyz") == own for kind in kinds])
            if which.any():
                label = f"{space}{'' if own else ', axes exchanged'} ({which.sum()})"
                ax.loglog(rank[which], chi[which], mark, color=color, ms=4, label=label)
    ax.set(xlabel="start, by its χ²", ylabel="χ² per exposure")
    ax.legend(frameon=False, fontsize="x-small", loc="upper left")


def _draw_night(ax: Axes, found: SatelliteFit) -> None:
    excess = 2 * (found.images.loss - found.night.loss.min())
    columns = sorted({_split_name(change.name)[1] for change in found.changes})
    for begin, value, end in zip(found.named, excess, found.images.change, strict=True):
        if begin < 0:  # the best end of the first session is no image of that of the night
            continue
        space, axes = _split_name(found.changes[begin].name)
        own = end >= 0 and _split_name(found.changes[end].name) == (space, axes)
        x = columns.index(axes) + 0.15 * (list(_COLORS).index(space) - 1.5)
        fill = _COLORS[space] if own else "none"
        ax.plot(x, max(value, 0.5), "o", color=_COLORS[space], mfc=fill, ms=5)
    for space, color in _COLORS.items():
        ax.plot([], [], "o", color=color, ms=5, label=space)
    ax.plot([], [], "o", color=plots.GRAY, mfc="none", ms=5, label="ended elsewhere")
    ax.set(
        yscale="log",
        xlabel="principal axes, by their new names",
        ylabel="χ² above the best (0 drawn at 0.5)",
        ylim=(0.3, 3e7),
    )
    ax.set_xticks(range(len(columns)), columns)
    ax.legend(frameon=False, fontsize="x-small", ncols=2, loc="upper left")


def _draw_errors(ax: Axes, found: SatelliteFit) -> None:
    e = found.estimate
    draw_pulls(ax, e.errors, (e.value - e.truth) / e.sigma)
