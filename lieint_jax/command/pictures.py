"""Pictures of a run of any system, from its states alone; scenarios have pictures of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from lieint_jax import plots
from lieint_jax.groups import so3
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
    fig.suptitle(stored.title, fontsize="medium")
    return fig


def draw_motion(stored: StoredRun) -> Figure:
    """Plot the motion of the first member: a direction on the sphere, or every component of q against time."""
    q = np.asarray(stored.run.state.q[:, 0])
    if q.shape[1:] == (4,):
        path, title = np.asarray(jax.vmap(so3.Ad, (0, None))(jnp.asarray(q), jnp.array([0.0, 0.0, 1.0]))), "body axis z"
    elif q.shape[1:] == (3,):
        path, title = q, "q"
    else:
        fig, axes = plots.figure()
        names = [f"q{''.join(str(i + 1) for i in index)}" for index in np.ndindex(q.shape[1:])]
        plots.series(
            axes[0, 0], stored.run.t, dict(zip(names, q.reshape(len(q), -1).T, strict=True)), "q", stored.time_unit
        )
        axes[0, 0].legend(frameon=False, fontsize="xx-small", ncols=q.shape[-1])
        fig.suptitle(stored.title, fontsize="medium")
        return fig
    fig, axes = plots.figure(subplot_kw={"projection": "3d"})
    plots.sphere_path(axes[0, 0], path)
    axes[0, 0].set_title(f"{title} of the first member, in space", fontsize="small")
    fig.suptitle(stored.title, fontsize="medium")
    return fig


def draw_change(stored: StoredRun) -> Figure:
    """Plot the least, mean and greatest change of the reduced quantity against time."""
    fig, axes = plots.figure()
    curves = {name: stored.run[name] for name in ("least", "mean", "greatest")}
    plots.series(axes[0, 0], stored.run["time"], curves, "change since the start, all members", stored.time_unit)
    fig.suptitle(stored.title, fontsize="medium")
    return fig


def _size(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 1)
