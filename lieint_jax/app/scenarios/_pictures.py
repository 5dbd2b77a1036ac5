"""Panels of pictures that scenarios have in common."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lieint_jax import plots
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._report import Conserved
from lieint_jax.plots import balance as draw_balance
from lieint_jax.plots import chain as draw_chain
from lieint_jax.plots import histogram as draw_histogram
from lieint_jax.plots import member_series as draw_members
from lieint_jax.plots import on_sphere as draw_on_sphere
from lieint_jax.plots import space_paths as draw_paths
from lieint_jax.runs import Run
from lieint_jax.types import Step

__all__ = [
    "draw_balance",
    "draw_chain",
    "draw_changes",
    "draw_errors",
    "draw_histogram",
    "draw_members",
    "draw_on_sphere",
    "draw_paths",
]


def draw_errors(
    ax: Any,
    scenario: Kind,
    one: Run,
    steps: Iterable[Step],
    names: Mapping[str, str],
    label: str,
    size: float = 1.0,
    unit: str | None = None,
) -> None:
    """Plot the changes of conserved quantities of one body by several steps.

    Args:
        ax: the axes.
        scenario: declares what is conserved.
        one: the run of one body.
        steps: the steps to compare.
        names: the symbols of quantities to show by their names; "" shows that of the step alone.
        label: of the axis of errors.
        size, unit: the unit of the axis of times, in time_unit, and its name; by default time_unit itself.
    """
    t, found = scenario.changes(one, steps)
    curves = {
        ", ".join(filter(None, (symbol, scheme))): errors[name]
        for scheme, errors in found.items()
        for name, symbol in names.items()
    }
    plots.log_error(ax, t / size, curves, label, scenario.time_unit if unit is None else unit)


def draw_changes(ax: Any, t: np.ndarray, conserved: Sequence[Conserved], unit: str) -> None:
    """Plot the largest relative change over the members of each conserved quantity along a run."""
    errors = {x.name.partition(",")[0]: x.change().max(axis=1) for x in conserved}
    plots.log_error(ax, t, errors, "relative change, worst member", unit)
