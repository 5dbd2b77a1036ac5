"""The symmetric solutions of a light curve's fit: other spin states whose light is the same, or nearly so.

A solution (attitude q, body rate Ω, moments J) of Euler's equations remains one if space is rotated, q → σq, and if
body axes are relabeled, (q, Ω, J) → (qγ⁻¹, gΩ, gJgᵀ) with g one of the 24 rotations that permute the axes up to sign.

| change | light |
|---|---|
| g a symmetry of the facets | always the same: for a box with two panels, g is a rotation by 180° about a body axis |
| any other g | that of other facets: at best a local minimum, with the moments exchanged |
| σ = 180° about the normal of the plane of Sun, body and observer (*mirror*) | the same if that plane does not move |
| σ = 180° about the bisector of Sun and observer (*exchange*) | the same if the bisector does not move |
| σ = both: 180° about the difference of the two directions | the same if this direction does not move |

The mirror requires facets with a center of symmetry, since in the body Sun and observer move to their antipodes; the
exchange requires a law of scattering that is the same with Sun and observer exchanged (Helmholtz's reciprocity).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from lieint_jax.app.studies._facets import Facets, axis_rotations, is_symmetry, magnitude
from lieint_jax.app.studies._tumbling import rotate
from lieint_jax.groups import so3

SPACE = ("as it is", "mirror", "exchange", "mirror and exchange")
_NEAR = (20.0, 0.2, 0.2)  # (attitude (°), relative rate, log moments) differ by less in equal solutions


class Solutions(NamedTuple):
    """Spin states at t = 0."""

    q: np.ndarray  # attitudes, (n, 4)
    rate: np.ndarray  # body rates, (n, 3)
    inertia: np.ndarray  # moments over the geometric mean of the three, (n, 3)

    def select(self, which: np.ndarray | int) -> Solutions:
        """The solutions with these indices."""
        return Solutions(*(np.atleast_2d(leaf[which]) for leaf in self))


def solutions(params: dict[str, np.ndarray], begin: np.ndarray) -> Solutions:
    """The solutions of the parameters of n fits, with their reference attitudes `begin`, (n, 4)."""
    q = _attitudes(params["attitude"], begin)
    J = np.concatenate([np.asarray(params["inertia"]), np.ones((len(q), 1))], axis=1)
    return Solutions(np.asarray(q), np.asarray(params["rate"]), J / np.cbrt(J.prod(axis=1, keepdims=True)))


_attitudes = jax.jit(jax.vmap(rotate))


def parameters(found: Solutions) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The parameters of fits and their reference attitudes `begin`, (n, 4): the inverse of `solutions`."""
    inertia = found.inertia[:, :2] / found.inertia[:, 2:]
    return {"attitude": np.zeros_like(found.rate), "inertia": inertia, "rate": found.rate}, found.q


class Change(NamedTuple):
    """A change of solutions that may leave the light unchanged."""

    space: int  # its kind in space, an index of `SPACE`
    # the new names of the body axes, such as "yxz"; "xyz" where the facets have this symmetry. With signs, such as
    # "x−y−z", unless all rotations by 180° about the body axes are symmetries of the facets
    axes: str
    symmetry: int  # the index of the symmetry of the facets that follows the relabeling; 0 for none
    sigma: np.ndarray  # the rotation of space, a quaternion, (4,)
    g: np.ndarray  # the rotation of the body axes, (3, 3)

    @property
    def name(self) -> str:
        """The change in words, without the symmetry of the facets."""
        return SPACE[self.space] if self.axes == "xyz" else f"{SPACE[self.space]}, axes {self.axes}"

    def attitudes(self, q: np.ndarray) -> np.ndarray:
        """Apply the change to attitudes q, (n, 4)."""
        return np.asarray(_relabel(self.sigma, q, self.g))

    def __call__(self, found: Solutions) -> Solutions:
        """Apply the change to solutions."""
        return Solutions(self.attitudes(found.q), found.rate @ self.g.T, found.inertia @ (self.g**2).T)


@jax.jit
def _relabel(sigma: Array, q: Array, g: Array) -> Array:
    gamma = so3.inverse(so3.from_matrix(g))
    return jax.vmap(lambda q: so3.multiply(sigma, so3.multiply(q, gamma)))(q)


def changes(facets: Facets, sun: np.ndarray, observer: np.ndarray) -> list[Change]:
    """All changes, of space, of axes and by symmetries of the facets, for directions to Sun and observer, (n, 3).

    The plane of the mirror is the one nearest to all directions; the bisector is that of the mean directions.
    """
    normal = np.linalg.svd(np.concatenate([sun, observer]))[2][2]
    bisector = sun.mean(axis=0) / np.linalg.norm(sun.mean(axis=0)) + observer.mean(axis=0)
    bisector = bisector - (bisector @ normal) * normal  # so that the two rotations commute
    bisector = bisector / np.linalg.norm(bisector)
    every = (np.eye(4)[0], *(np.append(0, v) for v in (normal, bisector, np.cross(normal, bisector))))
    rotations = axis_rotations()
    own = [g for g in rotations if is_symmetry(facets, g)]
    signed = len([g for g in own if np.trace(np.abs(g)) == 3]) < 4
    cosets: list[np.ndarray] = []  # of the symmetries, which act last and leave the light unchanged
    for g in rotations:
        if not any(np.allclose(g, h @ other) for other in cosets for h in own):
            cosets.append(g)
    return [
        Change(space, _axes(g, signed), symmetry, sigma, h @ g)
        for space, sigma in enumerate(every)
        for g in cosets
        for symmetry, h in enumerate(own)
    ]


def _axes(g: np.ndarray, signed: bool) -> str:
    """The new names of the body axes, with or without signs."""
    order = np.abs(g).argmax(axis=0)
    return "".join(("−" if signed and g[k, column] < 0 else "") + "xyz"[k] for column, k in enumerate(order))


def distance(a: Solutions, b: Solutions) -> np.ndarray:
    """The distance of each solution of a from the single solution b, (n,); below 1 they count as the same."""
    cosine = np.abs(a.q @ b.q[0]).clip(0, 1)
    size = np.linalg.norm(b.rate[0])
    each = (
        np.rad2deg(2 * np.arccos(cosine)) / _NEAR[0],
        np.linalg.norm(a.rate - b.rate[0], axis=1) / size / _NEAR[1],
        np.abs(np.log(a.inertia / b.inertia[0])).max(axis=1) / _NEAR[2],
    )
    return np.max(each, axis=0)


def classify(found: Solutions, best: Solutions, every: list[Change]) -> np.ndarray:
    """The index of the change that maps the solution `best` to each of `found`, (n,); −1 if there is none."""
    distances = np.stack([distance(found, change(best)) for change in every])
    return np.where(distances.min(axis=0) < 1, distances.argmin(axis=0), -1)


def light_differences(facets: Facets, q: np.ndarray, sun: np.ndarray, observer: np.ndarray) -> np.ndarray:
    """The change of the light by each kind of change in space, (4,), the largest over the symmetries of the facets.

    It is the root mean square of the differences in magnitude, less their mean, along attitudes q, (n, 4), under
    directions to Sun and observer, (n, 3).
    """
    found = np.zeros(len(SPACE))
    for change in changes(facets, sun, observer):
        if change.name == SPACE[change.space]:
            difference = _light(facets, change.attitudes(q), sun, observer) - _light(facets, q, sun, observer)
            found[change.space] = max(found[change.space], float(np.std(difference)))
    return found


_light = jax.jit(jax.vmap(magnitude, (None, 0, 0, 0)))
