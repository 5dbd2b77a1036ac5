"""Sums over members whose bits do not depend on the parts in which they were computed.

The members are the leaves of a binary tree: a block of 2ᵏ members that begins at a multiple of 2ᵏ has the sum of its
two halves. Any range of members is a row of such blocks, and the sums of adjacent ranges merge to those of their union.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def blocks(first: int, stop: int) -> list[tuple[int, int]]:
    """The largest blocks (start, size) that make up the members first … stop − 1."""
    found = []
    while first < stop:
        size = 1 << ((stop - first).bit_length() - 1)
        if first:
            size = min(size, first & -first)
        found.append((first, size))
        first += size
    return found


def block_sums(x: np.ndarray, first: int = 0) -> np.ndarray:
    """The sums over blocks of members, (rows, blocks), of the rows (rows, members) of the members from `first` on."""
    sums = []
    for start, size in blocks(first, first + x.shape[1]):
        part = x[:, start - first : start - first + size]
        while part.shape[1] > 1:
            part = part[:, ::2] + part[:, 1::2]
        sums.append(part)
    return np.concatenate(sums, axis=1)


def total(parts: Iterable[tuple[range, np.ndarray]]) -> np.ndarray:
    """The sums over all members, (rows,), from adjacent ranges of members, in order, and their `block_sums`."""
    merged: list[tuple[int, int, np.ndarray]] = []
    for members, sums in parts:
        for k, (start, size) in enumerate(blocks(members.start, members.stop)):
            merged.append((start, size, sums[:, k]))
            while len(merged) > 1 and merged[-2][1] == merged[-1][1] and merged[-2][0] % (2 * merged[-1][1]) == 0:
                (start_, size_, a), (_, _, b) = merged[-2:]
                merged[-2:] = [(start_, 2 * size_, a + b)]
    found = merged.pop()[2]
    while merged:
        found = merged.pop()[2] + found
    return found
