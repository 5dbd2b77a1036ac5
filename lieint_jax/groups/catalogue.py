"""Matrix groups by name, each built by `groups.matrix` from a basis that its docstring states."""

from __future__ import annotations

import itertools

import numpy as np

from lieint_jax import _checks
from lieint_jax.groups._matrix import MatrixGroup, matrix


def special_orthogonal(n: int) -> MatrixGroup:
    """Rotations of ℝⁿ, dimension n(n−1)/2. For n = 3 the basis is that of `so3.hat`, so ξ̂h = ξ × h.

    Otherwise it is e_i e_jᵀ − e_j e_iᵀ for i < j, in the order (0,1), (0,2), …
    """
    n = _checks.count("n", n, 2)
    return matrix(_rotations(n), f"SO({n})")


def special_euclidean(n: int) -> MatrixGroup:
    """Motions of ℝⁿ as (n+1, n+1) matrices [[R, x], [0, 1]]: the basis of SO(n), then translations."""
    n = _checks.count("n", n, 2)
    rotations = [_frame(E, n + 1) for E in _rotations(n)]
    return matrix([*rotations, *(_unit(n + 1, i, n) for i in range(n))], f"SE({n})")


def special_unitary(n: int) -> MatrixGroup:
    """Unitary n×n matrices of determinant 1, dimension n² − 1, as real matrices of size 2n.

    The basis is −i/2 times the Pauli matrices for n = 2, so that brackets are cross products, and −i/2 times the
    generalized Gell-Mann matrices for larger n.
    """
    n = _checks.count("n", n, 2)
    hermitian = []
    for i, j in itertools.combinations(range(n), 2):
        hermitian += [_unit(n, i, j) + _unit(n, j, i), -1j * _unit(n, i, j) + 1j * _unit(n, j, i)]
    for k in range(1, n):
        diagonal = np.diag([1.0] * k + [-k] + [0.0] * (n - k - 1))
        hermitian.append(diagonal * np.sqrt(2 / (k * (k + 1))))
    return matrix([-0.5j * S for S in hermitian], f"SU({n})")


def special_linear(n: int) -> MatrixGroup:
    """Real n×n matrices of determinant 1, dimension n² − 1: e_i e_jᵀ for i ≠ j, then diag(…, 1, −1, …)."""
    n = _checks.count("n", n, 2)
    off = [_unit(n, i, j) for i, j in itertools.permutations(range(n), 2)]
    return matrix([*off, *(_unit(n, i, i) - _unit(n, i + 1, i + 1) for i in range(n - 1))], f"SL({n})")


def symplectic(n: int) -> MatrixGroup:
    """Real symplectic matrices of size n, which is even; dimension n(n+1)/2: qᵀJq = J with J = [[0, 1], [−1, 0]]."""
    n = _checks.count("n", n, 2)
    if n % 2:
        raise ValueError(f"n is the size of the matrices and must be even, got {n}")
    m = n // 2
    pairs = list(itertools.combinations_with_replacement(range(m), 2))
    blocks = [_unit(n, i, j) - _unit(n, m + j, m + i) for i, j in itertools.product(range(m), repeat=2)]
    above = [_symmetric(n, i, m + j, j, m + i) for i, j in pairs]
    below = [_symmetric(n, m + i, j, m + j, i) for i, j in pairs]
    return matrix([*blocks, *above, *below], f"Sp({n})")


def affine(n: int) -> MatrixGroup:
    """x ↦ Ax + b on ℝⁿ with det A > 0, dimension n² + n, as (n+1, n+1) matrices: e_i e_jᵀ, then translations."""
    n = _checks.count("n", n, 1)
    linear = [_unit(n + 1, i, j) for i, j in itertools.product(range(n), repeat=2)]
    return matrix([*linear, *(_unit(n + 1, i, n) for i in range(n))], f"Aff({n})")


def heisenberg(n: int) -> MatrixGroup:
    """The Heisenberg group, dimension 2n+1: matrices [[1, a, c], [0, 1, b], [0, 0, 1]]; basis a, b, c, [aᵢ, bᵢ] = c."""
    n = _checks.count("n", n, 1)
    a, b = ([_unit(n + 2, 0, i + 1) for i in range(n)], [_unit(n + 2, i + 1, n + 1) for i in range(n)])
    return matrix([*a, *b, _unit(n + 2, 0, n + 1)], f"Heis({2 * n + 1})")


def hyperbolic_motions() -> MatrixGroup:
    """E(1,1), motions of the Minkowski plane: boost e₀e₁ᵀ + e₁e₀ᵀ, then translations. Bianchi VI₀."""
    return matrix([_unit(3, 0, 1) + _unit(3, 1, 0), _unit(3, 0, 2), _unit(3, 1, 2)], "E(1,1)")


def upper_triangular(n: int) -> MatrixGroup:
    """Upper-triangular n×n matrices with positive diagonal, dimension n(n+1)/2: e_i e_jᵀ for i ≤ j."""
    n = _checks.count("n", n, 1)
    return matrix([_unit(n, i, j) for i, j in itertools.combinations_with_replacement(range(n), 2)], f"T({n})")


def translations(n: int) -> MatrixGroup:
    """The abelian group ℝⁿ as (n+1, n+1) matrices [[1, x], [0, 1]]."""
    n = _checks.count("n", n, 1)
    return matrix([_unit(n + 1, i, n) for i in range(n)], f"R^{n}")


def product(g: MatrixGroup, h: MatrixGroup) -> MatrixGroup:
    """The direct product of two matrix groups, as blocks of one matrix: the basis of `g`, then that of `h`."""
    for group in (g, h):
        if not isinstance(group, MatrixGroup):
            raise ValueError(f"product needs two matrix groups, got {group!r}")
    n = g.size + h.size
    first = [_frame(E, n) for E in g.basis]
    return matrix([*first, *(_frame(E, n, g.size) for E in h.basis)], f"{g.name} x {h.name}")


def examples() -> dict[str, MatrixGroup]:
    """One or more groups of each kind."""
    groups = [
        special_orthogonal(3),
        special_orthogonal(4),
        special_unitary(2),
        special_euclidean(2),
        special_euclidean(3),
        special_linear(2),
        special_linear(3),
        symplectic(4),
        affine(1),
        heisenberg(1),
        heisenberg(2),
        hyperbolic_motions(),
        upper_triangular(3),
        translations(3),
        product(special_orthogonal(3), affine(1)),
    ]
    return {group.name: group for group in groups}


def _unit(n: int, i: int, j: int) -> np.ndarray:
    E = np.zeros((n, n))
    E[i, j] = 1
    return E


def _rotations(n: int) -> list[np.ndarray]:
    if n == 3:
        return [_unit(3, j, i) - _unit(3, i, j) for i, j in ((1, 2), (2, 0), (0, 1))]
    sign = -1 if n == 2 else 1  # the rotation of the plane turns counter-clockwise
    return [sign * (_unit(n, i, j) - _unit(n, j, i)) for i, j in itertools.combinations(range(n), 2)]


def _symmetric(n: int, i: int, j: int, k: int, m: int) -> np.ndarray:
    E = _unit(n, i, j)
    return E if (i, j) == (k, m) else E + _unit(n, k, m)


def _frame(E: np.ndarray, n: int, at: int = 0) -> np.ndarray:
    """E as a diagonal block of an n×n matrix."""
    M = np.zeros((n, n))
    M[at : at + len(E), at : at + len(E)] = E
    return M
