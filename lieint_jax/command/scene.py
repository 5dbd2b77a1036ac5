"""What an animation shows: attitudes, places and momenta of the bodies of one member of a run, frame by frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.command.pictures import StoredRun
from lieint_jax.command.solids import Solid, box, top
from lieint_jax.groups import so3
from lieint_jax.integrate import interpolate
from lieint_jax.scenarios._body import spin_axis
from lieint_jax.systems.heavy_top import Linear
from lieint_jax.types import Bodies, FreeBodies, Trajectory

_MOST = np.deg2rad(15)  # the most that a body turns from frame to frame, if states can be interpolated
_TILT = np.deg2rad(2)  # the same of the axis of a top, whose spin may be much faster
_APART = 2.6  # rad, the most between saved states: those found between them are off by .3° (tumbling bodies)
_FINE = 4  # points of the path of an axis between two frames
_SMALLEST = 0.06  # the size of the largest of several bodies, over that of the scene; smaller ones are drawn larger
_TIP, _ARROW = 1.2, 1.5  # where axes and momentum vectors end, over the size of their body


class Scene(NamedTuple):
    """A scene of `bodies` bodies in `frames` frames, in one unit of length.

    Attributes:
        title: of the run.
        notes: what is shown, in sentences.
        time_unit: of t.
        t: times (frames,).
        solids: the surface of each body.
        turns: rotation matrices, body to space, (frames, bodies, 3, 3).
        centres: (frames, bodies, 3).
        momenta: ends of the spatial angular momenta, drawn from the centres, (frames, bodies, 3).
        paths: of the ends of the axes, (points, bodies, 3); point k·`fine` belongs to frame k.
        fine: points of a path from frame to frame.
        middle: the middle of what is seen, (3,).
        reach: half the side of a cube about it that holds everything.
    """

    title: str
    notes: tuple[str, ...]
    time_unit: str
    t: np.ndarray
    solids: tuple[Solid, ...]
    turns: np.ndarray
    centres: np.ndarray
    momenta: np.ndarray
    paths: np.ndarray
    fine: int
    middle: np.ndarray
    reach: float

    def corners(self, frame: int, body: int) -> np.ndarray:
        """The corners of a body in space, (n, 3)."""
        return self.centres[frame, body] + self.solids[body].corners @ self.turns[frame, body].T

    def arrow(self, frame: int, body: int) -> np.ndarray:
        """The ends of the momentum vector of a body, (2, 3)."""
        return np.stack([self.centres[frame, body], self.momenta[frame, body]])

    def axis(self, frame: int, body: int) -> np.ndarray:
        """The ends of the axis of a body, (2, 3)."""
        return np.stack([self.centres[frame, body], self.paths[frame * self.fine, body]])

    def clock(self, frame: int) -> str:
        """The time of a frame, to print."""
        return f"t = {self.t[frame]:.4g} {self.time_unit}"


def of(stored: StoredRun, member: int, frames: int) -> Scene:
    """The scene of one member of a run, in at most `frames` frames.

    Raises:
        ValueError: a system without rigid bodies, or no such member.
    """
    system = jax.tree.map(lambda x: x[member], stored.system) if stored.own_system else stored.system
    several = isinstance(system, Bodies | FreeBodies)
    shape = stored.run.state.q.shape
    if not (several or (shape[2:] == (4,) and hasattr(system, "inertia"))):
        raise ValueError(
            f"{type(system).__name__} is not made of rigid bodies: rigid bodies, gyrostats, tops, satellites and "
            "several bodies can be animated; `lieint plot` draws this run"
        )
    if not 0 <= member < shape[1]:
        raise ValueError(f"the run has members 0 to {shape[1] - 1}, got --member {member}")
    run, fine, notes = _shown(system, _member(stored.run, member), frames, stored.time_unit)
    q, p = np.asarray(run.state.q), np.asarray(run.state.p)
    x, attitudes, spins = (q[..., :3], q[..., 3:], p[..., 3:]) if several else (np.zeros((len(q), 1, 3)), q[:, None], p)
    spins = spins.reshape(len(q), -1, 3)
    turns = np.asarray(jax.jit(jax.vmap(jax.vmap(so3.to_matrix)))(jnp.asarray(attitudes)))
    solids, axes, factor = _bodies(system, turns[0], spins[0], x)
    if factor > 1:
        notes = (*notes, f"bodies are drawn {factor:.2g} times as large as they are")
    sizes = np.array([solid.size() for solid in solids])[:, None]
    paths = x + np.einsum("tbij,bj->tbi", turns, _TIP * sizes * axes)
    lengths = np.linalg.norm(spins, axis=-1).max(axis=0)
    momenta = x + _ARROW * sizes * spins / np.where(lengths > 0, lengths, 1)[:, None]
    seen = np.concatenate([z.reshape(-1, 3) for z in (paths, momenta, x - sizes, x + sizes)])
    low, high = seen.min(axis=0), seen.max(axis=0)
    each = ", each to its own scale" if len(solids) > 1 else ""
    notes = (f"blue: the axis and the path of its end; red: the angular momentum{each}", *notes)
    return Scene(
        title=stored.title,
        notes=notes,
        time_unit=stored.time_unit,
        t=np.asarray(run.t)[::fine],
        solids=solids,
        turns=turns[::fine],
        centres=x[::fine],
        momenta=momenta[::fine],
        paths=paths,
        fine=fine,
        middle=(low + high) / 2,
        reach=float((high - low).max() / 2),
    )


def _member(run: Trajectory, member: int) -> Trajectory:
    """The trajectory of one member, in memory."""
    return Trajectory(jnp.asarray(run.t), *jax.tree.map(lambda x: np.asarray(x[:, member]), (run.state, run.info)))


def _shown(system: Any, run: Trajectory, frames: int, time_unit: str) -> tuple[Trajectory, int, tuple[str, ...]]:
    """The beginning of a trajectory that `frames` frames can show, at the points of paths; points a frame; notes."""
    t = np.asarray(run.t)
    turns, tilts = _turns(system, run)
    turned, most = np.concatenate([[0.0], np.cumsum(turns)]), (frames - 1) * _MOST
    if _pointed(system) is not None:
        turned, most = np.concatenate([[0.0], np.cumsum(tilts)]), (frames - 1) * _TILT
    end = t[-1] if turned[-1] <= most else np.interp(most, turned, t)
    kept = min(int(np.searchsorted(turned, most)) + 1, len(t))
    part = jax.tree.map(lambda x: x[:kept], run)
    times = np.linspace(t[0], end, (frames - 1) * _FINE + 1)
    notes: tuple[str, ...] = ()
    if turned[-1] > most:
        notes = (f"the first {abs(end - t[0]):.4g} of {abs(t[-1] - t[0]):.4g} {time_unit}",)
    apart = turns[: kept - 1].max()
    if apart <= _APART:
        return Trajectory(jnp.asarray(times), interpolate(system, part, times), part.info), _FINE, notes
    first = jax.tree.map(lambda x: x[:frames], run)
    note = (
        f"states are saved too far apart to be interpolated, up to {np.rad2deg(apart):.0f}° of turning: the frames are "
        f"the first {len(first.t)} saved states; save more often to see what is between"
    )
    return first, 1, (note,)


def _turns(system: Any, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """About how far the fastest body and the axis of a top turn between saved states, (saves − 1,), in radians."""
    rates = system.angular_velocities if hasattr(system, "angular_velocities") else system.angular_velocity
    Omega = np.asarray(jax.jit(jax.vmap(rates))(jax.tree.map(jnp.asarray, run.state)))
    Omega, axis = Omega.reshape(len(Omega), -1, 3), _pointed(system)
    across = Omega if axis is None else np.cross(Omega, axis)

    def turns(rates: np.ndarray) -> np.ndarray:
        speed = np.linalg.norm(rates, axis=-1).max(axis=1)
        return np.maximum(speed[1:], speed[:-1]) * abs(np.diff(run.t))

    return turns(Omega), turns(across)


def _bodies(
    system: Any, turns: np.ndarray, spins: np.ndarray, x: np.ndarray
) -> tuple[tuple[Solid, ...], np.ndarray, float]:
    """The surfaces of the bodies, the axis of each in the body (bodies, 3), and by how much they are enlarged."""
    axis = _pointed(system)
    if axis is not None:
        return (top(np.asarray(system.inertia), axis),), axis[None], 1.0
    single = not hasattr(system, "inertias")
    inertias = np.asarray(system.inertia)[None] if single else np.asarray(system.inertias)
    masses = [None] if single else np.asarray(system.masses)
    axes = np.stack([spin_axis(J, R.T @ p) for J, R, p in zip(inertias, turns, spins, strict=True)])
    solids = [box(J, m) for J, m in zip(inertias, masses, strict=True)]
    extent = np.ptp(x, axis=(0, 1)).max() / 2
    factor = max(1.0, _SMALLEST * extent / max(solid.size() for solid in solids))
    return tuple(solid.grown(factor) for solid in solids), axes, factor


def _pointed(system: Any) -> np.ndarray | None:
    """The axis (3,) of a heavy top, from its fixed point to its centre of mass in the body; None of other systems."""
    potential = getattr(system, "potential", None)
    weight = np.asarray(potential.weight) if isinstance(potential, Linear) else np.zeros(3)
    return weight / np.linalg.norm(weight) if weight.any() else None
