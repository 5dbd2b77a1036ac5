"""Linear equations of a chain, each of whose n links acts only on itself and on the links before and after it.

The matrix has n rows of blocks (k, k) on three diagonals. It is factored by cyclic reduction: the links of odd numbers
are eliminated, all at once, and what remains is a chain of half as many. So it needs O(n) operations in O(log n)
passes over arrays. Within a block elimination is without pivoting, as in `small_linalg.factored`: for matrices whose
symmetric part is positive definite, or near such matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from lieint_jax._numerics.small_linalg import Factored


class BlockTridiagonal(NamedTuple):
    """The blocks of a matrix: those at (i, i − 1), (i, i) and (i, i + 1), each (n, k, k); two of them are zero."""

    lower: Array
    diagonal: Array
    upper: Array

    @classmethod
    def of(cls, linear: Callable[[Array], Array], n: int, k: int, dtype: DTypeLike) -> BlockTridiagonal:
        """The matrix of a linear function of arrays (n, k), by its values at up to 3k of them.

        Every third link is moved at once: no link feels two of them. If distant links act on one another too, the
        blocks are only near those of the function.
        """
        link, every = np.arange(n), min(n, 3)
        seeds = (link % every == np.arange(every)[:, None])[:, None, :, None] * np.eye(k)[:, None, :]  # (3, k, n, k)
        seeds = jnp.asarray(seeds.reshape(every * k, n, k), dtype)
        one_by_one, all_at_once = partial(lax.map, linear), jax.vmap(linear)  # on a CPU 3 times as fast for 128 links
        moved = lax.platform_dependent(seeds, cpu=one_by_one, default=all_at_once).reshape(every, k, n, k)
        lower, diagonal, upper = (jnp.swapaxes(moved[(link + s) % every, :, link], 1, 2) for s in (-1, 0, 1))
        first, last = (jnp.asarray(link == end)[:, None, None] for end in (0, n - 1))
        return cls(jnp.where(first, 0, lower), diagonal, jnp.where(last, 0, upper))


class _Level(NamedTuple):
    """One level of the reduction, with B the blocks of the m eliminated links.

    Attributes:
        inverse: B⁻¹, (m, k, k).
        before, after: B⁻¹ times the blocks of the links before and after an eliminated link, (m, k, k).
        lower, upper: the blocks by which the eliminated links act on the remaining ones after and before them.
    """

    inverse: Array
    before: Array
    after: Array
    lower: Array
    upper: Array


def factored(K: BlockTridiagonal) -> Factored:
    """K, factored."""
    levels, positive = [], jnp.ones((), bool)
    while K.diagonal.shape[0] > 1:
        lower, diagonal, upper = K
        odd = [block[1::2] for block in K]
        k, m = diagonal.shape[1], odd[1].shape[0]
        one = jnp.broadcast_to(jnp.eye(k, dtype=diagonal.dtype), odd[1].shape)
        solved, good = _eliminated(odd[1], jnp.concatenate([odd[0], odd[2], one], axis=2))
        before, after, inverse = solved[:, :, :k], solved[:, :, k : 2 * k], solved[:, :, 2 * k :]
        lower, upper = lower[2::2], upper[: 2 * m : 2]
        levels.append(_Level(inverse, before, after, lower, upper))
        positive &= good
        even = -(-diagonal.shape[0] // 2)
        left = [_product(lower, block[: lower.shape[0]]) for block in (before, after)]
        right = [_product(upper, block) for block in (before, after)]
        K = BlockTridiagonal(
            -_placed(left[0], 1, even),
            diagonal[::2] - _placed(left[1], 1, even) - _placed(right[0], 0, even),
            -_placed(right[1], 0, even),
        )
    k = K.diagonal.shape[1]
    last, good = _eliminated(K.diagonal, jnp.eye(k, dtype=K.diagonal.dtype)[None])
    return Factored(partial(_solve, tuple(levels), last), positive & good)


def _solve(levels: tuple[_Level, ...], last: Array, b: Array) -> Array:
    """K⁻¹b, (n, k), by the levels of the reduction and the inverse of the block of the last link."""
    if not levels:
        return _times(last, b)
    level, even = levels[0], b[::2]
    y = _times(level.inverse, b[1::2])
    acting = _placed(_times(level.lower, y[: level.lower.shape[0]]), 1, len(even))
    x = _solve(levels[1:], last, even - acting - _placed(_times(level.upper, y), 0, len(even)))
    odd = y - _times(level.before, x[: len(y)]) - _times(level.after, _padded(x[1:], len(y)))
    pairs = jnp.stack([x[: len(y)], odd], axis=1).reshape(-1, b.shape[1])
    return pairs if len(even) == len(y) else jnp.concatenate([pairs, x[-1:]])


def _eliminated(B: Array, right: Array) -> tuple[Array, Array]:
    """B⁻¹ times right, for blocks (m, k, k) and (m, k, r), by Gauss and Jordan; whether all pivots were positive."""
    k = B.shape[1]

    def eliminate(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        M, positive = carry
        row, column = (lax.dynamic_slice_in_dim(M, i, 1, axis) for axis in (1, 2))
        pivot = lax.dynamic_slice_in_dim(row, i, 1, 2)
        row = row / pivot
        return jnp.where((jnp.arange(k) == i)[:, None], row, M - column * row), positive & jnp.all(pivot > 0)

    start = jnp.concatenate([B, right], axis=2), jnp.ones((), bool)
    M, positive = lax.fori_loop(0, k, eliminate, start)  # a loop compiles 4 times as fast as its passes written out
    return M[:, :, k:], positive


def _product(A: Array, B: Array) -> Array:
    return jnp.sum(A[:, :, :, None] * B[:, None], axis=2)


def _times(A: Array, v: Array) -> Array:
    return jnp.sum(A * v[:, None], axis=2)


def _placed(x: Array, start: int, length: int) -> Array:
    """x with zeros before and after it, `length` rows."""
    return jnp.pad(x, ((start, length - start - len(x)),) + ((0, 0),) * (x.ndim - 1))


def _padded(x: Array, length: int) -> Array:
    return _placed(x[:length], 0, length)
