"""The light of a body made of flat facets: diffuse by Lambert's law, with a lobe about the mirror direction.

A facet of area A and normal n in body axes, with s and o the directions to Sun and observer in body axes, sends

    A/π · r(n·s) r(n·o) [diffuse + specular · r(n·h)^exponent],    h = (s + o)/|s + o|,    r(x) = (x + √(x² + ε²))/2

The lobe is Blinn's (1977, Proc. SIGGRAPH, 192). Sun and observer may be exchanged: the light is the same. The ramp r
replaces max(0, x), whose derivative jumps where a facet is seen edge-on. Its width ε is the angular radius of the Sun,
which smears that edge about as much, so the light has all derivatives. A facet that faces away still counts with a
cosine of ε²/4|x|, about 1e-5. Facets do not shade each other: **self-shadowing is left out**.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._keys import Direction, NonNegative, Table
from lieint_jax.groups import so3
from lieint_jax.types import pytree

SUN_RADIUS = 0.00465  # rad, from the Earth
_KEYS = ("area_m2", "diffuse", "specular", "exponent")


class Facet(Table):
    """A row of a table of facets."""

    name: str = ""
    normal: Direction
    """Outward, in body axes, of any length."""
    area_m2: NonNegative
    diffuse: NonNegative
    """Lambert's albedo."""
    specular: NonNegative
    """The height of the lobe, on the scale of `diffuse`."""
    exponent: Annotated[float, Field(ge=1)]
    """The exponent of the lobe's cosine."""


@pytree
class Facets:
    """A table of facets; a thin panel is two facets, back to back."""

    normal: Array  # unit vectors, (facets, 3); the others as in `Facet`, (facets,)
    area: Array
    diffuse: Array
    specular: Array
    exponent: Array


def facets(rows: list[dict[str, Any]]) -> Facets:
    """A table of facets from rows with the keys of `Facet`; ValueError for none, or for a wrong row."""
    if not rows:
        raise ValueError("a body of facets needs at least one facet")
    found = [scenarios.validate(Facet, row, f"facet {row.get('name', k)!r}") for k, row in enumerate(rows)]
    normal = np.array([facet.normal for facet in found])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return Facets(jnp.asarray(normal), *(jnp.array([getattr(facet, key) for facet in found]) for key in _KEYS))


def brightness(body: Facets, q: Array, sun: Array, observer: Array) -> Array:
    """The light of a body toward the observer, relative to a white Lambert facet of π m² lit and seen face-on.

    Args:
        body: the facets of the body.
        q: attitude, a unit quaternion, (4,).
        sun, observer: unit vectors in space from the body, (3,); not opposite to each other.
    """
    s, o = so3.Ad_star(q, sun), so3.Ad_star(q, observer)
    between = s + o
    h = between / jnp.sqrt(jnp.sum(between * between))
    lit, seen, mirrored = (_ramp(jnp.sum(body.normal * v, axis=1)) for v in (s, o, h))
    lobe = body.specular * mirrored**body.exponent
    return jnp.sum(body.area / jnp.pi * lit * seen * (body.diffuse + lobe))


def _ramp(x: Array) -> Array:
    """A smooth max(0, x), positive everywhere, without cancellation for x < 0."""
    root = jnp.sqrt(x * x + SUN_RADIUS**2)
    return jnp.where(x > 0, (x + root) / 2, SUN_RADIUS**2 / (2 * (root - jnp.minimum(x, 0))))


def magnitude(body: Facets, q: Array, sun: Array, observer: Array) -> Array:
    """−2.5 log₁₀ of `brightness`; finite for a closed body at a phase angle below 90°: some facet is lit and seen."""
    return -2.5 * jnp.log10(brightness(body, q, sun, observer))


def axis_rotations() -> np.ndarray:
    """The 24 rotations that permute the body axes up to sign, as matrices with one ±1 in each row, (24, 3, 3).

    The first four are those about the axes by 0 or 180°; the others exchange axes.
    """
    pairs = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    matrices = np.stack([np.diag(signs)[list(order)] for order, signs in pairs])
    return matrices[np.linalg.det(matrices) > 0]


def is_symmetry(body: Facets, rotation: np.ndarray) -> bool:
    """Whether a rotation or reflection of the body, (3, 3), maps its facets to facets that send the same light."""
    normal, area = np.asarray(body.normal), np.asarray(body.area)
    surfaces = np.stack([body.diffuse, body.specular, body.exponent], axis=1)
    for n in np.concatenate([normal, normal @ rotation.T]):
        for surface in surfaces:
            here = area[_equal_rows(normal, n) & _equal_rows(surfaces, surface)].sum()
            there = area[_equal_rows(normal @ rotation.T, n) & _equal_rows(surfaces, surface)].sum()
            if abs(here - there) > 1e-12 * area.sum():
                return False
    return True


def _equal_rows(rows: np.ndarray, row: np.ndarray) -> np.ndarray:
    return np.abs(rows - row).max(axis=1) < 1e-9
