"""Casimirs: functions of body momentum that are constant on coadjoint orbits, so along every motion on the group."""

from __future__ import annotations

import numpy as np

from lieint_jax.groups.bases import null, round_entries

_TOLERANCE = 1e-9


def linear(structure: np.ndarray) -> np.ndarray:
    """A basis of the λ with ⟨ad*_ξ μ, λ⟩ = 0 for all ξ and μ, rows (k, d): the center of the algebra."""
    return _echelon(null(structure.transpose(0, 2, 1).reshape(-1, len(structure)), _TOLERANCE))


def quadratic(structure: np.ndarray) -> np.ndarray:
    """A basis of the symmetric Q with ⟨ad*_ξ μ, Qμ⟩ = 0, (k, d, d), without products of linear Casimirs."""
    d = len(structure)
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    symmetric = np.zeros((len(pairs), d, d))
    for k, (i, j) in enumerate(pairs):
        symmetric[k, i, j] = symmetric[k, j, i] = 1 if i == j else 0.5
    turned = np.einsum("kab,icb->kiac", symmetric, structure.transpose(0, 2, 1))  # Q ad_ξᵀ
    rates = (turned + turned.transpose(0, 1, 3, 2)).reshape(len(pairs), -1)
    central = linear(structure)
    products = [_coordinates(np.outer(x, y), pairs) for n, x in enumerate(central) for y in central[n:]]
    kept, rank = list(products), len(products)
    found = []
    for row in _echelon(null(rates.T, _TOLERANCE)):
        if np.linalg.matrix_rank([*kept, row], _TOLERANCE) > rank:
            kept.append(row)
            found.append(row)
            rank += 1
    return np.tensordot(np.array(found).reshape(-1, len(pairs)), symmetric, 1)


def _coordinates(Q: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    return np.array([Q[i, j] if i == j else Q[i, j] + Q[j, i] for i, j in pairs])


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
