"""The tables and pictures of studies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes

from lieint_jax.app import plots
from lieint_jax.fitting.inference import shares


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
