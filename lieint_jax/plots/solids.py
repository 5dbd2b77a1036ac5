"""Surfaces of bodies for animations: solids of a given inertia, and shapes of files (OBJ, STL, parts in TOML)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lieint_jax import shapes
from lieint_jax.plots import _axes as plots

_THIN = 0.03  # smallest extent of a flat or thin body, relative to its largest
_AROUND = 24  # number of corners of a circle
_DISTINCT = 0.02  # difference of moments of inertia, relative to their sum, that defines principal axes
_FACE = 0.25  # largest face of joined solids, relative to them: pictures order faces by the distance of their centers
_COLORS = np.array([plots.SKY, plots.ORANGE, plots.GREEN])
Face = tuple[int, ...]


class Solid(NamedTuple):
    """The surface of a body, in body axes."""

    corners: np.ndarray  # (n, 3)
    faces: tuple[Face, ...]  # the corners of each flat, convex face, by index
    colors: tuple[str, ...]  # of the faces

    def scaled_by(self, factor: float) -> Solid:
        """The same shape, scaled by a factor."""
        return self._replace(corners=factor * self.corners)

    def moved(self, by: np.ndarray, rotation: np.ndarray | None = None) -> Solid:
        """The same shape rotated by a matrix, (3, 3), then translated."""
        turned = self.corners if rotation is None else self.corners @ rotation.T
        return self._replace(corners=turned + by)

    def size(self) -> float:
        """The distance of the farthest corner from the origin."""
        return float(np.linalg.norm(self.corners, axis=1).max())


def colored(corners: np.ndarray, faces: Sequence[Face]) -> Solid:
    """A surface whose faces have the color of the axis that is nearest to their normal: x, y or z."""
    a, b, c = (corners[[face[k] for face in faces]] for k in range(3))
    nearest = abs(np.cross(b - a, c - a)).argmax(axis=1)
    return Solid(corners, tuple(faces), tuple(_COLORS[nearest].tolist()))


def box(edges: np.ndarray) -> Solid:
    """A box about the origin, of full lengths (3,)."""
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, -1).T
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return colored(signs * np.asarray(edges) / 2, faces)


def cylinder(radius: float, height: float) -> Solid:
    """A cylinder about the origin, its axis along z."""
    return _lathe(np.array([[radius, -height / 2], [radius, height / 2]]))


def ellipsoid(semi_axes: np.ndarray) -> Solid:
    """An ellipsoid about the origin."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, _AROUND // 2 + 1)[1:-1]
    ball = _lathe(np.stack([np.cos(latitude), np.sin(latitude)], axis=1))
    return ball._replace(corners=ball.corners * semi_axes)


def _lathe(profile: np.ndarray) -> Solid:
    """The surface of a profile (n, 2) of radii and heights, ascending, that rotates about z, with flat ends."""
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    (r, z), ones = profile.T, np.ones(_AROUND)
    corners = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.outer(z, ones)], axis=-1)
    rings = np.arange(len(r) * _AROUND).reshape(-1, _AROUND)
    low, high = rings[:-1], rings[1:]
    sides = np.stack([low, np.roll(low, -1, axis=1), np.roll(high, -1, axis=1), high], axis=-1).reshape(-1, 4)
    return colored(corners.reshape(-1, 3), [*map(tuple, [*sides.tolist(), rings[0].tolist(), rings[-1].tolist()])])


def join(solids: Sequence[Solid]) -> Solid:
    """Several solids as one, in faces so small that a picture can order them by their distance from the viewer."""
    starts = np.cumsum([0, *(len(solid.corners) for solid in solids)])
    corners = [x for solid in solids for x in solid.corners]
    faces = [tuple(k + n for k in face) for n, solid in zip(starts, solids, strict=False) for face in solid.faces]
    waiting = [*zip(faces, [color for solid in solids for color in solid.colors], strict=True)]
    largest, found = _FACE * np.ptp(np.array(corners), axis=0).max(), []
    while waiting:
        face, color = waiting.pop()
        places = np.array([corners[k] for k in face])
        if np.ptp(places, axis=0).max() <= largest:
            found.append((face, color))
            continue
        middles = (places + np.roll(places, -1, axis=0)) / 2
        i = int(np.linalg.norm(places - middles, axis=1).argmax())  # cut from the longest edge to the opposite one
        j, face = len(face) // 2, (*face[i + 1 :], *face[: i + 1])
        corners += [middles[i], middles[(i + j) % len(face)]]
        last, opposite = len(corners) - 2, len(corners) - 1
        waiting += [((last, *face[:j], opposite), color), ((opposite, *face[j:], last), color)]
    return Solid(np.array(corners), *zip(*found, strict=True))


def second_moments(inertia: np.ndarray) -> np.ndarray:
    """The second moments E = ∫ x xᵀ dm, (3, 3), of a body with the inertia tr(E)·1 − E, (3, 3) or principal (3,)."""
    J = np.diag(inertia) if np.ndim(inertia) == 1 else np.asarray(inertia)
    return np.trace(J) / 2 * np.eye(3) - J


def of_inertia(inertia: np.ndarray, mass: float | None = None) -> Solid:
    """The homogeneous ellipsoid of a mass and an inertia about its center; without a mass a box with its corners at 1.

    With half-axes a, the second moments of an ellipsoid are m a²/5, and those of a box m a²/3.
    """
    squares, axes = np.linalg.eigh(second_moments(inertia))
    half = np.sqrt(np.maximum((3 if mass is None else 5) * squares, 0))
    half = np.maximum(half, _THIN * half.max())
    solid = box(2 * half / np.linalg.norm(half)) if mass is None else ellipsoid(half / np.sqrt(mass))
    return solid.moved(np.zeros(3), axes)


def top(inertia: np.ndarray, axis: np.ndarray) -> Solid:
    """The homogeneous cone with its tip at the origin, about an axis, of an inertia about the tip; its rim is at 1.

    A cone of height h with the half-axes a, b of its rim has the second moments 3mh²/5 along, 3ma²/20, 3mb²/20 across.
    """
    along = axis / np.linalg.norm(axis)
    _, _, (_, e1, e2) = np.linalg.svd(along[None])
    E = second_moments(inertia)
    height = np.sqrt(max(5 / 3 * along @ E @ along, 0))
    across = np.stack([e1, e2])
    squares, rotation = np.linalg.eigh(across @ E @ across.T)
    half = np.sqrt(np.maximum(20 / 3 * squares, 0))
    height, half = max(height, half.max() / 3), np.maximum(half, height / 3)  # so that it looks like a cone
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) * half @ (rotation.T @ across) + height * along
    corners = np.concatenate([np.zeros((1, 3)), rim, height * along[None]])
    pairs = [(k, k % _AROUND + 1) for k in range(1, _AROUND + 1)]
    faces = [(0, i, j) for i, j in pairs] + [(_AROUND + 1, i, j) for i, j in pairs]
    stripes = [plots.ORANGE if k < _AROUND // 4 else plots.SKY for k in range(_AROUND)]  # a quarter shows the spin
    return Solid(corners / np.linalg.norm(corners, axis=1).max(), tuple(faces), tuple(2 * stripes))


class BodyShape(NamedTuple):
    """The shape of a body in the axes of its inertia."""

    name: str  # of its file
    solid: Solid  # its surface
    shape: shapes.Shape  # its moments, at some density

    def centered(self) -> Solid:
        """The surface with the center of mass at the origin."""
        return self.solid.moved(-np.asarray(self.shape.center))

    def tilt(self, inertia: np.ndarray) -> float:
        """The largest angle in degrees, up to 90, between the principal axes of the shape and those of an inertia.

        Axes of moments that are nearly equal are not compared.
        """
        moments, axes = np.linalg.eigh(np.diag(inertia) if np.ndim(inertia) == 1 else inertia)
        own = np.asarray(self.shape.inertia)
        J = axes.T @ (np.diag(own) if own.ndim == 1 else own) @ axes
        J, moments, largest = J / np.trace(J), moments / moments.sum(), 0.0
        for i, j in ((0, 1), (0, 2), (1, 2)):
            off, difference = 2 * abs(J[i, j]), J[j, j] - J[i, i]
            if moments[j] - moments[i] > _DISTINCT and np.hypot(off, difference) > _DISTINCT:
                largest = max(largest, np.rad2deg(np.arctan2(off, difference)) / 2)
        return largest


def read(path: Path) -> BodyShape:
    """The shape of a body in a file of triangles, as `shapes.surface` reads it.

    Raises:
        ValueError: there is no such file, it has another ending, or it describes no solid.
    """
    if not path.is_file():
        raise ValueError(f"there is no file {path} with the shape of a body")
    corners, faces = shapes.surface(path, closed=True)
    return BodyShape(path.name, colored(corners, faces.tolist()), shapes.mesh(corners, faces, density=1.0))
