"""The results that a store has published, read lazily."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lieint_jax.core import StepInfo, Trajectory
from lieint_jax.runs._dyadic_sum import blocks, total
from lieint_jax.runs._storage.arrays import StoredArray, first_of
from lieint_jax.runs._storage.leaves import Saves, Table, states_in
from lieint_jax.runs._storage.untrusted import UnreadableError
from lieint_jax.runs.store._root import PartState, Root


class PublishedArray:
    """An array of a store, (time, member, …), read where it is indexed; it is NaN where nothing is published.

    Flags are False there, and counts −1. It has the attributes and the indexing of an array of NumPy.

    Args:
        array: the whole array.
        entries, members: those that are shown.
        parts: the first member of each part, and its number of published entries.

    Attributes:
        dtype, shape: those of the array.
    """

    def __init__(self, array: StoredArray, entries: int, members: range, parts: list[tuple[int, int]]) -> None:
        self._array, self._members, self._parts = array, members, parts
        self.dtype = array.meta.dtype
        self.shape = (entries, len(members), *array.meta.shape[2:])

    @property
    def ndim(self) -> int:
        """The number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """The number of values."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """The number of bytes of all values."""
        return self.size * self.dtype.itemsize

    @property
    def published(self) -> np.ndarray:
        """Whether a value is published, for each entry and member."""
        return self._published(np.arange(self.shape[0]), np.arange(self.shape[1]) + self._members.start)

    @property
    def first_published(self) -> int:
        """The first member with entries; 0 if there is none."""
        found = [start for start, entries in self._parts if entries]
        return found[0] - self._members.start if found else 0

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self[...], dtype)

    def __getitem__(self, index: Any) -> np.ndarray:
        index = _expand_index(index if isinstance(index, tuple) else (index,), self.ndim)
        times, members = index[0], index[1]
        if any(x is None or np.ndim(x) > 1 for x in index[:2]):
            raise IndexError("the first two indices must be integers, slices or lists of integers")
        t, m = np.arange(self.shape[0])[times], np.arange(self.shape[1])[members]
        rows, columns = np.atleast_1d(t), np.atleast_1d(m) + self._members.start
        block = self._array.read(rows, columns, where=self._published(rows, columns))
        return block[_in_block(times, t), _in_block(members, m), *index[2:]]

    def _published(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        starts, entries = np.array(self._parts).T
        return rows[:, None] < entries[np.searchsorted(starts, columns, side="right") - 1]


def _expand_index(index: tuple[Any, ...], ndim: int) -> tuple[Any, ...]:
    """An index with as many items as there are axes."""
    where = [k for k, x in enumerate(index) if x is Ellipsis]
    k = where[0] if where else len(index)
    after = index[k + 1 :]
    return (*index[:k], *[slice(None)] * (ndim - len(index) + bool(where)), *after)


def _in_block(given: Any, numbers: np.ndarray) -> Any:
    """The index of an axis in a block of these numbers, from that in the whole array."""
    if np.ndim(numbers) == 0:
        return 0
    return slice(None) if isinstance(given, slice) else np.arange(len(numbers))


def load(root: Root, thorough: bool, part: tuple[int, PartState] | None = None) -> Saves:
    """The published results of all parts or of one.

    The attributes have "machines" too, pairs of a part and what has computed it; those of a run in parts have
    "missing", a sentence for each part that is missing, damaged or incomplete.

    Args:
        root: the root of the store.
        thorough: look at every file of a run in parts, and count a damaged part as missing.
        part: the number and the state of the only part to load; None means all of them.

    Raises:
        UnreadableError: a run with `reduce` whose parts are not all complete.
    """
    thorough = thorough and root.in_parts
    statuses = dict(enumerate(root.statuses(thorough)) if part is None else [part])
    ranges, shown = [root.split.part(k) for k in statuses], [status.progress for status in statuses.values()]
    members = range(ranges[0].start, ranges[-1].stop)
    progress = {
        "commits": sum(x["commits"] for x in shown),
        "entries": max(x["entries"] for x in shown),
        "steps": min(x["steps"] for x in shown),
        "complete": all(x["complete"] for x in shown),
    }
    machines = [(k, machine) for k, status in statuses.items() for machine in status.machines]
    attributes = root.attributes | {"progress": progress, "machines": machines}
    if root.in_parts:
        attributes["missing"] = [line for k, x in statuses.items() if (line := root.sentence(k, x))]
    arrays = {name: StoredArray(root.storage, name, meta) for name, meta in root.metas.items()}
    if attributes["reduce"] is not None:
        if attributes.get("missing"):
            raise UnreadableError(
                f"{root.storage.address} is an incomplete run with `reduce`: {first_of(attributes['missing'])}. Run "
                "these parts, or read it by xarray.open_zarr"
            )
        which = range(min(statuses), max(statuses) + 1)
        return Saves(_series(root, arrays, which, ranges, progress), None, attributes)
    parts = [(own.start, x["entries"]) for own, x in zip(ranges, shown, strict=True)]
    found = {
        name: PublishedArray(array, progress["entries"], members, parts)
        for name, array in arrays.items()
        if array.meta.dims[:2] == ("time", "member")
    }
    times: Any = arrays["time"].read(np.arange(progress["entries"]))
    state = states_in(found, times, attributes | {"members": len(members)})
    info: Any = StepInfo(found["residual"], found["converged"])  # pyright: ignore[reportArgumentType]
    failed = arrays["first_failure"].read(np.array(members)) if progress["complete"] else None
    return Saves(Trajectory(times, state, info), failed, attributes)


_MERGE = {"least": np.min, "greatest": np.max, "residual": np.max, "unconverged": np.sum}  # the series of several parts


def _series(
    root: Root, arrays: dict[str, StoredArray], parts: range, ranges: list[range], progress: Table
) -> dict[str, np.ndarray]:
    """The arrays of a run with `reduce`, with the series of its parts merged to those of all members."""
    members = range(ranges[0].start, ranges[-1].stop)
    found: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        dims = array.meta.dims
        if dims[:1] == ("time",):
            found[name] = array.read(np.arange(progress["entries"]))
        elif dims[:1] == ("member",) and name not in root.constants:
            found[name] = array.read(np.array(members), where=np.full(len(members), progress["complete"]))
        elif dims == ("part", "time"):
            of = array.read(np.array(parts))
            found[name] = _MERGE[name](of, axis=0) if name in _MERGE else of[0]
    if root.split.parts > 1 and root.attributes["per"] is None:
        pairs = zip(ranges, arrays["sums"].read(np.array(parts)), strict=True)
        sums = total([(own, x[:, : len(blocks(own.start, own.stop))]) for own, x in pairs])
        found["mean"] = sums / (len(members) * (root.attributes["save_every"] or 1))
    return found
