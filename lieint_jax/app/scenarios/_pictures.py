"""Pictures of runs: a decorator that makes the figure, and what several kinds of scenario draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.scenarios._report import Conserved
from lieint_jax.app.scenarios._runs import LONGEST, as_ensemble, drawn_trajectory
from lieint_jax.types import State, Step, Trajectory


def picture(
    columns: int = 1, rows: int = 1, *, size: Any = None, spatial: Sequence[int] = (), **options: Any
) -> Callable[[Callable[..., None]], Callable[[Any, Any, Trajectory], Figure]]:
    """Make the figure for a function that draws a run on axes, with the title of the scenario.

    The function is called with an array of axes (panels,), scenario, step and run.

    Args:
        columns, rows: the numbers of columns and rows of panels.
        size: the size of a panel in inches, or a function of the scenario that returns it.
        spatial: the indices of panels with three axes.
        options: further arguments of `plots.figure`.
    """

    def decorate(draw: Callable[..., None]) -> Callable[[Any, Any, Trajectory], Figure]:
        @plots.style()
        @wraps(draw)
        def figure_of_run(scenario: Any, step: Step, run: Trajectory) -> Figure:
            inches: Any = size(scenario) if callable(size) else size
            fig, axes = plots.figure(columns, rows, inches, **options)
            axes = axes.ravel()
            for k in spatial:
                axes[k].remove()
                axes[k] = fig.add_subplot(rows, columns, k + 1, projection="3d")
            fig.suptitle(scenario.title)
            draw(axes, scenario, step, run)
            return fig

        return figure_of_run

    return decorate


def changes_by_scheme(
    conserved: Callable[[Any, Any, Trajectory], list[Conserved]],
    scenario: Any,
    steps: Iterable[Step],
    start: State,
    longest: int = LONGEST,
) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
    """Times, and the relative changes of conserved quantities by the names of steps and quantities, from one state."""
    found, t = {}, np.zeros(0)
    for step in steps:
        run = as_ensemble(drawn_trajectory(step, start, scenario.dt, scenario.steps, longest))
        t = np.asarray(run.t)
        found[step.name] = {x.name: x.change()[:, 0] for x in conserved(scenario, step.system, run)}
    return t, found


def draw_changes(ax: Any, t: np.ndarray, conserved: Sequence[Conserved], unit: str) -> None:
    """Plot the largest relative change over the members of each conserved quantity along a run."""
    errors = {x.name.partition(",")[0]: x.change().max(axis=1) for x in conserved}
    plots.log_error(ax, t, errors, "relative change, worst member", unit)


def draw_balance(
    axes: np.ndarray,
    t: np.ndarray,
    energy: np.ndarray,
    works: np.ndarray,
    names: Sequence[str],
    *,
    unit: str = "",
    time_unit: str = "",
) -> None:
    """Plot the work of each law on the first member, and the relative change of energy less all work.

    Args:
        axes: two panels.
        t: times (times,).
        energy: (times, members), in `unit`.
        works: of each law, (times, members, laws), in `unit`.
        names: of the laws.
        unit: of energy.
        time_unit: of t.
    """
    left, right = axes
    left.plot(t, energy[:, 0] - energy[0, 0], color=plots.GRAY, lw=3.5, label="change of energy")
    plots.works(left, t, {name: works[:, 0, k] for k, name in enumerate(names)}, unit, time_unit)
    left.set_title("first member")
    largest = abs(energy).max(axis=0)
    balance = energy - works.sum(axis=-1)
    change = abs(balance - balance[0]) / np.where(largest > 0, largest, 1)
    curves = {"worst member": change.max(axis=1), "median": np.median(change, axis=1)}
    plots.log_error(
        right, t, curves if change.shape[1] > 1 else {"": change[:, 0]}, "H − ΣW, relative change", time_unit
    )
    right.set_title("energy less the work of all laws")


def draw_on_sphere(
    axes: np.ndarray,
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
    bounds: Iterable[float] = (),
) -> None:
    """Plot a path of unit vectors on the sphere, the members' vectors at time `end`, and its angle from the pole."""
    left, right = axes
    plots.sphere_path(left, path, pole, eye=pole + 0.8 * path[0] if eye is None else eye, pole_label=pole_label)
    if len(ends) > 1:
        when = f"{end:.4g} {unit}".rstrip()
        plots.sphere_points(left, ends, f"{len(ends)} members at t = {when}", color=plots.INK, s=2, alpha=0.5)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, 0.03), ncols=2)
    plots.series(right, t, {"": np.rad2deg(np.arccos(np.clip(path @ pole, -1, 1)))}, angle_label, unit)
    for bound in bounds:
        right.axhline(bound, color=plots.RED, lw=0.7, ls="--", zorder=3)
