"""The surface of a convex body as flat facets."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.core import pytree
from lieint_jax.shapes._solids import closed_surface

__all__ = ["Facets", "GlossyFacets", "box_facets", "ellipsoid_facets", "facets"]

_DEPTH = 1e-3  # of a hollow that is no rounding of the vertices, over the size of the body
_AT_ONCE = 2**22  # pairs of a facet and a vertex whose heights are compared together


@pytree
class Facets:
    """The facets of a convex body. Made by `facets`, `ellipsoid_facets` and `box_facets`.

    Attributes:
        normals: outward unit normals in body axes, (F, 3).
        areas: the areas, (F,).
    """

    normals: Array
    areas: Array


@pytree
class GlossyFacets(Facets):
    """Facets that scatter light diffusely, and in a lobe about the mirror direction: see `measure.glossy_brightness`.

    A thin panel is two facets, back to back.

    Attributes:
        diffuse: Lambert's albedo of each, (F,).
        specular: the height of the lobe, on the scale of `diffuse`, (F,).
        exponent: of the lobe's cosine, ≥ 1, (F,).
    """

    diffuse: Array
    specular: Array
    exponent: Array


def facets(vertices: ArrayLike, faces: Any) -> Facets:
    """The facets of a convex polyhedron of triangles, such as a shape that was found from light curves.

    Args:
        vertices: in body axes, (V, 3). An attitude is that of these axes: for a mesh whose axes are not principal
            axes, rotate the vertices as `shapes.mesh(…).principal_axes()` describes.
        faces: indices of the three vertices of each triangle, from 0, (F, 3), as in `shapes.mesh`.

    Raises:
        ValueError: the surface is not closed, triangles differ in orientation, or the body is not convex: a vertex is
            above the plane of a facet by more than 0.001 of the body's size.

    Example: a tetrahedron.

        >>> found = facets([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> found.areas.round(3).tolist(), found.normals[0].tolist()
        ([0.5, 0.5, 0.5, 0.866], [0.0, 0.0, -1.0])
    """
    at, triangles = closed_surface(vertices, faces)
    a, b, c = jnp.moveaxis((at - jnp.mean(at, axis=0))[triangles], 1, 0)
    vectors = jnp.cross(b - a, c - a) / 2
    vectors = vectors * jnp.sign(jnp.sum(a * vectors))  # three times the volume
    if concrete(at):
        _check_convex(np.asarray(at, float), np.asarray(vectors, float), triangles)
    return _from_vectors(vectors)


def ellipsoid_facets(semi_axes: ArrayLike, rings: int = 24) -> Facets:
    """The facets of an ellipsoid about the origin: 2n² of them, in n rings about z.

    Their normals are those of the ellipsoid at the points of a quadrature over the sphere, Gauss's in z, and their
    areas are those of the surface there. Integrals of smooth functions of the normal converge faster than any power
    of n, those over the part that is lit or seen as n⁻² at least.

    Args:
        semi_axes: along x, y and z, (3,), > 0.
        rings: n ≥ 2.

    Example:
        >>> sphere = ellipsoid_facets([1.0, 1.0, 1.0])
        >>> sphere.areas.shape, round(float(sphere.areas.sum()) / 3.14159265, 6)
        ((1152,), 4.0)
    """
    a, n = _checks.positive("semi_axes", semi_axes, (3,)), _checks.count("rings", rings, 2)
    z, weights = np.polynomial.legendre.leggauss(n)
    angle = np.pi / n * (np.arange(2 * n) + 0.5)
    across = np.sqrt(1 - z * z)
    unit = [np.outer(across, np.cos(angle)), np.outer(across, np.sin(angle)), np.outer(z, np.ones(2 * n))]
    points = (np.stack(unit, axis=-1) * weights[:, None, None] * np.pi / n).reshape(-1, 3)
    return _from_vectors(jnp.asarray(points, a.dtype) * jnp.stack([a[1] * a[2], a[2] * a[0], a[0] * a[1]]))


def box_facets(edges: ArrayLike) -> Facets:
    """The six faces of a box.

    Args:
        edges: the full lengths along x, y and z, (3,), > 0.

    Example:
        >>> box_facets([3.0, 2.0, 1.0]).areas.tolist()
        [2.0, 3.0, 6.0, 2.0, 3.0, 6.0]
    """
    a = _checks.positive("edges", edges, (3,))
    sides = jnp.diag(jnp.stack([a[1] * a[2], a[2] * a[0], a[0] * a[1]]))
    return _from_vectors(jnp.concatenate([sides, -sides]))


def _from_vectors(vectors: Array) -> Facets:
    """The facets of these normals times areas, (F, 3)."""
    areas = jnp.sqrt(jnp.sum(vectors * vectors, axis=1))
    return Facets(vectors / areas[:, None], areas)


def _check_convex(at: np.ndarray, vectors: np.ndarray, triangles: np.ndarray) -> None:
    """ValueError if a facet has no area, or a vertex is clearly above the plane of a facet."""
    size, areas = np.ptp(at, axis=0).max(), np.linalg.norm(vectors, axis=1)
    if not areas.all():
        raise ValueError(f"facet {int(np.argmin(areas))} has no area: leave it out, or merge its vertices")
    normals, each = vectors / areas[:, None], max(1, _AT_ONCE // len(at))
    for first in range(0, len(normals), each):
        part = slice(first, first + each)
        plane = np.einsum("fi,fi->f", normals[part], at[triangles[part, 0]])
        above = (normals[part] @ at.T).max(axis=1) - plane
        if above.max() > _DEPTH * size:
            raise ValueError(
                f"the body must be convex, but vertices are {above.max():.3g} above the plane of facet "
                f"{first + int(np.argmax(above))}: parts of it shade one another, which is left out. Use its convex "
                "hull (scipy.spatial.ConvexHull)"
            )
