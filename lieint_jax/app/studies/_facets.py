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
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.groups import so3
from lieint_jax.types import pytree

SUN_RADIUS = 0.00465  # rad, from the Earth
_KEYS = ("area_m2", "diffuse", "specular", "exponent")


@pytree
class Facets:
    """A table of facets; a thin panel is two facets, back to back.

    Attributes:
        normal: outward unit normals in body axes, (facets, 3).
        area: m², (facets,).
        diffuse: Lambert's albedo, (facets,).
        specular: the height of the lobe, on the scale of `diffuse`, (facets,).
        exponent: the exponent of the lobe's cosine, (facets,).
    """

    normal: Array
    area: Array
    diffuse: Array
    specular: Array
    exponent: Array


def facets(rows: list[dict[str, Any]]) -> Facets:
    """A table of facets from rows with the keys normal, area_m2, diffuse, specular, exponent, and perhaps name.

    Raises:
        ValueError: there are no rows, a key is missing or unknown, a value is no number, a normal has length 0, a
            number is negative, or an exponent is below 1.
    """
    if not rows:
        raise ValueError("a body of facets needs at least one facet")
    for k, row in enumerate(rows):
        _check(row, f"facet {row.get('name', k)!r}")
    normal = np.array([row["normal"] for row in rows], float)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return Facets(jnp.asarray(normal), *(jnp.array([float(row[key]) for row in rows]) for key in _KEYS))


def _check(row: dict[str, Any], which: str) -> None:
    wrong = (set(row) - {"name"}) ^ {"normal", *_KEYS}
    if wrong:
        raise ValueError(f"{which}: the keys of a facet are normal, {', '.join(_KEYS)}; see {', '.join(sorted(wrong))}")
    try:
        normal, numbers = np.array(row["normal"], float), np.array([row[key] for key in _KEYS], float)
    except (TypeError, ValueError):
        raise ValueError(f"{which}: normal is three numbers, and {', '.join(_KEYS)} are one each") from None
    if normal.shape != (3,) or not np.isfinite(normal).all() or not normal.any():
        raise ValueError(f"{which}: normal must be three numbers, not all 0, got {row['normal']}")
    if not (np.isfinite(numbers).all() and (numbers >= 0).all() and row["exponent"] >= 1):
        given = dict(zip(_KEYS, numbers.tolist(), strict=True))
        raise ValueError(f"{which}: no number may be negative or infinite, nor the exponent less than 1, got {given}")


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
    lit, seen, mirrored = (_ramp(_cosine(body.normal, v)) for v in (s, o, h))
    lobe = body.specular * mirrored**body.exponent
    return jnp.sum(body.area / jnp.pi * lit * seen * (body.diffuse + lobe))


def _ramp(x: Array) -> Array:
    """A smooth max(0, x), positive everywhere, without cancellation for x < 0."""
    root = jnp.sqrt(x * x + SUN_RADIUS**2)
    return jnp.where(x > 0, (x + root) / 2, SUN_RADIUS**2 / (2 * (root - jnp.minimum(x, 0))))


def _cosine(normal: Array, v: Array) -> Array:
    return normal[:, 0] * v[0] + normal[:, 1] * v[1] + normal[:, 2] * v[2]


def magnitude(body: Facets, q: Array, sun: Array, observer: Array) -> Array:
    """−2.5 log₁₀ of `brightness`; finite for a closed body at a phase angle below 90°: some facet is lit and seen."""
    return -2.5 * jnp.log10(brightness(body, q, sun, observer))


def axis_rotations() -> np.ndarray:
    """The 24 rotations that permute the body axes up to sign, as matrices with one ±1 in each row, (24, 3, 3).

    The first four are those about the axes by 0 or 180°; the others exchange axes.
    """
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.diag(signs)[list(order)]
            if np.linalg.det(matrix) > 0:
                rotations.append(matrix)
    return np.stack(rotations)


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
