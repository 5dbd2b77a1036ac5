"""Pictures of a run of any system, from its states alone, interpolated where they can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from matplotlib.figure import Figure

from lieint_jax.core import State, Step, Trajectory, counts_work, energy_less_work, labels
from lieint_jax.groups import so3
from lieint_jax.plots import _axes as plots
from lieint_jax.plots import _panels
from lieint_jax.runs import Run, interpolate
from lieint_jax.systems import AbstractBodyInTime, AbstractManyBodies, AbstractRotatingBody, LinearPotential

POINTS = 4_000  # the largest number of points of a curve
MAX_ROTATION = 2.6  # rad between saved states: interpolation then has an error of 0.3° (tumbling bodies)


def rotation_angles(system: Any, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Estimated angles of rotation between saved states, of the fastest body and of a top's axis, (saves − 1,), rad."""
    rates = system.angular_velocities if isinstance(system, AbstractManyBodies) else system.angular_velocity
    Omega = np.asarray(jax.jit(jax.vmap(rates))(jax.tree.map(jnp.asarray, run.state)))
    Omega, axis = Omega.reshape(len(Omega), -1, 3), top_axis(system)
    across = Omega if axis is None else np.cross(Omega, axis)

    def largest_angles(rates: np.ndarray) -> np.ndarray:
        speed = np.linalg.norm(rates, axis=-1).max(axis=1)
        return np.maximum(speed[1:], speed[:-1]) * abs(np.diff(run.t))

    return largest_angles(Omega), largest_angles(across)


def interpolate_at(system: Any, run: Trajectory, times: np.ndarray) -> Trajectory:
    """The trajectory at times inside it, by interpolation; bodies rotate by at most `MAX_ROTATION` between saves."""
    return Trajectory(jnp.asarray(times), interpolate(system, run, times), run.info)


def top_axis(system: Any) -> np.ndarray | None:
    """The axis (3,) of a heavy top in the body, from the fixed point to the center of mass; None for other systems."""
    match system:
        case object(potential=LinearPotential(weight=weight)) if np.any(weight):
            return np.asarray(weight) / np.linalg.norm(weight)
    return None


_CHORD = np.deg2rad(3)  # largest rotation from one point of a drawn path to the next, where `POINTS` allows it


def pictures_of(states: State) -> dict[str, Callable[[Run, str], Figure]]:
    """The functions that draw a run of a batch with these states under a title, by the suffix of their file names."""
    works = {"works": works_of_laws} if "works" in (states.extra or {}) else {}
    invariants = {"errors": errors} if states.p.shape[-1] else {}  # a motion of given rate has none
    return invariants | {"motion": motion} | works


@plots.style()
def errors(run: Run, title: str = "") -> Figure:
    """Plot the errors of energy (less work, if counted) and momentum against time: the worst member and the median."""
    H, K, Phi = series(energy_less_work, run), series(kinetic_energy, run), series(momentum, run)
    what = "error of energy less work" if counts_work(run.state) else "energy error"
    size = np.maximum(abs(H[0]), K.max(axis=0))
    found = {f"{what}, relative": abs(H - H[0]) / np.where(size > 0, size, 1.0)}
    if Phi.shape[-1]:
        norm = np.linalg.norm(Phi[0], axis=-1)
        found["momentum error, relative"] = np.linalg.norm(Phi - Phi[0], axis=-1) / np.where(norm > 0, norm, 1.0)
    fig, axes = plots.figure(len(found))
    for ax, (label, error) in zip(axes[0], found.items(), strict=True):
        curves = {"worst member": error.max(axis=1), "median": np.median(error, axis=1)}
        plots.log_error(ax, np.asarray(run.t), curves, label, unit_of(run))
    fig.suptitle(title)
    return fig


@plots.style()
def works_of_laws(run: Run, title: str = "") -> Figure:
    """Plot the work of each law of torque, and what is left of the change of energy without it."""
    works = np.asarray((run.state.extra or {})["works"])
    names = labels(run.system)
    if len(names) != works.shape[-1]:
        names = [f"law {k + 1}" for k in range(works.shape[-1])]
    H = series(energy, run)
    fig, axes = plots.figure(2)
    _panels.balance(axes[0], np.asarray(run.t), H, works, names, time_unit=unit_of(run))
    fig.suptitle(title)
    return fig


@plots.style()
def motion(run: Run, title: str = "") -> Figure:
    """Plot the motion of the first member: a direction on a sphere, shapes of a chain, centers, or components of q."""
    run = run if run.members is None else run.member(0)
    q = np.asarray(run.state.q)
    match q.shape[1:], run.system:
        case (4,), _:
            fig = _draw_body(run)
        case (3,), _:
            fig = _draw_direction(q, "q")
        case (bodies, 7), object(potential=object(chain=True)) if bodies > 1:
            fig, axes = plots.figure(rows=2, size=(8.0, 2.2), sharex=True)
            _panels.chain(axes[:, 0], np.asarray(run.t), q[..., :3], "centers of the first member")
        case (_, 7), _:
            fig = _draw_centers(q[..., :3])
        case _:
            fig = _draw_components(run, q)
    fig.suptitle(title)
    return fig


def _draw_body(whole: Run) -> Figure:
    """Draw the axis about which a body spins, as a curve if saved states can be interpolated."""
    system, run = whole.system, whole.trajectory
    joined = isinstance(system, AbstractRotatingBody | AbstractBodyInTime)
    if joined:
        angles, _ = rotation_angles(system, run)
        joined = bool(angles.max() <= MAX_ROTATION)
        if joined and angles.max() > _CHORD:
            parts = min(int(np.ceil(angles.max() / _CHORD)), max(1, POINTS // len(angles)))
            places = np.arange(len(angles) * parts + 1) / parts
            run = interpolate_at(system, run, np.interp(places, np.arange(len(run.t)), run.t))
    axis, name = _drawn_axis(system, run)
    return _draw_direction(axis_in_space(np.asarray(run.state.q), axis), name, joined)


def _drawn_axis(system: Any, run: Trajectory) -> tuple[np.ndarray, str]:
    """The body axis to draw, with its name: that of a top, or else the principal axis of the initial spin."""
    axis = top_axis(system)
    if axis is not None:
        return axis, "the top's axis"
    if not isinstance(system, AbstractRotatingBody):
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
    """Plot the paths (times, bodies, 3) of the centers of bodies, the last included, in two projections."""
    fig, axes = plots.figure(2)
    count = x.shape[1]
    drawn = np.linspace(0, count - 1, min(count, len(plots.STYLES))).round().astype(int)
    curves = {f"body {k + 1}": x[:, k] for k in drawn}
    for ax, plane in zip(axes[0], ((0, 1), (0, 2)), strict=True):
        plots.paths(ax, curves, plane)
    axes[0, 0].legend()
    more = f", {len(drawn)} of {count} bodies" if count > len(drawn) else ""
    axes[0, 0].set_title(f"centers of the first member{more}; a mark at the end")
    return fig


@plots.style()
def _draw_components(run: Run, q: np.ndarray) -> Figure:
    """Plot every component of q against time, in one panel per row of a matrix."""
    rows = q.reshape(len(q), -1, q.shape[-1])
    fig, axes = plots.figure(rows.shape[1])
    for i, ax in enumerate(axes[0]):
        names = [f"q{i + 1}{j + 1}" if q.ndim > 2 else f"q{j + 1}" for j in range(q.shape[-1])]
        curves = dict(zip(names, rows[:, i].T, strict=True))
        plots.series(ax, np.asarray(run.t), curves, "q of the first member", unit_of(run))
    return fig


def overview(run: Run, path: str | Path, title: str = "") -> list[Path]:
    """Draw the errors, the motion and the works of laws of a run, and return the files PATH-*.png and .pdf.

    Args:
        run: the run; of one body or of many.
        path: the beginning of the names of the files; an ending, such as that of a store, is left out.
        title: the title of the pictures.
    """
    path, drawn = Path(path), list[Path]()
    for name, picture in pictures_of(run.state).items():
        drawn += plots.save(picture(run, title), path.with_name(f"{path.stem}-{name}.png"))
    return drawn


@plots.style()
def reduced_change(reduced: Mapping[str, np.ndarray], title: str, time_unit: str) -> Figure:
    """Plot the least, mean and greatest change of the reduced quantity against time, or its values over the members."""
    fig, axes = plots.figure()
    fig.suptitle(title)
    if "mean" not in reduced:
        for name in ("least", "last", "greatest"):
            axes[0, 0].hist(reduced[name], histtype="step", label=name)
        axes[0, 0].set(xlabel="quantity of a member, over all steps", ylabel="members")
        axes[0, 0].legend()
        return fig
    curves = {name: reduced[name] for name in ("least", "mean", "greatest")}
    plots.series(axes[0, 0], reduced["time"], curves, "change since the start, all members", time_unit)
    return fig


def unit_of(run: Run) -> str:
    """The unit of a run's times; empty if there is none."""
    return "" if run.facts.time_unit == "1" else run.facts.time_unit


def series(function: Callable[[Any, State], Any], run: Run) -> Any:
    """The values of a function of system and state along a run, (times, …) or (times, members, …), as of NumPy.

    A function that is not a closure is compiled once.
    """
    return jax.tree.map(np.asarray, run.map(Partial(_value, function)))


def _value(function: Callable[[Any, State], Any], step: Step, state: State) -> Any:
    return function(step.system, state)


def energy(system: Any, state: State) -> Array:
    """The energy, (), of a state."""
    return system.energy(state)


def momentum(system: Any, state: State) -> Array:
    """The components of the momentum map of a state."""
    return system.momentum(state)


def kinetic_energy(system: Any, state: State) -> Array:
    """The kinetic energy, or 0: a size for errors of an energy that may itself be 0."""
    return system.kinetic_energy(state) if hasattr(system, "kinetic_energy") else jnp.zeros_like(system.energy(state))


def axis_in_space(q: Any, axis: Any) -> np.ndarray:
    """The directions in space of a body axis, (n, 3), at attitudes (n, 4)."""
    return np.asarray(jax.vmap(so3.Ad, in_axes=(0, None))(jnp.asarray(q), jnp.asarray(axis)))


def is_long_axis_mode(moments: np.ndarray, Pi: np.ndarray) -> bool:
    """Whether a free body tumbles about its axis of least inertia, |Π|² < 2H J₂, or about that of greatest (Poinsot).

    Its principal moments (3,) are ascending, and Π (3,) is in the principal axes.
    """
    return bool((Pi**2).sum() < (Pi**2 / moments).sum() * moments[1])


def spin_axis(inertia: np.ndarray, Pi: np.ndarray) -> np.ndarray:
    """The principal axis (3,) about which a body of an inertia, (3,) or (3, 3), tumbles with the body momentum Π."""
    moments, axes = np.linalg.eigh(np.diag(inertia) if np.ndim(inertia) == 1 else inertia)
    axis = axes[:, 0 if is_long_axis_mode(moments, Pi @ axes) else 2]
    return axis if axis @ Pi >= 0 else -axis
