"""The tableaux of Gauss–Legendre collocation."""

from __future__ import annotations

import numpy as np


def gauss(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes c, (s,), matrix A, (s, s), and weights b, (s,), on [0, 1]: A_ij integrates ℓ_j up to the node c_i."""
    c = nodes(stages)
    return c, integrals(stages, c), np.polynomial.legendre.leggauss(stages)[1] / 2


def nodes(stages: int) -> np.ndarray:
    """The nodes on [0, 1], (s,)."""
    return (np.polynomial.legendre.leggauss(stages)[0] + 1) / 2


def integrals(stages: int, points: np.ndarray) -> np.ndarray:
    """∫ℓ_j from 0 to each point, (points, s), with ℓ the Lagrange polynomials of the nodes on [0, 1]."""
    y, k = 2 * np.asarray(points) - 1, np.arange(1, stages)
    at = np.polynomial.legendre.legvander(y, stages)
    whole = np.column_stack([(y + 1) / 2, (at[:, 2:] - at[:, :-2]) / (2 * (2 * k + 1))])
    return whole @ _coefficients(stages)


def values(stages: int, points: np.ndarray) -> np.ndarray:
    """ℓ_j at each point, (points, s)."""
    return np.polynomial.legendre.legvander(2 * np.asarray(points) - 1, stages - 1) @ _coefficients(stages)


def _coefficients(stages: int) -> np.ndarray:
    """Those of ℓ_j in Legendre's polynomials, (s, s), by their discrete orthogonality, without a linear solve."""
    x, w = np.polynomial.legendre.leggauss(stages)
    P = np.polynomial.legendre.legvander(x, stages - 1)
    return (2 * np.arange(stages) + 1)[:, None] / 2 * w * P.T
