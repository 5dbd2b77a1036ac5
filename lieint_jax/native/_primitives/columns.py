"""Entries of long arrays at indices that the program computes, such as the number of a row of a map.

A column is the list of the numbers along an axis. Its entries are read from memory, where most columns already are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Table, UnsupportedError, array_of, as_numbers
from lieint_jax.native._program import Value

_COPIED = 256  # the longest array that is put together from numbers: LLVM needs 10 s for 400, minutes for 2000
_STORED = ("array", "carry array", "column", "result array", "rows")  # arrays that rows of a map are read from
_PARTS = 3  # of which the most a column of a map is put together
NEXT = 2  # entries before and after an array that may be read


def row_of(walk: AbstractWalk, x: np.ndarray | Rows | Table, k: Value) -> np.ndarray:
    """x[k] of an array of numbers at an index that the program computes."""
    if isinstance(x, Table):
        return array_of([walk.number("table", k, dtype=x.dtype, data=x.data)], ())
    rows: np.ndarray = as_numbers(x)
    columns = rows.reshape(len(rows), -1).T
    return array_of([entry_at(walk, list(column), k) for column in columns], rows.shape[1:])


def entry_at(walk: AbstractWalk, column: list[Value], k: Value) -> Value:
    """An entry of a long column of numbers: if they are constants, they are data of the program."""
    if all(x is column[0] for x in column):
        return column[0]
    run = run_of(walk, column)
    if run is not None:
        array, first, stride = run
        k = k if stride == 1 else walk.number("mul", k, walk.index(stride))
        return walk.number("entry", walk.offset(k, first), array, dtype=array.dtype)
    if all(x.is_constant for x in column):
        values = np.array([x.data for x in column], column[0].dtype)
        return walk.number("values", k, dtype=values.dtype, data=(values.dtype.str, values.tobytes()))
    if len(column) > _COPIED:
        raise UnsupportedError("an index into a long array that is not a table")
    array = walk.number("array", *column, dtype=column[0].dtype)
    return walk.number("entry", k, array, dtype=column[0].dtype)


def row_number(walk: AbstractWalk, column: list[Value], k: Value) -> Value:
    """The entry of a column in row k of a map: of a few parts, which are numbers or follow each other in memory."""
    run = run_of(walk, column)
    if run is not None and run[2] > 0 and run[0].op in _STORED:
        return walk.number("row", k, run[0], dtype=run[0].dtype, data=run[1:])
    ends, parts = [], []
    for n, x in enumerate(column):
        is_entry = x.op == "entry" and x.inputs[0].is_constant
        part = (x.inputs[1], int(x.inputs[0].data) - n) if is_entry else (x, None)
        if not parts or part != parts[-1]:
            ends.append(n)
            parts.append(part)
    near = all(_is_near(array, offset, len(column)) for array, offset in parts if offset is not None)
    if len(parts) > _PARTS or not near:
        if all(x.is_constant for x in column):
            return entry_at(walk, column, k)
        parts, ends = [(walk.number("array", *column, dtype=column[0].dtype), 0)], [0]
    numbers = [x if n is None else walk.number("row", k, x, dtype=x.dtype, data=(n, 1)) for x, n in parts]
    found = numbers[-1]
    for end, x in zip(ends[:0:-1], numbers[-2::-1], strict=True):
        found = walk.select(walk.number("lt", k, walk.index(end)), x, found)
    return found


def _is_near(array: Value, offset: int, rows: int) -> bool:
    """Whether entries from `offset` on are those of an array, or in the memory next to it."""
    return array.op in _STORED and offset >= -NEXT and offset + rows <= array.length + NEXT


def run_of(walk: AbstractWalk, column: list[Value]) -> tuple[Value, int, int] | None:
    """(array, first index, stride) of entries of an array in memory at equal distances; None if they are none."""
    if any(x.op != "entry" or not x.inputs[0].is_constant for x in column[:2]):
        return None
    array, first = column[0].inputs[1], int(column[0].inputs[0].data)
    stride = int(column[1].inputs[0].data) - first if len(column) > 1 else 1
    end = first + stride * len(column)
    if not stride or column != walk.builder.entries(array)[first : end if end >= 0 else None : stride]:
        return None
    return array, first, stride


class Rows:
    """An array that is in memory along an axis: its numbers are made when an operation reads them.

    Args:
        walk: the walk.
        columns: the arrays, or numbers that are the same in all rows, one for each place on the other axes.
        shape: the shape of the array.
        axis: the axis.
    """

    def __init__(self, walk: AbstractWalk, columns: Sequence[Value], shape: Sequence[int], axis: int):
        self._walk, self.columns, self.shape, self.axis = walk, list(columns), tuple(shape), axis
        self._numbers: np.ndarray | None = None

    def numbers(self) -> np.ndarray:
        """The array of its numbers."""
        if self._numbers is None:
            found = np.empty((self.shape[self.axis], len(self.columns)), object)
            for k, x in enumerate(self.columns):
                found[:, k] = self._walk.builder.entries(x) if x.is_array else x
            self._numbers = self._placed(found)
        return self._numbers

    def row(self, k: Value) -> np.ndarray:
        """Row k of a map, with one entry along the axis."""
        return self._placed(array_of([_in_row(self._walk, x, k) for x in self.columns], (1, len(self.columns))))

    def _placed(self, rows: np.ndarray) -> np.ndarray:
        others = [n for d, n in enumerate(self.shape) if d != self.axis]
        return np.moveaxis(rows.reshape(len(rows), *others), 0, self.axis)


def columns_of(walk: AbstractWalk, x: np.ndarray | Rows, axis: int, own: Sequence[Value] = ()) -> list[Value]:
    """The arrays in memory of the entries of x along an axis, one for each place on the other axes.

    Args:
        walk: the walk.
        x: an array.
        axis: a long axis.
        own: arrays that will be overwritten, each by the column of its place, so that it may be this column only.
    """
    if isinstance(x, Rows) and x.axis == axis:
        columns = arrays = x.columns
    else:
        rows = np.moveaxis(as_numbers(x), axis, 0)
        columns = [list(column) for column in rows.reshape(len(rows), -1).T]
        arrays = [_whole_array(walk, column) for column in columns]
    kept = [
        array is not None
        and array.is_array
        and (not own or array is own[k] or array.op not in ("carry array", "column"))
        for k, array in enumerate(arrays)
    ]

    def copied(k: Value) -> list[Value]:
        return [_in_row(walk, x, k) for x, stays in zip(columns, kept, strict=True) if not stays]

    made = iter(walk.builder.map(x.shape[axis], copied, whole=True) if not all(kept) else [])
    return [array if stays and array else next(made) for array, stays in zip(arrays, kept, strict=True)]


def _in_row(walk: AbstractWalk, column: Value | list[Value], k: Value) -> Value:
    """The entry of a column, or of an array in memory, in row k of a map."""
    if not isinstance(column, Value):
        return row_number(walk, column, k)
    return walk.number("row", k, column, dtype=column.dtype, data=(0, 1)) if column.is_array else column


def _whole_array(walk: AbstractWalk, column: list[Value]) -> Value | None:
    """The array in memory whose entries these are, if there is one."""
    run = run_of(walk, column)
    if run is None or run[1:] != (0, 1) or run[0].op not in _STORED or run[0].length != len(column):
        return None
    return run[0]
