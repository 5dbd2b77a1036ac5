"""Entries of long arrays at indices that the program computes, such as the number of a row of a map.

A column is the list of the numbers along an axis. Its entries are read from memory, where most columns already are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Table, UnsupportedError, array_of
from lieint_jax.native._program import Value

_COPIED = 256  # the longest array that is put together from numbers: LLVM needs 10 s for 400, minutes for 2000
_STORED = ("array", "carry array", "column", "result array", "rows")  # arrays that rows of a map are read from
_PARTS = 3  # of which the most a column of a map is put together
NEXT = 2  # entries before and after an array that may be read


def row_of(walk: AbstractWalk, x: np.ndarray | Table, k: Value) -> np.ndarray:
    """x[k] of an array of numbers at an index that the program computes."""
    if isinstance(x, Table):
        return array_of([walk.number("table", k, dtype=x.dtype, data=x.data)], ())
    columns = x.reshape(len(x), -1).T
    return array_of([entry_at(walk, list(column), k) for column in columns], x.shape[1:])


def entry_at(walk: AbstractWalk, column: list[Value], k: Value) -> Value:
    """An entry of a long column of numbers: if they are constants, they are data of the program."""
    if all(x is column[0] for x in column):
        return column[0]
    run = run_of(walk, column)
    if run is not None:
        array, first, stride = run
        k = k if stride == 1 else walk.number("mul", k, walk.index(stride))
        return walk.number("entry", offset_by(walk, k, first), array, dtype=array.dtype)
    if all(x.is_constant for x in column):
        values = np.array([x.data for x in column], column[0].dtype)
        return walk.number("values", k, dtype=values.dtype, data=(values.dtype.str, values.tobytes()))
    if len(column) > _COPIED:
        raise UnsupportedError("an index into a long array that is not a table")
    array = walk.number("array", *column, dtype=column[0].dtype)
    return walk.number("entry", k, array, dtype=column[0].dtype)


def entry_of(walk: AbstractWalk, x: Value, k: int) -> Value:
    """The entry of an array in memory; a number that is no array is the same for all k."""
    return walk.builder.entries(x)[k] if x.is_array else x


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


def columns_of(walk: AbstractWalk, x: np.ndarray, axis: int, own: Sequence[Value | None] = ()) -> list[Value]:
    """The arrays in memory of the entries of x along an axis, one for each place on the other axes.

    Args:
        walk: the walk.
        x: an array of numbers.
        axis: a long axis.
        own: arrays that will be overwritten, each by the column of its place, so that it may be this column only.
    """
    rows = np.moveaxis(x, axis, 0)
    columns = [list(column) for column in rows.reshape(len(rows), -1).T]
    found = [_whole_array(walk, column) for column in columns]
    for k, array in enumerate(found):
        if own and array is not None and array.op in ("carry array", "column") and array is not own[k]:
            found[k] = None
    others = [column for column, array in zip(columns, found, strict=True) if array is None]
    copied = iter(walk.builder.map(len(rows), lambda k: [row_number(walk, x, k) for x in others], whole=True))
    return [next(copied) if array is None else array for array in found]


def _whole_array(walk: AbstractWalk, column: list[Value]) -> Value | None:
    """The array in memory whose entries these are, if there is one."""
    run = run_of(walk, column)
    if run is None or run[1:] != (0, 1) or run[0].op not in _STORED or run[0].length != len(column):
        return None
    return run[0]


def joined_columns(walk: AbstractWalk, columns: Sequence[Value], shape: Sequence[int], axis: int) -> np.ndarray:
    """The array of numbers from its columns along an axis: entries that are not used are not read."""
    n, others = shape[axis], [n for d, n in enumerate(shape) if d != axis]
    found = np.empty((n, len(columns)), object)
    for k, x in enumerate(columns):
        found[:, k] = walk.builder.entries(x) if x.is_array else [x] * n
    return np.moveaxis(found.reshape(n, *others), 0, axis)


def offset_by(walk: AbstractWalk, start: Value, offset: int) -> Value:
    """An index plus a number."""
    return walk.number("add", start, walk.index(offset))
