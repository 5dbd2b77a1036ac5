"""Linear equations of a chain, each of whose n links acts only on itself and on the links before and after it.

The matrix has n rows of blocks (k, k) on three diagonals. It is factored by cyclic reduction: the links of odd numbers
are eliminated, all at once, and what remains is a chain of half as many. So it needs O(n) operations in O(log n)
passes over arrays. A few remaining links are eliminated one after another. Within a block elimination is without
pivoting, as in `small_linalg.factored`: for matrices whose symmetric part is positive definite, or near such matrices.
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

_FEW = 12  # links that are eliminated one after another


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
        every = min(n, 3)
        link, colors = np.arange(n)[:, None], np.arange(every)
        neighbors = [(link + s) % every == colors for s in (-1, 0, 1)]  # which of the moved links, (n, every)

        @partial(jax.jit, inline=True)  # for both platforms traced once
        def columns(c: Array) -> list[Array]:
            """A column of each block, (n, k)."""
            seeds = jnp.where((jnp.arange(k) == c)[None, :, None] & neighbors[1][:, None], jnp.ones((), dtype), 0)
            moved = jax.vmap(linear, -1, -1)(seeds)  # (n, k, every)
            return [jnp.sum(jnp.where(which[:, None], moved, 0), axis=2) for which in neighbors]

        one_by_one, all_at_once = partial(lax.map, columns), jax.vmap(columns)  # on a CPU faster
        found = lax.platform_dependent(jnp.arange(k), cpu=one_by_one, default=all_at_once)
        lower, diagonal, upper = (jnp.moveaxis(block, 0, 2) for block in found)
        first, last = (jnp.asarray(link == end)[:, :, None] for end in (0, n - 1))
        return cls(jnp.where(first, 0, lower), diagonal, jnp.where(last, 0, upper))


class _Level(NamedTuple):
    """One level of the reduction, with B the blocks (m, k, k) of the m eliminated links."""

    inverse: Array  # B⁻¹
    before: Array  # B⁻¹ times the blocks of the links before
    after: Array  # and after an eliminated link
    lower: Array  # the blocks by which the eliminated links act on the remaining ones after
    upper: Array  # and before them


class _Sweep(NamedTuple):
    """The elimination of links one after another, with B their blocks when those before are eliminated, (m, k, k)."""

    inverse: Array  # B⁻¹
    after: Array  # B⁻¹ times the blocks of the links after them
    lower: Array  # the blocks by which the links before act on them


def factored(K: BlockTridiagonal) -> Factored:
    """K, factored."""
    levels, positive = [], jnp.ones((), bool)
    while K.diagonal.shape[0] > _FEW:
        lower, diagonal, upper = K
        odd = [block[1::2] for block in K]
        m = odd[1].shape[0]
        (before, after, inverse), good = _eliminated(odd[1], odd[0], odd[2])
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

    def next_link(before: Array, blocks: BlockTridiagonal) -> tuple[Array, tuple[Array, Array, Array]]:
        lower, diagonal, upper = (block[None] for block in blocks)
        (after, inverse), good = _eliminated(diagonal - _product(lower, before), upper)
        return after, (inverse[0], after[0], good)

    _, (inverse, after, good) = lax.scan(next_link, jnp.zeros_like(K.diagonal[:1]), K)
    return Factored(partial(_solve, tuple(levels), _Sweep(inverse, after, K.lower)), positive & jnp.all(good))


def _solve(levels: tuple[_Level, ...], last: _Sweep, b: Array) -> Array:
    """K⁻¹b, (n, k), by the levels of the reduction and the elimination of the remaining links."""
    if not levels:
        return _swept(last, b)
    level, even = levels[0], b[::2]
    y = _times(level.inverse, b[1::2])
    acting = _placed(_times(level.lower, y[: level.lower.shape[0]]), 1, len(even))
    x = _solve(levels[1:], last, even - acting - _placed(_times(level.upper, y), 0, len(even)))
    odd = y - _times(level.before, x[: len(y)]) - _times(level.after, _placed(x[1 : 1 + len(y)], 0, len(y)))
    pairs = jnp.stack([x[: len(y)], odd], axis=1).reshape(-1, b.shape[1])
    return pairs if len(even) == len(y) else jnp.concatenate([pairs, x[-1:]])


def _swept(links: _Sweep, b: Array) -> Array:
    """The solution for the links of a sweep, from the first to the last, and back."""

    def forward(before: Array, row: tuple[_Sweep, Array]) -> tuple[Array, Array]:
        link, b = row
        y = _times(link.inverse[None], b[None] - _times(link.lower[None], before))
        return y, y[0]

    def back(x: Array, row: tuple[_Sweep, Array]) -> tuple[Array, Array]:
        x = row[1][None] - _times(row[0].after[None], x)
        return x, x[0]

    none = jnp.zeros_like(b[:1])
    _, y = lax.scan(forward, none, (links, b))
    return lax.scan(back, none, (links, y), reverse=True)[1]


def _eliminated(B: Array, *right: Array) -> tuple[list[Array], Array]:
    """B⁻¹ times each of `right`, and B⁻¹, all (m, k, k), by Gauss and Jordan; whether all pivots were positive."""
    k = B.shape[1]
    one = jnp.broadcast_to(jnp.eye(k, dtype=B.dtype), B.shape)

    def eliminate(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        M, positive = carry
        row, column = (lax.dynamic_slice_in_dim(M, i, 1, axis) for axis in (1, 2))
        pivot = lax.dynamic_slice_in_dim(row, i, 1, 2)
        row = row / pivot
        return jnp.where((jnp.arange(k) == i)[:, None], row, M - column * row), positive & (pivot > 0)

    start = jnp.concatenate([B, *right, one], axis=2), jnp.ones((len(B), 1, 1), bool)
    M, positive = lax.fori_loop(0, k, eliminate, start)  # a loop compiles 4 times as fast as its passes written out
    return jnp.split(M, len(right) + 2, axis=2)[1:], jnp.all(positive)


def _product(A: Array, B: Array) -> Array:
    return jnp.sum(A[:, :, :, None] * B[:, None], axis=2)


def _times(A: Array, v: Array) -> Array:
    return jnp.sum(A * v[:, None], axis=2)


def _placed(x: Array, start: int, length: int) -> Array:
    """x with zeros before and after it, `length` rows."""
    return jnp.pad(x, ((start, length - start - len(x)),) + ((0, 0),) * (x.ndim - 1))
