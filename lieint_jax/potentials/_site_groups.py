"""Points of bodies, in groups of bodies with equally many points, so that few arrays without padding hold them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax.types.shapes import Positions, Rotations

Groups = tuple[tuple[int, ...], ...]
_FEW = 4  # with at most this many bodies, each is its own group


def group_sites(numbers: dict[str, Any], points: Any) -> tuple[Groups, tuple[Array, ...], list[tuple[Array, ...]]]:
    """The groups of bodies; the points (bodies, n, 3) of each group; each of the numbers, (bodies, n) of each group.

    Args:
        numbers: by name, of every point of every body: (N, n), or N arrays (n_i,); (N,) if each body has one point.
        points: in the axes of the body, (N, n, 3), or N arrays (n_i, 3). None: one point each, the center of mass.

    Raises:
        ValueError: shapes disagree.
    """
    rows = {name: _rows(name, given) for name, given in numbers.items()}
    first, *_ = rows.values()
    centers = [jnp.zeros((1, 3), c.dtype) for c in first]
    at = centers if points is None else [_checks.real_array("points", s) for s in points]
    for name, given in rows.items():
        shapes = [c.shape for c in given]
        if shapes != [s.shape[:1] for s in at] or any(s.shape[1:] != (3,) for s in at):
            raise ValueError(
                f"{name} and points must have the same number of bodies and of points in each: got {name} of shapes "
                f"{shapes} and points of shapes {[s.shape for s in at]}"
            )
    n = len(first)
    kinds = list(range(n)) if n <= _FEW else [len(c) for c in first]
    groups = tuple(tuple(i for i in range(n) if kinds[i] == kind) for kind in dict.fromkeys(kinds))
    at, *others = (tuple(jnp.stack([x[i] for i in group]) for group in groups) for x in (at, *rows.values()))
    return groups, at, others


def _rows(name: str, given: Any) -> list[Array]:
    """The numbers of the points of each body; a single number per body belongs to its only point."""
    if not hasattr(given, "__len__") or getattr(given, "ndim", 1) == 0 or not len(given):
        raise ValueError(f"{name} must have an entry for each body, got {given!r}")
    return [jnp.atleast_1d(_checks.real_array(name, c)) for c in given]


def site_positions(points: Array, bodies: tuple[int, ...], x: Positions, R: Rotations) -> Array:
    """The positions in space of the points of a group, (bodies, n, 3), of all positions x and rotations R."""
    if bodies != tuple(range(x.shape[0])):
        x, R = x[np.array(bodies)], R[np.array(bodies)]
    return x[:, None, :] + jnp.sum(R[:, None, :, :] * points[:, :, None, :], axis=3)
