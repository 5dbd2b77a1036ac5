"""What an animation shows: attitudes, places and momenta of the bodies of one member of a run, frame by frame."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.core import Trajectory
from lieint_jax.groups import so3
from lieint_jax.plots import solids as meshes
from lieint_jax.plots.runs import MAX_ROTATION, interpolate_at, rotation_angles, spin_axis, top_axis, unit_of
from lieint_jax.plots.solids import BodyShape, Solid
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractManyBodies, AbstractRotatingBody, DissipativeRod, ElasticRod

_MAX_ROTATION = np.deg2rad(15)  # largest rotation of a body between frames, if states can be interpolated
_MAX_TILT = np.deg2rad(2)  # the same for the axis of a top, whose spin may be much faster
_FINE = 4  # number of points of an axis' path from frame to frame, of such a rotation
_MOST_POINTS = 20_000  # of a path
_TILTED = 10.0  # degrees between the principal axes of a body and of its shape, above which a warning is given
_MIN_SIZE = 0.06  # smallest size of the largest body, over that of the scene: smaller bodies are drawn larger
_TIP, _ARROW = 1.2, 1.5  # lengths of axes and momentum vectors, over the size of their body
_ELEMENT = (0.5, 0.25, 0.9)  # sides of the box that shows an element of a rod, over its length

Span = tuple[float | None, float | None]


class Scene(NamedTuple):
    """A scene of `bodies` bodies in `frames` frames, in one unit of length."""

    title: str  # the title of the run
    notes: tuple[str, ...]  # descriptions of what is shown
    time_unit: str  # the unit of t
    t: np.ndarray  # the times of the frames, (frames,)
    solids: tuple[Solid, ...]  # the surface of each body
    rotations: np.ndarray  # rotation matrices, body to space, (frames, bodies, 3, 3)
    centers: np.ndarray  # the centers of the bodies, (frames, bodies, 3)
    momenta: np.ndarray  # the ends of the spatial angular momenta, drawn from the centers, (frames, bodies, 3)
    paths: np.ndarray  # the paths of the ends of the axes, (points, bodies, 3); point k·`fine` belongs to frame k
    fine: int  # the number of points of a path from frame to frame
    middle: np.ndarray  # the center of the scene, (3,)
    reach: float  # half the side of a cube about the center that contains the scene
    needed: int  # the number of frames that would show the requested span smoothly

    def corners(self, frame: int, body: int) -> np.ndarray:
        """The corners of a body in space, (n, 3)."""
        return self.centers[frame, body] + self.solids[body].corners @ self.rotations[frame, body].T

    def arrow(self, frame: int, body: int) -> np.ndarray:
        """The ends of the momentum vector of a body, (2, 3)."""
        return np.stack([self.centers[frame, body], self.momenta[frame, body]])

    def axis(self, frame: int, body: int) -> np.ndarray:
        """The ends of the axis of a body, (2, 3)."""
        return np.stack([self.centers[frame, body], self.paths[frame * self.fine, body]])

    def clock(self, frame: int) -> str:
        """The time of a frame, to print."""
        return f"t = {self.t[frame]:.4g} {self.time_unit}".rstrip()


def scene_of(whole: Run, title: str, frames: int, span: Span = (None, None), shapes: Sequence[BodyShape] = ()) -> Scene:
    """The scene of a run of one body, or one system of bodies, in at most `frames` frames.

    Args:
        whole: the run.
        title: its title.
        frames: the largest number of frames.
        span: the times of the first and the last frame. Without the last, the scene ends where bodies that rotate by
            15° from frame to frame are when the frames are used up.
        shapes: of the first bodies, in the axes of their inertia; others are the solids that have their inertia.

    Raises:
        ValueError: a system without rigid bodies, or times outside the run.
    """
    system: Any = whole.system
    is_multibody = isinstance(system, AbstractManyBodies)
    if not (is_multibody or (whole.state.q.shape[1:] == (4,) and isinstance(system, AbstractRotatingBody))):
        raise ValueError(
            f"{type(system).__name__} has no rigid bodies. Rigid bodies, gyrostats, tops, satellites and "
            "systems of bodies can be animated; `lieint plot` draws this run"
        )
    run, fine, notes, needed = _drawable_span(system, whole.trajectory, frames, unit_of(whole), span)
    q, p = np.asarray(run.state.q), np.asarray(run.state.p)
    x, attitudes, spins = np.zeros((len(q), 1, 3)), q[:, None], p[:, None]
    if is_multibody:
        x, attitudes, spins = q[..., :3], q[..., 3:], p[..., 3:]
    rotations = np.asarray(jax.jit(jax.vmap(jax.vmap(so3.to_matrix)))(jnp.asarray(attitudes)))
    solids, axes, factor = _bodies(system, rotations[0], spins[0], x, shapes)
    if factor > 1:
        notes = (*notes, f"bodies are drawn {factor:.2g} times as large as they are")
    sizes = np.array([solid.size() for solid in solids])[:, None]
    paths = x + np.einsum("tbij,bj->tbi", rotations, _TIP * sizes * axes)
    lengths = np.linalg.norm(spins, axis=-1).max(axis=0)
    momenta = x + _ARROW * sizes * spins / np.where(lengths > 0, lengths, 1)[:, None]
    shown = np.concatenate([z.reshape(-1, 3) for z in (paths, momenta, x - sizes, x + sizes)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    each = ", each to its own scale" if len(solids) > 1 else ""
    notes = (f"blue: the axis and the path of its end; dark orange: the angular momentum{each}", *notes)
    return Scene(
        title=title,
        notes=notes,
        time_unit=unit_of(whole),
        t=np.asarray(run.t)[::fine],
        solids=solids,
        rotations=rotations[::fine],
        centers=x[::fine],
        momenta=momenta[::fine],
        paths=paths,
        fine=fine,
        middle=(low + high) / 2,
        reach=float((high - low).max() / 2),
        needed=needed,
    )


def _drawable_span(
    system: Any, run: Trajectory, frames: int, time_unit: str, span: Span
) -> tuple[Trajectory, int, tuple[str, ...], int]:
    """The part of a trajectory that `frames` frames show, at the points of the paths: all of a span with an end.

    Returns:
        The trajectory, its number of points per frame, notes, and the number of frames that would show it smoothly.
    """
    t = np.asarray(run.t)
    sign, (first, last) = np.sign(t[-1] - t[0]), _span(t, span, time_unit)
    angles, tilts = rotation_angles(system, run)
    steps, per_frame = (angles, _MAX_ROTATION) if top_axis(system) is None else (tilts, _MAX_TILT)
    total = np.concatenate([[0.0], np.cumsum(steps)])
    at_first, at_last = np.interp(sign * np.array([first, last]), sign * t, total)
    limit = at_last if span[1] is not None else at_first + (frames - 1) * per_frame
    end = last if at_last <= limit else np.interp(limit, total, t)
    needed = int(np.ceil((at_last - at_first) / per_frame)) + 1
    low = min(int(np.searchsorted(sign * t, sign * first, side="right")) - 1, len(t) - 2)
    high = max(int(np.searchsorted(sign * t, sign * end)), low + 1)
    notes: tuple[str, ...] = ()
    if at_last > limit:
        length = f"{abs(last - first):.4g} {time_unit}".rstrip()
        notes = (f"the first {abs(end - first):.4g} of {length}",)
    largest = angles[low:high].max()
    if largest <= MAX_ROTATION:
        in_frame = abs(np.diff(np.interp(sign * np.linspace(first, end, frames), sign * t, total))).max()
        if in_frame > 2 * per_frame:
            backward = ", which may seem backward" if in_frame > np.pi / 2 else ""
            notes += (f"up to {np.rad2deg(in_frame):.0f}° of rotation from frame to frame{backward}",)
        fine = max(_FINE, min(int(np.ceil(in_frame / per_frame * _FINE)), _MOST_POINTS // frames))
        times = np.linspace(first, end, (frames - 1) * fine + 1)
        part = jax.tree.map(lambda x: x[low : high + 1], run)
        return interpolate_at(system, part, times), fine, notes, needed
    saved = np.flatnonzero((sign * (t - first) >= 0) & (sign * (last - t) >= 0))
    if len(saved) < 2:
        raise ValueError(f"fewer than two states are saved from t = {first:.6g} to {last:.6g}: save more often")
    shown = saved[:frames] if span[1] is None else saved[:: -(-len(saved) // frames)]
    which = f"{'first' if shown[0] == 0 else 'next'} {len(shown)} saved states"
    if shown[1] - shown[0] > 1:
        which = f"saved states, one of {shown[1] - shown[0]}"
    note = (
        f"the saved states are too far from each other to be interpolated, up to {np.rad2deg(largest):.0f}° of "
        f"rotation: the frames are the {which}; save more often to see the motion between"
    )
    return jax.tree.map(lambda x: x[shown], run), 1, (note,), len(saved)


def _span(t: np.ndarray, span: Span, time_unit: str) -> tuple[float, float]:
    """The first and last time to show; ValueError unless they lie in the run, in its order."""
    first, last = (float(end if given is None else given) for given, end in zip(span, (t[0], t[-1]), strict=True))
    sign = np.sign(t[-1] - t[0])
    if not sign * t[0] <= sign * first < sign * last <= sign * t[-1]:
        unit = f" {time_unit}".rstrip()
        raise ValueError(
            f"--from and --to must lie in the run, from {t[0]:.6g} to {t[-1]:.6g}{unit}, in its order; got "
            f"{first:.6g} to {last:.6g}"
        )
    return first, last


def _bodies(
    system: Any, rotations: np.ndarray, spins: np.ndarray, x: np.ndarray, shapes: Sequence[BodyShape]
) -> tuple[tuple[Solid, ...], np.ndarray, float]:
    """The surfaces of the bodies, the axis of each in the body (bodies, 3), and how many times they are enlarged."""
    axis, single = top_axis(system), not isinstance(system, AbstractManyBodies)
    inertias = np.asarray(system.inertia)[None] if single else np.asarray(system.inertias)
    if len(shapes) > len(inertias):
        raise ValueError(
            f"--shape is given {len(shapes)} times, but the number of bodies in the run is {len(inertias)}"
        )
    for shape, inertia in zip(shapes, inertias, strict=False):
        if (tilt := shape.tilt(inertia)) > _TILTED:
            warnings.warn(
                f"the principal axes of {shape.name} differ by {tilt:.0f}° from those of the body; a body made from a "
                "shape has the shape's axes, one made from its aligned() has not",
                stacklevel=2,
            )
    if axis is not None:
        solids = [shapes[0].solid if shapes else meshes.top(inertias[0], axis)]
        return (solids[0].scaled_by(1 / solids[0].size()),), axis[None], 1.0
    masses = [None] if single else np.asarray(system.masses)
    axes = np.stack([spin_axis(J, R.T @ p) for J, R, p in zip(inertias, rotations, spins, strict=True)])
    solids = [shape.centered() for shape in shapes]
    if isinstance(system, ElasticRod | DissipativeRod):  # sections, whose inertia may be that of far larger bodies
        apart = np.linalg.norm(np.diff(np.asarray(system.natural)[:, :3], axis=0), axis=1).mean()
        solids += [meshes.box(apart * np.array(_ELEMENT))] * (len(inertias) - len(shapes))
        return tuple(solids), axes, 1.0
    solids += [meshes.of_inertia(J, m) for J, m in zip(inertias, masses, strict=True)][len(shapes) :]
    size, extent = max(solid.size() for solid in solids), np.ptp(x, axis=(0, 1)).max() / 2
    factor = 1 / size if single else max(1.0, _MIN_SIZE * extent / size)
    return tuple(solid.scaled_by(factor) for solid in solids), axes, 1.0 if single else factor
