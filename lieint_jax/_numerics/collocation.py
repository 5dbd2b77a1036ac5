"""The tableau of Gauss–Legendre collocation."""

from __future__ import annotations

import numpy as np


def gauss(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes c, (s,), matrix A, (s, s), and weights b, (s,), on [0, 1]: A_ij integrates ℓ_j up to the node c_i.

    By the discrete orthogonality of the Legendre polynomials, without a linear solve.
    """
    x, w = np.polynomial.legendre.leggauss(stages)
    P = np.polynomial.legendre.legvander(x, stages)
    k = np.arange(1, stages)
    integrals = np.column_stack([(x + 1) / 2, (P[:, 2:] - P[:, :-2]) / (2 * (2 * k + 1))])
    A = integrals @ ((2 * np.arange(stages) + 1)[:, None] / 2 * w * P[:, :-1].T)
    return (x + 1) / 2, A, w / 2
