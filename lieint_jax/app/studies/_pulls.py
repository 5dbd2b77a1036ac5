"""Pulls, (estimate − truth)/reported standard error, over synthetic data sets: a test of reported uncertainties."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from lieint_jax.app import plots

ELLIPSOID = 15.507  # the 95 % point of χ² with 8 degrees of freedom


class Shares(NamedTuple):
    """The scatter of pulls.

    Attributes:
        within_1, within_2: the percentages within one and two standard errors; 68.3 and 95.4 are expected.
        rms: the root mean square; 1 is expected.
    """

    within_1: np.ndarray
    within_2: np.ndarray
    rms: np.ndarray


def shares(pulls: np.ndarray, axis: int | None = 0) -> Shares:
    """The shares of pulls (sets, parameters), for each parameter, or with `axis=None` for all together."""
    size = np.abs(pulls)
    one, two = (100 * (size <= limit).mean(axis=axis) for limit in (1, 2))
    return Shares(one, two, np.sqrt((pulls**2).mean(axis=axis)))


def chance_errors(sets: int) -> Shares:
    """The standard errors of the shares of one parameter, for a number of synthetic sets."""
    one, two = (100 * np.sqrt(p * (1 - p) / sets) for p in (0.683, 0.954))
    return Shares(one, two, 1 / np.sqrt(2 * sets))


def squared_distances(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """The squared Mahalanobis distances eᵀC⁻¹e, (n,), of errors (n, parameters) with covariances (n, …, …)."""
    errors = np.asarray(errors)
    return np.einsum("ti,ti->t", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def draw_pulls(ax: Axes, pulls: np.ndarray, own: np.ndarray | None = None) -> None:
    """Plot the distribution of pulls (sets, parameters) and the normal one, and mark the pulls `own` of a solution."""
    sets, parameters = pulls.shape
    edges = np.linspace(-4, 4, 33).tolist()
    clipped = np.clip(pulls.ravel(), -3.99, 3.99)
    ax.hist(clipped, edges, density=True, color=plots.BLUE, alpha=0.6, label=f"{parameters} parameters")
    x = np.linspace(-4, 4, 201)
    ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=plots.INK, lw=1.2, label="normal")
    if own is not None:
        ax.plot(own, np.full(len(own), 0.02), "|", color=plots.RED, ms=14, mew=1.5, label="the best solution")
    found = shares(pulls, None)
    note = f"within 1σ {found.within_1:.0f} % (68)\nwithin 2σ {found.within_2:.0f} % (95)"
    ax.text(0.03, 0.97, note, transform=ax.transAxes, va="top", fontsize="x-small")
    ax.set(xlabel=f"(estimate − truth)/σ, {sets} synthetic sets", ylabel="density", ylim=(0, 0.6))
    ax.legend(frameon=False, fontsize="x-small", loc="upper right")
