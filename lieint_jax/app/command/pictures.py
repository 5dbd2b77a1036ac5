"""Pictures of a run of any system, from its states alone; scenarios have their own pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from lieint_jax.app import plots
from lieint_jax.app.command import interpolation
from lieint_jax.app.scenarios import _pictures
from lieint_jax.app.scenarios._body import axis_in_space, spin_axis
from lieint_jax.app.scenarios._runs import POINTS
from lieint_jax.groups import so3
from lieint_jax.types import State, Trajectory, counts_work, energy_less_work, labels
from lieint_jax.types.members import map_over_run

_CHORD = np.deg2rad(3)  # largest rotation from one point of a drawn path to the next, where `POINTS` allows it


class StoredRun(NamedTuple):
    """A run with its system."""

    title: str  # the title of its pictures
    time_unit: str  # the unit of its times
    system: Any  # the system; its leaves have the member axis first if `own_system`
    run: Any  # a `Trajectory`, whose arrays may be on disk, or the arrays of a run with `reduce` by name
    own_system: bool  # whether each member has a system of its own

    def select(self, times: np.ndarray, members: slice) -> StoredRun:
        """The saved states of these members at these times (indices), read into memory."""
        state, info = jax.tree.map(lambda x: np.stack([x[k, members] for k in times]), (self.run.state, self.run.info))
        system = jax.tree.map(lambda x: x[members], self.system) if self.own_system else self.system
        return self._replace(system=system, run=Trajectory(self.run.t[times], state, info))

    def system_of(self, member: int) -> Any:
        """The system of one member."""
        return jax.tree.map(lambda x: x[member], self.system) if self.own_system else self.system

    def series(self, function: Callable[[Any, State], Array]) -> np.ndarray:
        """The values of a function of system and state, (times, members, …)."""
        measure = partial(map_over_run, function, system_axis=0 if self.own_system else None)
        return np.asarray(jax.jit(measure)(self.system, self.run))


def drawing_functions(stored: StoredRun) -> dict[str, Callable[[StoredRun], Figure]]:
    """The functions that draw a run, by the suffix of their file names."""
    if not isinstance(stored.run, Trajectory):
        return {"change": draw_change}
    works = {"works": draw_works} if "works" in (stored.run.state.extra or {}) else {}
    return {"invariants": draw_invariants, "motion": draw_motion} | works


@plots.style()
def draw_invariants(stored: StoredRun) -> Figure:
    """Plot the errors of energy (less work, if counted) and momentum against time: the worst member and the median."""
    H = stored.series(energy_less_work)
    Phi = stored.series(lambda system, z: system.momentum(z))
    what = "error of energy less work" if counts_work(stored.run.state) else "energy error"
    errors = {f"{what}, relative": abs(H - H[0]) / _nonzero(abs(H[0]))}
    if Phi.shape[-1]:
        norm = np.linalg.norm(Phi[0], axis=-1)
        errors["momentum error, relative"] = np.linalg.norm(Phi - Phi[0], axis=-1) / _nonzero(norm)
    fig, axes = plots.figure(len(errors))
    for ax, (label, error) in zip(axes[0], errors.items(), strict=True):
        curves = {"worst member": error.max(axis=1), "median": np.median(error, axis=1)}
        plots.log_error(ax, stored.run.t, curves, label, stored.time_unit)
    fig.suptitle(stored.title)
    return fig


@plots.style()
def draw_works(stored: StoredRun) -> Figure:
    """Plot the work of each law of torque, and what is left of the change of energy without it."""
    works = np.asarray(stored.run.state.extra["works"])
    names = labels(stored.system)
    if len(names) != works.shape[-1]:
        names = [f"law {k + 1}" for k in range(works.shape[-1])]
    H = stored.series(lambda system, z: system.energy(z))
    fig, axes = plots.figure(2)
    _pictures.draw_balance(axes[0], stored.run.t, H, works, names, time_unit=stored.time_unit)
    fig.suptitle(stored.title)
    return fig


@plots.style()
def draw_motion(stored: StoredRun) -> Figure:
    """Plot the motion of the first member: a direction on the sphere, the centers of bodies, or the components of q."""
    q = np.asarray(stored.run.state.q[:, 0])
    if q.shape[1:] == (4,):
        fig = _draw_body(stored)
    elif q.shape[1:] == (3,):
        fig = _draw_direction(q, "q")
    elif q.shape[2:] == (7,):
        fig = _draw_centers(q[..., :3])
    else:
        fig = _draw_components(stored, q)
    fig.suptitle(stored.title)
    return fig


def _draw_body(stored: StoredRun) -> Figure:
    """Draw the axis about which the first member's body spins, as a curve if saved states can be interpolated."""
    system, run = stored.system_of(0), interpolation.member(stored.run, 0)
    joined = hasattr(system, "angular_velocity")
    if joined:
        angles, _ = interpolation.rotation_angles(system, run)
        joined = bool(angles.max() <= interpolation.MAX_ROTATION)
        if joined and angles.max() > _CHORD:
            parts = min(int(np.ceil(angles.max() / _CHORD)), max(1, POINTS // len(angles)))
            places = np.arange(len(angles) * parts + 1) / parts
            run = interpolation.interpolate_at(system, run, np.interp(places, np.arange(len(run.t)), run.t))
    axis, name = _drawn_axis(system, run)
    return _draw_direction(axis_in_space(np.asarray(run.state.q), axis), name, joined)


def _drawn_axis(system: Any, run: Trajectory) -> tuple[np.ndarray, str]:
    """The body axis to draw, with its name: that of a top, or else the principal axis of the initial spin."""
    axis = interpolation.top_axis(system)
    if axis is not None:
        return axis, "the top's axis"
    if not hasattr(system, "inertia"):
        return np.eye(3)[2], "body axis z"
    momentum = so3.Ad_star(jnp.asarray(run.state.q[0]), jnp.asarray(run.state.p[0]))
    axis = spin_axis(np.asarray(system.inertia), np.asarray(momentum))
    k = int(abs(axis).argmax())
    if abs(axis[k]) > 1 - 1e-12:
        return axis, f"body axis {'−' if axis[k] < 0 else ''}{'xyz'[k]}"
    return axis, "the principal axis of the initial spin"


@plots.style()
def _draw_direction(path: np.ndarray, name: str, joined: bool = True) -> Figure:
    fig, axes = plots.figure(subplot_kw={"projection": "3d"})
    ax = plots.sphere_path(axes[0, 0], path, joined=joined)
    plots.sphere_ends(ax, path)
    plots.sphere_axes(ax)
    ax.legend(loc="upper left")
    note = "" if joined else "; dots: the saved states are too far from each other for a curve"
    ax.set_title(f"{name} of the first member, in space; a line every 30°{note}", wrap=True)
    return fig


@plots.style()
def _draw_centers(x: np.ndarray) -> Figure:
    """Plot the paths (times, bodies, 3) of the centers of the first bodies, in two projections."""
    fig, axes = plots.figure(2)
    curves = {f"body {k + 1}": x[:, k] for k in range(min(x.shape[1], len(plots.STYLES)))}
    for ax, plane in zip(axes[0], ((0, 1), (0, 2)), strict=True):
        plots.paths(ax, curves, plane)
    axes[0, 0].legend()
    more = f", the first {len(plots.STYLES)} of {x.shape[1]} bodies" if x.shape[1] > len(plots.STYLES) else ""
    axes[0, 0].set_title(f"centers of the first member{more}; a mark at the end")
    return fig


@plots.style()
def _draw_components(stored: StoredRun, q: np.ndarray) -> Figure:
    """Plot every component of q against time, in one panel per row of a matrix."""
    rows = q.reshape(len(q), -1, q.shape[-1])
    fig, axes = plots.figure(rows.shape[1])
    for i, ax in enumerate(axes[0]):
        names = [f"q{i + 1}{j + 1}" if q.ndim > 2 else f"q{j + 1}" for j in range(q.shape[-1])]
        curves = dict(zip(names, rows[:, i].T, strict=True))
        plots.series(ax, stored.run.t, curves, "q of the first member", stored.time_unit)
    return fig


@plots.style()
def draw_change(stored: StoredRun) -> Figure:
    """Plot the least, mean and greatest change of the reduced quantity against time, or its values over the members."""
    fig, axes = plots.figure()
    fig.suptitle(stored.title)
    if "mean" not in stored.run:
        for name in ("least", "last", "greatest"):
            axes[0, 0].hist(stored.run[name], histtype="step", label=name)
        axes[0, 0].set(xlabel="quantity of a member, over all steps", ylabel="members")
        axes[0, 0].legend()
        return fig
    curves = {name: stored.run[name] for name in ("least", "mean", "greatest")}
    plots.series(axes[0, 0], stored.run["time"], curves, "change since the start, all members", stored.time_unit)
    return fig


def _nonzero(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 1)
