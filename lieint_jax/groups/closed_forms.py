"""Power series of matrices whose nonzero eigenvalues are one pair ±λ, in closed form.

On SO(3), SE(3), SL(2), SE(2), the Heisenberg groups and others, λ² = x(ξ) is a quadratic form of ξ, and every X = ξ̂
satisfies Xʲ(X² − x)ᵏ = 0. So every power of X is a combination of the first K = j + 2k, and

    Σ wₙ Xⁿ = Σ_{m<K} c_m(x) Xᵐ

with power series c_m in closed form: Rodrigues' formula, for any such group.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lieint_jax._numerics import power_series
from lieint_jax._numerics import small_linalg as la

_TOLERANCE = 1e-9


class ClosedForm(NamedTuple):
    """The equation Xʲ(X² − x)ᵏ = 0, x = ξ·form ξ, that all matrices X = ξ̂ of an algebra satisfy.

    Attributes:
        form: the matrix of the quadratic form x = λ², (d, d), symmetric; zero if all X are nilpotent.
        nilpotent: j.
        pairs: k.
    """

    form: np.ndarray
    nilpotent: int
    pairs: int

    @property
    def powers(self) -> int:
        """K = j + 2k."""
        return self.nilpotent + 2 * self.pairs

    def square(self, xi: la.Vector) -> la.Scalar:
        """x, the square of the eigenvalue λ of ξ̂."""
        return la.quadratic(self.form, xi)

    def rescaled(self, units: np.ndarray) -> ClosedForm:
        """The closed form by coordinates ξ, if this is that by ξ·units, (d,)."""
        return self._replace(form=self.form * np.outer(units, units))

    def series(self, weights: Sequence[float]) -> list[list[float]]:
        """The coefficients in x of each c_m."""
        found: list[list[float]] = [[] for _ in range(self.powers)]
        annihilator = np.array([1.0])
        for _ in range(self.pairs):
            annihilator = np.convolve(annihilator, [1, -1])
        row = np.eye(self.powers)[0]  # the coefficients a_{nm} of Xⁿ = Σ a_{nm} x^{(n−m)/2} Xᵐ
        for n, weight in enumerate(weights):
            for m in np.flatnonzero(row):
                found[m] += [0.0] * ((n - m) // 2 + 1 - len(found[m]))
                found[m][(n - m) // 2] += weight * row[m]
            top, row = row[-1], np.concatenate([[0.0], row[:-1]])
            for i, factor in enumerate(annihilator[1:], 1):
                row[self.powers - 2 * i] -= top * factor
        return [[float(c) for c in coefficients] for coefficients in found]  # numpy's would widen float32


def evaluated(series: Sequence[float], x: la.Scalar) -> la.Scalar:
    """A power series at x; a Python number if the series is constant."""
    return series[0] if len(series) == 1 else power_series.horner(series, x)


def find(E: np.ndarray, most: int) -> ClosedForm | None:
    """The closed form of the span of matrices E, (d, n, n), with at most `most` powers; None if there is none."""
    form = squared_eigenvalue(E)
    if form is None:
        return None
    xi = np.random.default_rng(1).normal(size=(8, len(E)))
    X, x = np.tensordot(xi, E, 1), np.einsum("ai,ij,aj->a", xi, form, xi)
    one = np.eye(E.shape[1])
    less = X @ X - x[:, None, None] * one
    size = np.abs(X).sum(axis=(1, 2)).max()
    for powers in range(1, most + 1):
        for pairs in range((powers // 2 if form.any() else 0) + 1):
            product = np.broadcast_to(one, X.shape)
            for factor in [X] * (powers - 2 * pairs) + [less] * pairs:
                product = product @ factor
            if np.abs(product).max() <= _TOLERANCE * size**powers:
                return ClosedForm(form, powers - 2 * pairs, pairs)
    return None


def squared_eigenvalue(E: np.ndarray) -> np.ndarray | None:
    """The matrix (d, d) of x = λ², where the nonzero eigenvalues of every ξ̂ are one pair ±λ, or λ alone; else None.

    It is zero if every ξ̂ is nilpotent. With r nonzero eigenvalues, tr X² = rλ², tr X⁴ = rλ⁴, tr X⁶ = rλ⁶.
    """
    d = len(E)
    traces = np.einsum("iab,jba->ij", E, E)
    A = np.tensordot(np.random.default_rng(0).normal(size=(8, d)), E, 1)
    two, four, six = (np.trace(np.linalg.matrix_power(A, k), axis1=1, axis2=2) for k in (2, 4, 6))
    size = np.abs(A).sum(axis=(1, 2)) ** 2
    if np.all(np.abs(two) <= 1e-6 * size) and np.all(np.abs(four) <= 1e-6 * size**2):
        return np.zeros((d, d))
    r = two**2 / np.where(four == 0, np.inf, four)
    count = np.round(r[0])
    if (
        count < 1
        or np.abs(r - count).max() > 1e-4
        or np.abs(six * count**2 - two**3).max() > 1e-4 * np.abs(two**3).max()
    ):
        return None
    return traces / count
