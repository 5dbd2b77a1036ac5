"""The report and the picture of an inference, and what those of studies share."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax import plots
from lieint_jax.fitting.inference import Estimate, Inference, Published, chi_square_point, pull, shares

__all__ = ["draw", "published_lines", "text"]

_EDGE = 6.0  # standard errors at the edge of the panel of estimates


def table(rows: Iterable[Sequence[object]], indent: str = "  ") -> list[str]:
    """The lines of a table: the first column to the left, the others to the right, each as wide as its widest cell."""
    rows = [[str(cell) for cell in row] for row in rows]
    width = [max(len(row[k]) for row in rows if k < len(row)) for k in range(max(map(len, rows)))]
    cells = (zip(row[1:], width[1:], strict=False) for row in rows)
    right = ("".join(f"  {cell:>{w}}" for cell, w in cells_of_row) for cells_of_row in cells)
    return [f"{indent}{row[0]:<{width[0]}}{rest}".rstrip() for row, rest in zip(rows, right, strict=True)]


def coverage_cells(pulls: np.ndarray) -> list[tuple[str, str, str]]:
    """The cells of a table with the shares within 1σ and 2σ and the rms/σ, for each column of pulls."""
    return [(f"{one:.0f}%", f"{two:.0f}%", f"{rms:.2f}") for one, two, rms in zip(*shares(pulls), strict=True)]


def draw_pulls(ax: Axes, pulls: np.ndarray, own: np.ndarray | None = None) -> None:
    """Plot the distribution of pulls (sets, parameters) and the normal one, and mark the pulls `own` of a solution."""
    sets, parameters = pulls.shape
    clipped = np.clip(pulls.ravel(), -3.99, 3.99)
    edges = np.linspace(-4, 4, 33).tolist()
    ax.hist(clipped, edges, density=True, color=plots.BLUE, alpha=0.6, label=f"{parameters} parameters")
    x = np.linspace(-4, 4, 201)
    ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=plots.INK, lw=1.2, label="normal")
    if own is not None:
        ax.plot(own, np.full(len(own), 0.02), "|", color=plots.RED, ms=14, mew=1.5, label="the best solution")
    one, two, _ = shares(pulls, None)
    note = f"within 1σ {one:.0f} % (68)\nwithin 2σ {two:.0f} % (95)"
    ax.text(0.03, 0.97, note, transform=ax.transAxes, va="top", fontsize="x-small")
    ax.set(xlabel=f"(estimate − truth)/σ, {sets} synthetic sets", ylabel="density", ylim=(0, 0.6))
    ax.legend(frameon=False, fontsize="x-small", loc="upper right")


def published_lines(names: Sequence[str], estimate: Estimate, published: Iterable[Published]) -> list[str]:
    """The lines with published values, their differences from ours in units of the combined error, and their sources.

    The names are those of parameters and derived quantities, or of the derived quantities only.
    """
    lines, width = [], max(map(len, names))
    values, sigmas = (x[-len(names) :] for x in (estimate.values, estimate.sigmas))
    for quantity, value, error, source in published:
        k = list(names).index(quantity)
        given = f"{value:g}" + (f" ± {error:g}" if error else "")
        difference = pull(quantity, values[k], sigmas[k], value, error)
        lines.append(f"    {quantity:<{width}}  {given:<16}{difference:>+5.1f} σ   {source}")
    return lines


def text(found: Inference) -> str:
    """The report on a problem, as text."""
    e, c, f, (scatter, of_noise, chi) = found.estimate, found.coverage, found.fit, found.factors
    assert f.starts is not None
    lines = [
        found.title,
        f"  {f.outcome}; {100 * found.share_at_minimum:.0f} % of {len(f.starts.loss)} starts end there",
        f"  noise, fitted (scales of Student's t): {', '.join(f'{x:.4g}' for x in e.noise)}"
        if e.noise.size
        else f"  χ² {f.chi_square:.1f} for {f.degrees_of_freedom} degrees of freedom",
        *textwrap.wrap(f.message, 116, initial_indent="  ! ", subsequent_indent="    "),
        "",
    ]
    values = [(name, *_digits(x, s)) for name, x, s in zip(found.names, e.values, e.sigmas, strict=True)]
    if c is None or found.tested is None:
        return "\n".join([*lines, *table([("", "fitted", "± 1σ"), *values])])
    rows = [("", "fitted", "± 1σ", "within 1σ", "2σ", "rms/σ")]
    rows += [(*value, *cells) for value, cells in zip(values, coverage_cells(found.tested), strict=True)]
    also = f" (noise levels: {of_noise:.3f})" if e.noise.size else ""
    also += f", and by {chi:.3f}, since χ² is above its degrees of freedom" if chi > 1 else ""
    inside, sets = 100 * (c.mahalanobis_squared <= chi_square_point(len(e.x))).mean(), len(c.pulls)
    published = published_lines(found.names, e, found.published)
    lines += [
        *table([*rows, ("expected of each", "", "", "68%", "95%", "1.00")]),
        f"  errors: enlarged by {scatter:.3f}, the ratio of scatter to error in {sets} synthetic sets{also}",
        f"  right: a test by {sets} other sets; the truth is inside the joint 95 % ellipsoid in {inside:.0f} %",
    ]
    return "\n".join([*lines, *(["\n  published values:", *published] if published else [])])


def _digits(value: float, sigma: float) -> tuple[str, str]:
    """A value and its standard error, with two digits of the error."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.6g}", "—"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{places}f}", f"{sigma:.{places}f}"


@plots.style()
def draw(found: Inference) -> Figure:
    """Plot the data and the fit, the errors, the estimate with its tested errors, and the forecast."""
    t, v = found.labels
    panels = [(found.data, found.calculated, v, "data, and the fitted model")] if found.data is not None else []
    panels += [(found.errors, None, "(calculated − observed)/noise", "errors")]
    fig, axes = plots.figure(len(panels) + 1 + (found.forecast is not None))
    for ax, (dots, lines, label, title) in zip(axes[0], panels, strict=False):
        for k in range(dots.shape[1]):
            color = plots.COLORS[k % len(plots.COLORS)]
            ax.plot(found.t, dots[:, k], ".", ms=3, alpha=0.35 if lines is not None else 1.0, color=color)
            if lines is not None:
                ax.plot(found.t, lines[:, k], color=color, lw=1.2)
        ax.set(xlabel=t, ylabel=label, title=title)
    _draw_estimate(axes[0, len(panels)], found)
    if found.forecast is not None:
        ax, (times, value, low, high) = axes[0, -1], found.forecast
        ax.fill_between(times, low, high, color=plots.GRAY, alpha=0.5, lw=0, label="members, 5–95 %")
        ax.plot(times, value, color=plots.INK, lw=1.2, label="the estimate")
        ax.set(xlabel=t, title="prediction")
        ax.legend()
    fig.suptitle(found.title)
    return fig


def _draw_estimate(ax: Axes, found: Inference) -> None:
    """A row for each number, in units of its standard error: estimates from synthetic data, and published values."""
    e, y = found.estimate, np.arange(len(found.names))[::-1]
    if found.tested is not None:
        ax.plot(found.tested.T, y, ".", ms=3, color=plots.BLUE, alpha=0.4)
    for width, alpha in ((2, 0.25), (1, 0.4)):
        ax.axvspan(-width, width, color=plots.GRAY, alpha=alpha, lw=0, zorder=0)
    for quantity, value, error, _ in found.published:
        k = found.names.index(quantity)
        x, size = pull(quantity, e.values[k], e.sigmas[k], value), error / e.sigmas[k]
        mark = "D" if abs(x) < _EDGE else ">" if x > 0 else "<"
        ax.errorbar(np.clip(x, -_EDGE, _EDGE), y[k], xerr=size, fmt=mark, ms=4, color=plots.RED)
    each = ((name, *_digits(x, s)) for name, x, s in zip(found.names, e.values, e.sigmas, strict=True))
    ax.set_yticks(y, [f"{name}\n{x.replace('-', '−')} ± {s}" for name, x, s in each], fontsize="x-small")
    label = "(from synthetic data, or published − fitted)/σ"
    ax.set(xlabel=label, xlim=(-_EDGE, _EDGE), title="the estimate, and tests of its errors")
