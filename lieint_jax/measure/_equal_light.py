"""Spin states that have the same light, or nearly so.

A solution of Euler's equations, attitude q, body rate Ω and moments J, remains one if space is rotated, q → σq, and if
body axes are relabeled, (q, Ω, J) → (qγ⁻¹, gΩ, gJgᵀ) with g one of the 24 rotations that permute the axes up to sign.

| change | light |
|---|---|
| g a symmetry of the facets | always the same: for a box with two panels, g is a rotation by 180° about a body axis |
| any other g | that of other facets: at best a local minimum of a fit, with the moments exchanged |
| σ = 180° about the normal of the plane of Sun, body and observer (*mirror*) | the same if that plane does not move |
| σ = 180° about the bisector of Sun and observer (*exchange*) | the same if the bisector does not move |
| σ = both: 180° about the difference of the two directions | the same if this direction does not move |

The mirror requires facets with a center of symmetry, since in the body Sun and observer move to their antipodes; the
exchange requires a law of scattering that is the same with Sun and observer exchanged (Helmholtz's reciprocity).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from lieint_jax._checks import all_plain
from lieint_jax.groups import so3
from lieint_jax.measure._light import check_facets, glossy_brightness
from lieint_jax.shapes import GlossyFacets

__all__ = [
    "SPACE_CHANGES",
    "LightChange",
    "SpinStates",
    "classify_light",
    "is_light_symmetry",
    "light_changes",
    "light_differences",
]

SPACE_CHANGES = ("as it is", "mirror", "exchange", "mirror and exchange")
_ALIKE = (20.0, 0.2, 0.2)  # (attitude (°), relative rate, log moments) differ by less in equal solutions


class SpinStates(NamedTuple):
    """Spin states of several bodies.

    Attributes:
        q: attitudes, unit quaternions, (n, 4).
        rate: body rates, (n, 3).
        inertia: principal moments over the geometric mean of the three, (n, 3).
    """

    q: np.ndarray
    rate: np.ndarray
    inertia: np.ndarray

    def select(self, which: np.ndarray | int) -> SpinStates:
        """The states with these indices."""
        return SpinStates(*(np.atleast_2d(leaf[which]) for leaf in self))

    def distance(self, other: SpinStates) -> np.ndarray:
        """The distance of each state from the single state `other`, (n,): below 1 they count as the same.

        Attitudes then differ by less than 20°, rates by less than a fifth, logarithms of moments by less than 0.2.
        """
        cosine, size = np.abs(self.q @ other.q[0]).clip(0, 1), np.linalg.norm(other.rate[0])
        each = (
            np.rad2deg(2 * np.arccos(cosine)) / _ALIKE[0],
            np.linalg.norm(self.rate - other.rate[0], axis=1) / size / _ALIKE[1],
            np.abs(np.log(self.inertia / other.inertia[0])).max(axis=1) / _ALIKE[2],
        )
        return np.max(each, axis=0)


class LightChange(NamedTuple):
    """A change of spin states that may leave the light unchanged, a function of `SpinStates`.

    Attributes:
        space: its kind in space, an index of `SPACE_CHANGES`.
        axes: the new names of the body axes, such as "yxz"; "xyz" where the facets have this symmetry. With signs, such
            as "x−y−z", unless all rotations by 180° about the body axes are symmetries of the facets.
        symmetry: the index of the symmetry of the facets that follows the relabeling; 0 for none.
        sigma: the rotation of space, a quaternion, (4,).
        g: the rotation of the body axes, (3, 3).
    """

    space: int
    axes: str
    symmetry: int
    sigma: np.ndarray
    g: np.ndarray

    @property
    def name(self) -> str:
        """The change in words, without the symmetry of the facets."""
        return SPACE_CHANGES[self.space] if self.axes == "xyz" else f"{SPACE_CHANGES[self.space]}, axes {self.axes}"

    def attitudes(self, q: np.ndarray) -> np.ndarray:
        """Apply the change to attitudes q, (n, 4)."""
        return np.asarray(_relabel(self.sigma, q, self.g))

    def __call__(self, found: SpinStates) -> SpinStates:
        """Apply the change to spin states."""
        return SpinStates(self.attitudes(found.q), found.rate @ self.g.T, found.inertia @ (self.g**2).T)


@jax.jit
def _relabel(sigma: Array, q: Array, g: Array) -> Array:
    gamma = so3.inverse(so3.from_matrix(g))
    return jax.vmap(lambda q: so3.multiply(sigma, so3.multiply(q, gamma)))(q)


def light_changes(facets: GlossyFacets, sun: np.ndarray, observer: np.ndarray) -> list[LightChange]:
    """All changes of a spin state that may leave the light unchanged: of space, of axes, and by symmetries of facets.

    An inversion of a light curve ends at any of them. The changes are those of the mean geometry: the plane of the
    mirror is the one nearest to all directions, the bisector that of the mean directions.

    Args:
        facets: of the body.
        sun, observer: unit vectors in space, from the body, (n, 3).
    """
    all_plain(sun=sun, observer=observer)
    normal = np.linalg.svd(np.concatenate([sun, observer]))[2][2]
    bisector = sun.mean(axis=0) / np.linalg.norm(sun.mean(axis=0)) + observer.mean(axis=0)
    bisector = bisector - (bisector @ normal) * normal  # so that the two rotations commute
    bisector = bisector / np.linalg.norm(bisector)
    every = (np.eye(4)[0], *(np.append(0, v) for v in (normal, bisector, np.cross(normal, bisector))))
    rotations = _axis_rotations()
    own = [g for g in rotations if is_light_symmetry(facets, g)]
    signed = len([g for g in own if np.trace(np.abs(g)) == 3]) < 4
    cosets: list[np.ndarray] = []  # of the symmetries, which act last and leave the light unchanged
    for g in rotations:
        if not any(np.allclose(g, h @ other) for other in cosets for h in own):
            cosets.append(g)
    return [
        LightChange(space, _axes(g, signed), symmetry, sigma, h @ g)
        for space, sigma in enumerate(every)
        for g in cosets
        for symmetry, h in enumerate(own)
    ]


def _axes(g: np.ndarray, signed: bool) -> str:
    """The new names of the body axes, with or without signs."""
    order = np.abs(g).argmax(axis=0)
    return "".join(("−" if signed and g[k, column] < 0 else "") + "xyz"[k] for column, k in enumerate(order))


def _axis_rotations() -> np.ndarray:
    """The 24 rotations that permute the body axes up to sign, as matrices with one ±1 in each row, (24, 3, 3).

    The first four are those about the axes by 0 or 180°; the others exchange axes.
    """
    pairs = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    matrices = np.stack([np.diag(signs)[list(order)] for order, signs in pairs])
    return matrices[np.linalg.det(matrices) > 0]


def is_light_symmetry(facets: GlossyFacets, rotation: np.ndarray) -> bool:
    """Whether a rotation or reflection of the body, (3, 3), maps its facets to facets that send the same light."""
    all_plain(rotation=rotation)
    check_facets(facets, GlossyFacets)
    normals, areas = np.asarray(facets.normals), np.asarray(facets.areas)
    surfaces = np.stack([facets.diffuse, facets.specular, facets.exponent], axis=1)
    for n in np.concatenate([normals, normals @ rotation.T]):
        for surface in surfaces:
            here = areas[_equal_rows(normals, n) & _equal_rows(surfaces, surface)].sum()
            there = areas[_equal_rows(normals @ rotation.T, n) & _equal_rows(surfaces, surface)].sum()
            if abs(here - there) > 1e-12 * areas.sum():
                return False
    return True


def _equal_rows(rows: np.ndarray, row: np.ndarray) -> np.ndarray:
    return np.abs(rows - row).max(axis=1) < 1e-9


def classify_light(found: SpinStates, best: SpinStates, changes: list[LightChange]) -> np.ndarray:
    """The index of the change that maps the single state `best` to each of `found`, (n,); −1 if there is none."""
    distances = np.stack([found.distance(change(best)) for change in changes])
    return np.where(distances.min(axis=0) < 1, distances.argmin(axis=0), -1)


def light_differences(facets: GlossyFacets, q: np.ndarray, sun: np.ndarray, observer: np.ndarray) -> np.ndarray:
    """The change of the light by each kind of change in space, (4,), the largest over the symmetries of the facets.

    It is the root mean square of the differences in magnitude, less their mean, along attitudes q, (n, 4), under
    directions to Sun and observer, (n, 3).
    """
    all_plain(q=q, sun=sun, observer=observer)
    found, light = np.zeros(len(SPACE_CHANGES)), _lights(facets, q, sun, observer)
    for change in light_changes(facets, sun, observer):
        if change.name == SPACE_CHANGES[change.space]:
            ratio = _lights(facets, change.attitudes(q), sun, observer) / light
            found[change.space] = max(found[change.space], 2.5 * float(np.std(np.log10(ratio))))
    return found


_lights = jax.jit(jax.vmap(glossy_brightness, (None, 0, 0, 0)))
