"""The dual basis, the structure constants and the invariant forms of a basis of an algebra, by numpy."""

from __future__ import annotations

import numpy as np

TOLERANCE = 1e-10


def dual_and_structure(E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The dual basis, with tr(DᵢᵀEⱼ) = δᵢⱼ, and the structure constants; ValueError if E is not a basis."""
    d = len(E)
    flat = E.reshape(d, -1)
    size = np.linalg.norm(flat, axis=1)
    if not size.all():
        raise ValueError(f"basis[{int(np.argmin(size))}] is zero: remove it")
    unit = units(E)
    E, flat, size = E / unit[:, None, None], flat / unit[:, None], size / unit
    values = np.linalg.svd(flat / size[:, None], compute_uv=False)
    if d > flat.shape[1] or values[-1] < TOLERANCE * values[0]:
        guilty = next(k for k in range(d) if np.linalg.matrix_rank(flat[: k + 1] / size[: k + 1, None], 1e-10) <= k)
        raise ValueError(f"basis[{guilty}] is a combination of the matrices before it: remove it")
    dual = np.linalg.solve(flat @ flat.T, flat)
    brackets = np.einsum("iab,jbc->ijac", E, E)
    brackets = brackets - brackets.transpose(1, 0, 2, 3)
    c = np.einsum("ijab,kab->ijk", brackets, dual.reshape(E.shape))
    outside = np.abs(brackets - np.einsum("ijk,kab->ijab", c, E)).max(axis=(2, 3))
    outside /= size[:, None] * size
    if outside.max() > TOLERANCE:
        i, j = np.unravel_index(int(np.argmax(outside)), outside.shape)
        raise ValueError(
            f"the bracket of basis[{min(i, j)}] and basis[{max(i, j)}] leaves the span of the basis (by "
            f"{outside.max():.2g} of their sizes): add it, or correct one of the two"
        )
    of_dual, of_c = 1 / unit[:, None], unit[:, None, None] * unit[:, None] / unit
    return _rounded(dual, of_dual).reshape(E.shape), _rounded(c, of_c)


def units(E: np.ndarray) -> np.ndarray:
    """The sizes of the matrices, rounded down to powers of 2, (d,): E over them has the same digits in any units."""
    return 2.0 ** np.floor(np.log2(np.linalg.norm(E, axis=(1, 2))))


def ideals(c: np.ndarray) -> list[list[int]]:
    """The factors of an algebra that is a direct sum along its basis, each by its indices; abelian factors are one.

    Args:
        c: the structure constants, or the matrices ad_eᵢ; shape (d, d, d).
    """
    linked = np.eye(len(c), dtype=bool)
    for i, j, k in zip(*np.nonzero(np.abs(c) > TOLERANCE * np.abs(c).max(initial=1e-300)), strict=True):
        linked[np.ix_([i, j, k], [i, j, k])] = True
    for _ in range(len(c)):
        linked = linked @ linked
    alone = linked.sum(axis=1) == 1
    parts = {tuple(np.flatnonzero(row).tolist()) for row in linked[~alone]}
    return [list(part) for part in sorted(parts)] + [np.flatnonzero(alone).tolist()] * bool(alone.any())


def invariant_forms(E: np.ndarray) -> list[np.ndarray]:
    """A basis of the matrices S with EᵀS + SE = 0 for every E.

    The equations of one E after the other, each for those S that are left: all at once are d n² equations for n²
    unknowns. In a product of groups each E has entries in the rows and columns of one factor only, so its equations
    link the entries of S in one pair of factors, and the null space is found pair by pair.
    """
    n = E.shape[1]
    found = np.eye(n * n).reshape(-1, n, n)
    for e in E:
        change = e.T @ found + found @ e
        found = np.tensordot(null_by_blocks(change.reshape(len(found), n * n).T), found, 1)
    return [round_entries(S / np.abs(S).max()) for S in found]


def algebra(E: np.ndarray) -> np.ndarray:
    """A basis of the span of all products of the matrices E."""
    n = E.shape[1]
    span = E
    while True:
        products = np.concatenate([span, np.einsum("iab,jbc->ijac", span, E).reshape(-1, n, n)])
        flat = products.reshape(len(products), -1)
        used = flat.any(axis=0)  # in a product of groups the entries of its factors only
        _, values, rows = np.linalg.svd(flat[flat.any(axis=1)][:, used], full_matrices=False)
        rows = rows[values > TOLERANCE * values[0]]
        larger = np.zeros((len(rows), n * n))
        larger[:, used] = rows
        larger = larger.reshape(-1, n, n)
        if len(larger) == len(span):
            return larger
        span = larger


def null(M: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """An orthonormal basis of the null space of M, as rows."""
    _, values, rows = np.linalg.svd(M)
    return rows[int(np.sum(values > tolerance * max(1.0, values.max(initial=0)))) :]


def null_by_blocks(M: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """A basis of the null space of M, as rows: block by block, since M has few entries and its SVD is slow."""
    rows, columns = np.nonzero(np.abs(M) > tolerance)
    block, last = np.arange(M.shape[1]), np.zeros(0)  # each column with the first one that is linked to it by rows
    while not np.array_equal(block, last):
        last, first = block.copy(), np.full(len(M), M.shape[1])
        np.minimum.at(first, rows, block[columns])
        np.minimum.at(block, columns, first[rows])
    found = [np.zeros((0, M.shape[1]))]
    for label in np.unique(block):
        inside = block == label
        vectors = null(M[np.ix_(np.unique(rows[inside[columns]]), inside)], tolerance)
        found.append(np.zeros((len(vectors), M.shape[1])))
        found[-1][:, inside] = vectors
    return np.concatenate(found)


def round_entries(x: np.ndarray, tolerance: float | np.ndarray | None = None) -> np.ndarray:
    """x with entries near a multiple of 1/12, by default within round-off, set to it, so that 0 and 1 are exact."""
    near = np.round(12 * x) / 12
    least = 1e-14 * max(1.0, np.abs(x).max()) if tolerance is None else tolerance
    return np.where(np.abs(x - near) < least, near, x)


def _rounded(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x in these units, its entries rounded as in `round_entries`, by the rounding errors that they have in them."""
    return round_entries(x * unit, 1e-14 * max(1.0, np.abs(x).max()) * unit)


def freeze(x: np.ndarray) -> np.ndarray:
    x = np.array(x, float)
    x.flags.writeable = False
    return x
