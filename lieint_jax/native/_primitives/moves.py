"""Primitives that only move entries: NumPy does it while the program is written, and the program has nothing of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lieint_jax.native._primitives.abstract_walk import array_of


def _broadcast_in_dim(x: np.ndarray, *, shape: Sequence[int], broadcast_dimensions: Sequence[int]) -> np.ndarray:
    sizes = [1] * len(shape)
    for axis, n in zip(broadcast_dimensions, x.shape, strict=True):
        sizes[axis] = n
    return np.broadcast_to(x.reshape(sizes), shape)


def _slice(
    x: np.ndarray, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None = None
) -> np.ndarray:
    return x[tuple(itertools.starmap(slice, zip(start_indices, limit_indices, strides or (1,) * x.ndim, strict=True)))]


def _pad(x: np.ndarray, value: np.ndarray, padding_config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    shape = [lo + hi + max(n + (n - 1) * gap, 0) for n, (lo, hi, gap) in zip(x.shape, padding_config, strict=True)]
    found = array_of([value.item()] * int(np.prod(shape)), shape)
    places = [lo + np.arange(n) * (gap + 1) for n, (lo, _, gap) in zip(x.shape, padding_config, strict=True)]
    inside = [(at >= 0) & (at < n) for at, n in zip(places, shape, strict=True)]
    found[np.ix_(*(at[which] for at, which in zip(places, inside, strict=True)))] = x[np.ix_(*inside)]
    return found


def stack(*arrays: np.ndarray, axis: int = 0) -> np.ndarray:
    """Arrays along a new axis."""
    return np.concatenate([np.expand_dims(x, axis) for x in arrays], axis)


def _reshape(x: np.ndarray, new_sizes: Sequence[int], dimensions: Sequence[int] | None = None) -> np.ndarray:
    return (x if dimensions is None else x.transpose(dimensions)).reshape(new_sizes)


def _unstack(x: np.ndarray, axis: int) -> list[np.ndarray]:
    return [array_of(list(y.flat), y.shape) for y in (x.take([k], axis).squeeze(axis) for k in range(x.shape[axis]))]


MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, dimensions),
    "pad": _pad,
    "reshape": _reshape,
    "reshard": lambda x, dst_sharding: x,
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "stack": stack,
    "tile": lambda x, reps: np.tile(x, reps),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "unstack": _unstack,
}
