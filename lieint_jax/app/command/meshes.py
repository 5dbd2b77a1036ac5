"""Surfaces of bodies for animations: boxes and tops that have a given inertia."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.app import plots

_THIN = 0.03  # smallest extent of a flat or thin body, relative to its largest
_AROUND = 24  # number of corners of a cone's rim
Face = tuple[int, ...]


class Solid(NamedTuple):
    """The surface of a body at the origin, in body axes.

    Attributes:
        corners: (n, 3).
        faces: the corners of each flat, convex face, by index.
        colors: of the faces.
    """

    corners: np.ndarray
    faces: tuple[Face, ...]
    colors: tuple[str, ...]

    def scaled_by(self, factor: float) -> Solid:
        """The same shape, scaled by a factor."""
        return self._replace(corners=factor * self.corners)

    def size(self) -> float:
        """The distance of the farthest corner from the origin."""
        return float(np.linalg.norm(self.corners, axis=1).max())


def second_moments(inertia: np.ndarray) -> np.ndarray:
    """The second moments E = ∫ x xᵀ dm, (3, 3), of a body with the inertia tr(E)·1 − E, (3, 3) or principal (3,)."""
    J = np.diag(inertia) if np.ndim(inertia) == 1 else np.asarray(inertia)
    return np.trace(J) / 2 * np.eye(3) - J


def box(inertia: np.ndarray, mass: float | None = None) -> Solid:
    """The homogeneous box of an inertia about its center, in its principal axes; opposite faces have one color.

    A box of half-sides a has the second moments m a²/3. Without a mass, its corners are at the distance 1.
    """
    squares, axes = np.linalg.eigh(second_moments(inertia))
    half = np.sqrt(np.maximum(3 * squares, 0))
    half = np.maximum(half, _THIN * half.max())
    half = half / np.linalg.norm(half) if mass is None else half / np.sqrt(mass)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, -1).T
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return Solid(signs * half @ axes.T, faces, tuple(np.repeat([plots.SKY, plots.ORANGE, plots.GREEN], 2).tolist()))


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
