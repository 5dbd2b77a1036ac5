"""Casimirs: functions of body momentum that are constant on coadjoint orbits, so along every motion on the group.

A homogeneous polynomial of degree n is Σ cₐ μ_i…μ_j over monomials a: indices (m, n), each row ascending, and
coefficients c, one row (m,) for each of several polynomials. Its bracket with every μ_i is linear in c, so that the
Casimirs of each degree are a null space.

Source: Beltrametti & Blasi, Phys. Lett. 20 (1966) 62 (their number); Patera, Sharp, Winternitz & Zassenhaus,
J. Math. Phys. 17 (1976) 986 (those of all real algebras of dimension up to five).
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from lieint_jax.groups.bases import null_by_blocks, round_entries

_TOLERANCE = 1e-9
_DEGREE, _MONOMIALS = 4, 1000  # the highest degree, and the most monomials of one degree: these need about a second


def corank(structure: np.ndarray) -> int:
    """The corank of the Poisson tensor Σ c_ijk μ_k at a generic μ, the number of independent Casimirs of any kind."""
    return len(structure) - int(np.linalg.matrix_rank(structure @ _point(structure), rtol=_TOLERANCE))


def independent(structure: np.ndarray, size: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Functionally independent polynomial Casimirs, lowest degrees first.

    Args:
        structure: of the basis Eᵢ/|Eᵢ|, which makes the null spaces independent of units, (d, d, d).
        size: |Eᵢ|, (d,). The Casimirs are in the coordinates ⟨μ, Eᵢ⟩.

    Returns:
        monomials (m, n) and coefficients (k, m) of the k Casimirs of each degree n that has any.
    """
    point, d, needed = _point(structure), len(structure), corank(structure)
    gradients, found = np.zeros((0, d)), []
    for degree in range(1, _DEGREE + 1):
        if len(gradients) == needed or math.comb(d + degree - 1, degree) > _MONOMIALS:
            break
        monomials, rows = _invariants(structure, degree)
        kept = []
        for row in rows:
            shifted = point + 1e-30j * np.eye(d)  # a derivative without cancellation, by a complex step
            gradient = (np.prod(shifted[:, monomials], axis=2) @ row).imag
            gradient /= np.linalg.norm(gradient)
            more = np.vstack([gradients, gradient])
            invariant = np.abs(structure @ point @ gradient).max() < _TOLERANCE  # not in a basis far from orthogonal
            if invariant and np.linalg.matrix_rank(more, rtol=_TOLERANCE) == len(more):
                row = row / np.prod(size[monomials], axis=1)
                gradients, kept = more, [*kept, row / row[np.argmax(row != 0)]]
        if kept:
            used = np.any(kept, axis=0)
            rows = np.array(kept)[:, used]
            near = round_entries(rows, _TOLERANCE)
            found.append((monomials[used], np.where(np.abs(rows - near) < _TOLERANCE * np.abs(rows), near, rows)))
    return found


def _point(structure: np.ndarray) -> np.ndarray:
    """A generic μ."""
    return np.random.default_rng(0).normal(size=len(structure))


def _invariants(structure: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """All monomials of a degree, and the coefficients of a basis of its Casimirs."""
    d = len(structure)
    monomials = np.array(list(itertools.combinations_with_replacement(range(d), degree)))
    place = d ** np.arange(degree)[::-1]
    replaced = np.tile(monomials, (degree, d, 1, 1))  # by factor and by the index that replaces it
    for n in range(degree):
        replaced[n, :, :, n] = np.arange(d)[:, None]
    rows = np.searchsorted(monomials @ place, np.sort(replaced) @ place)
    columns, factors = np.arange(len(monomials)), monomials.T[:, None]
    found = np.eye(len(monomials))
    for c in structure:
        bracket = np.zeros((len(monomials), len(monomials)))  # μ_j ↦ Σ c_jk μ_k in each factor
        np.add.at(bracket, (rows, columns), c[factors, np.arange(d)[:, None]])
        found = null_by_blocks(bracket @ found.T, _TOLERANCE) @ found
    return monomials, _echelon(found)


def _echelon(rows: np.ndarray) -> np.ndarray:
    """The reduced echelon form of independent rows, which makes as many entries as possible 0 or 1."""
    rows = rows.copy()
    for k, _ in enumerate(rows):
        size = np.abs(rows[k:]) > _TOLERANCE
        column = int(np.argmax(size.any(axis=0)))
        best = k + int(np.argmax(np.abs(rows[k:, column])))
        rows[[k, best]] = rows[[best, k]]
        rows[k] /= rows[k, column]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, column] * rows[k]
    return round_entries(rows, _TOLERANCE)
