"""Pictures of a run of any system, from its states alone; scenarios have pictures of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from lieint_jax import plots
from lieint_jax.scenarios._body import in_space
from lieint_jax.types import State, Trajectory, energy_less_work


class StoredRun(NamedTuple):
    """A run with its system.

    Attributes:
        title: for pictures.
        time_unit: the unit of its times.
        system: whose leaves have the member axis first if `own_system`.
        run: a `Trajectory`, whose arrays may be on disk, or the arrays of a run with `reduce` by name.
        own_system: whether each member has a system of its own.
    """

    title: str
    time_unit: str
    system: Any
    run: Any
    own_system: bool

    def part(self, times: np.ndarray, members: slice) -> StoredRun:
        """These saved times of these members, in memory."""
        state, info = jax.tree.map(lambda x: np.stack([x[k, members] for k in times]), (self.run.state, self.run.info))
        system = jax.tree.map(lambda x: x[members], self.system) if self.own_system else self.system
        return self._replace(system=system, run=Trajectory(self.run.t[times], state, info))

    def series(self, function: Callable[[Any, State], Array]) -> np.ndarray:
        """The values of a function of system and state, (times, members, …)."""
        over_members = jax.vmap(function, in_axes=(0 if self.own_system else None, 0))
        return np.asarray(jax.jit(jax.vmap(over_members, in_axes=(None, 0)))(self.system, self.run.state))


def of(stored: StoredRun) -> dict[str, Callable[[StoredRun], Figure]]:
    """The functions that draw a run, by the suffix of their file names."""
    if not isinstance(stored.run, Trajectory):
        return {"change": draw_change}
    return {"invariants": draw_invariants, "motion": draw_motion}


@plots.style()
def draw_invariants(stored: StoredRun) -> Figure:
    """Plot the errors of energy (less work, if counted) and momentum against time: the worst member and the median."""
    H = stored.series(energy_less_work)
    Phi = stored.series(lambda system, z: system.momentum(z))
    what = "energy error" if stored.run.state.work is None else "error of energy less work"
    errors = {f"{what}, relative": abs(H - H[0]) / _size(abs(H[0]))}
    if Phi.shape[-1]:
        norm = np.linalg.norm(Phi[0], axis=-1)
        errors["momentum error, relative"] = np.linalg.norm(Phi - Phi[0], axis=-1) / _size(norm)
    fig, axes = plots.figure(len(errors))
    for ax, (label, error) in zip(axes[0], errors.items(), strict=True):
        curves = {"worst member": error.max(axis=1), "median": np.median(error, axis=1)}
        plots.log_error(ax, stored.run.t, curves, label, stored.time_unit)
    fig.suptitle(stored.title)
    return fig


@plots.style()
def draw_motion(stored: StoredRun) -> Figure:
    """Plot the motion of the first member: a direction on the sphere, the centres of bodies, or the components of q."""
    q = np.asarray(stored.run.state.q[:, 0])
    if q.shape[1:] == (4,):
        fig = _draw_direction(in_space(q, np.eye(3)[2]), "body axis z")
    elif q.shape[1:] == (3,):
        fig = _draw_direction(q, "q")
    elif q.shape[2:] == (7,):
        fig = _draw_centres(q[..., :3])
    else:
        fig = _draw_components(stored, q)
    fig.suptitle(stored.title)
    return fig


@plots.style()
def _draw_direction(path: np.ndarray, name: str) -> Figure:
    fig, axes = plots.figure(subplot_kw={"projection": "3d"})
    plots.sphere_path(axes[0, 0], path)
    axes[0, 0].set_title(f"{name} of the first member, in space")
    return fig


@plots.style()
def _draw_centres(x: np.ndarray) -> Figure:
    """The paths (times, bodies, 3) of the centres of the first bodies, in two projections."""
    fig, axes = plots.figure(2)
    curves = {f"body {k + 1}": x[:, k] for k in range(min(x.shape[1], len(plots.STYLES)))}
    for ax, plane in zip(axes[0], ((0, 1), (0, 2)), strict=True):
        plots.paths(ax, curves, plane)
    axes[0, 0].legend()
    more = f", the first {len(plots.STYLES)} of {x.shape[1]} bodies" if x.shape[1] > len(plots.STYLES) else ""
    axes[0, 0].set_title(f"centres of the first member{more}; a mark at the end")
    return fig


@plots.style()
def _draw_components(stored: StoredRun, q: np.ndarray) -> Figure:
    """Every component of q against time, a panel for each row of a matrix."""
    rows = q.reshape(len(q), -1, q.shape[-1])
    fig, axes = plots.figure(rows.shape[1])
    for i, ax in enumerate(axes[0]):
        names = [f"q{i + 1}{j + 1}" if q.ndim > 2 else f"q{j + 1}" for j in range(q.shape[-1])]
        curves = dict(zip(names, rows[:, i].T, strict=True))
        plots.series(ax, stored.run.t, curves, "q of the first member", stored.time_unit)
    return fig


@plots.style()
def draw_change(stored: StoredRun) -> Figure:
    """Plot the least, mean and greatest change of the reduced quantity against time."""
    fig, axes = plots.figure()
    curves = {name: stored.run[name] for name in ("least", "mean", "greatest")}
    plots.series(axes[0, 0], stored.run["time"], curves, "change since the start, all members", stored.time_unit)
    fig.suptitle(stored.title)
    return fig


def _size(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 1)
