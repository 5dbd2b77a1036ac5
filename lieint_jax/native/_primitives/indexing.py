"""Entries at indices that the program computes: selected by comparisons, or read from memory if there are many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.typing import DTypeLike

from lieint_jax.native._primitives.abstract_walk import AbstractWalk, Parameters, Table, UnsupportedError, array_of
from lieint_jax.native._primitives.reductions import reduce_terms
from lieint_jax.native._program import Value

Window = tuple[list[Value], Value, np.ndarray]  # its first index, whether it is written, its numbers
_CLIP, _FILL = lax.GatherScatterMode.CLIP, lax.GatherScatterMode.FILL_OR_DROP
_ROW = 1024  # the most entries of a table that are read at once
_COPIED = 256  # the longest array that is put together from numbers: LLVM needs 10 s for 400, minutes for 2000
_STORED = ("array", "result array", "rows")  # arrays that rows of a map are read from
_PARTS = 3  # of which the most a column of a map is put together
NEXT = 2  # entries before and after an array that may be read
_SELECTED = 8  # the most numbers from which one is selected by comparing indices; longer arrays are read from memory


def row_of(walk: AbstractWalk, x: np.ndarray | Table, k: Value) -> np.ndarray:
    """x[k] of an array of numbers at an index that the program computes."""
    if isinstance(x, Table):
        return array_of([walk.number("table", k, dtype=x.dtype, data=x.data)], ())
    columns = x.reshape(len(x), -1).T
    return array_of([_entry(walk, list(column), k) for column in columns], x.shape[1:])


def _entry(walk: AbstractWalk, column: list[Value], k: Value) -> Value:
    """An entry of a long column of numbers: if they are constants, they are data of the program."""
    if all(x is column[0] for x in column):
        return column[0]
    run = _run(column)
    if run is not None:
        array, first, stride = run
        k = k if stride == 1 else walk.number("mul", k, walk.index(stride))
        return walk.number("entry", _offset(walk, k, first), array, dtype=array.dtype)
    if all(x.is_constant for x in column):
        values = np.array([x.data for x in column], column[0].dtype)
        return walk.number("values", k, dtype=values.dtype, data=(values.dtype.str, values.tobytes()))
    if len(column) > _COPIED:
        raise UnsupportedError("an index into a long array that is not a table")
    array = walk.number("array", *column, dtype=column[0].dtype)
    return walk.number("entry", k, array, dtype=column[0].dtype)


def entry_of(walk: AbstractWalk, x: Value, k: int) -> Value:
    """The entry of an array in memory; a number that is no array is the same for all k."""
    return walk.number("entry", walk.index(k), x, dtype=x.dtype) if x.is_array else x


def row_number(walk: AbstractWalk, column: list[Value], k: Value) -> Value:
    """The entry of a column in row k of a map: of a few parts, which are numbers or follow each other in memory."""
    run = _run(column)
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
            return _entry(walk, column, k)
        parts, ends = [(walk.number("array", *column, dtype=column[0].dtype), 0)], [0]
    numbers = [x if n is None else walk.number("row", k, x, dtype=x.dtype, data=(n, 1)) for x, n in parts]
    found = numbers[-1]
    for end, x in zip(ends[:0:-1], numbers[-2::-1], strict=True):
        found = walk.select(walk.number("lt", k, walk.index(end)), x, found)
    return found


def _is_near(array: Value, offset: int, rows: int) -> bool:
    """Whether entries from `offset` on are those of an array, or in the memory next to it."""
    length = len(array.inputs) if array.op == "array" else array.data
    return array.op in _STORED and offset >= -NEXT and offset + rows <= length + NEXT


def _run(column: Sequence[Value]) -> tuple[Value, int, int] | None:
    """(array, first index, stride) of entries of an array in memory at equal distances; None if they are none."""
    array, places = None, []
    for x in column:
        if x.op != "entry" or not x.inputs[0].is_constant or array not in (None, x.inputs[1]):
            return None
        array = x.inputs[1]
        places.append(int(x.inputs[0].data))
    stride = places[1] - places[0] if len(places) > 1 else 1
    if array is None or places != [places[0] + stride * k for k in range(len(places))]:
        return None
    return array, places[0], stride


def empty_rows(walk: AbstractWalk, length: int, shape: Sequence[int], dtype: DTypeLike) -> np.ndarray:
    """Arrays in memory for a loop that writes such a row in each iteration: one array for each entry of a row.

    For programs with maps, one array has the entries along a long axis, so that maps may read them.
    """
    d = walk.long_axis(shape)
    if d is not None:
        length, shape = length * shape[d], (*shape[:d], 1, *shape[d + 1 :])
    return array_of([walk.builder.empty(length, dtype) for _ in range(int(np.prod(shape)))], shape)


def write_rows(walk: AbstractWalk, arrays: np.ndarray, row: np.ndarray, k: Value) -> np.ndarray:
    """The arrays with row k written."""
    d = walk.long_axis(row.shape) or 0
    n = row.size // max(arrays.size, 1)  # entries of each array
    first = k if n == 1 else walk.number("mul", k, walk.index(n))
    columns: Any = np.moveaxis(row, d, 0).reshape(n, -1).T if n > 1 else row.reshape(-1, 1)
    found = []
    for array, column in zip(arrays.flat, columns, strict=True):
        run = _run(column) if n > 1 else None
        if run is not None and run[1:] == (0, 1) and run[0].op == "rows":
            found.append(walk.number("put", array, first, run[0], dtype=array.dtype, data=n))
            continue
        for j, x in enumerate(column):
            array = walk.number("put", array, _offset(walk, first, j), x, dtype=array.dtype)
        found.append(array)
    return array_of(found, arrays.shape)


def rows_of(walk: AbstractWalk, length: int, arrays: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """The rows of this shape that a loop has written, as numbers; what is not used is not read."""
    d, n = walk.long_axis(shape) or 0, int(np.prod(shape)) // max(arrays.size, 1)
    found = np.empty((length, *shape), object)
    for k in range(length):
        for at in np.ndindex(*shape):
            place = at if n == 1 else (*at[:d], 0, *at[d + 1 :])
            index = k if n == 1 else k * n + at[d]
            found[k, *at] = walk.number("entry", walk.index(index), arrays[place], dtype=arrays[place].dtype)
    return found


def _entry_at(walk: AbstractWalk, x: np.ndarray, index: Sequence[Value]) -> Value:
    """x[index], where each index is in bounds, and may be a number that the program computes."""
    if not len(index):
        return x.item()
    k, rest = index[0], index[1:]
    if k.is_constant:
        return _entry_at(walk, x[int(k.data)], rest) if len(rest) else x[int(k.data)]
    found = [_entry_at(walk, x[n], rest) if len(rest) else x[n] for n in range(len(x))]
    if len(found) > _SELECTED:
        return _entry(walk, found, k)
    chosen = found[0]
    for n in range(1, len(found)):
        chosen = walk.select(walk.number("eq", k, walk.builder.constant(n, k.dtype)), found[n], chosen)
    return chosen


def _offset(walk: AbstractWalk, start: Value, offset: int) -> Value:
    return walk.number("add", start, walk.index(offset))


def _dynamic_slice(
    walk: AbstractWalk, inputs: list[np.ndarray], out: ShapedArray, *, slice_sizes: Sequence[int]
) -> np.ndarray:
    x = inputs[0]
    starts = [walk.clip_index(k.item(), n - m) for k, n, m in zip(inputs[1:], x.shape, slice_sizes, strict=True)]
    found = np.empty(slice_sizes, object)
    for index in np.ndindex(*slice_sizes):
        found[index] = _entry_at(walk, x, [_offset(walk, s, k) for s, k in zip(starts, index, strict=True)])
    return found


def _dynamic_update_slice(walk: AbstractWalk, inputs: list[np.ndarray], out: ShapedArray) -> np.ndarray:
    x, update = inputs[:2]
    pairs = zip(inputs[2:], x.shape, update.shape, strict=True)
    starts = [walk.clip_index(k.item(), n - m) for k, n, m in pairs]
    return _write_windows(walk, x, [(starts, walk.builder.constant(True), update)], lambda old, new: new)


def _write_windows(
    walk: AbstractWalk, x: np.ndarray, updates: Sequence[Window], combine: Callable[[Value, Value], Value]
) -> np.ndarray:
    """x with windows (their first index, whether they are written, their numbers) written into it."""
    found = np.array(x, object)
    for starts, inside, update in updates:
        for index in np.ndindex(update.shape):
            at = [_offset(walk, s, k) for s, k in zip(starts, index, strict=True)]
            for place in np.ndindex(x.shape):
                same = [walk.number("eq", k, walk.builder.constant(n, k.dtype)) for k, n in zip(at, place, strict=True)]
                here = reduce_terms(walk, "and", [*same, inside], np.dtype(bool))
                before, new = found[place], update[index]
                found[place] = walk.select(here, combine(before, new), before)  # pyright: ignore[reportArgumentType]
    return found


def _window(
    walk: AbstractWalk,
    shape: Sequence[int],
    sizes: Sequence[int],
    index: Sequence[Value],
    axes: Sequence[int],
    batch: dict[int, int],
    mode: lax.GatherScatterMode,
) -> tuple[list[Value], Value]:
    """The first index of a window of an array, moved inside, and whether it was inside before (or counts as inside).

    Args:
        walk: the walk.
        shape, sizes: of the array, and of the window.
        index, axes: numbers, and the axes that they are indices of.
        batch: the indices of other axes, which are known.
        mode: of the indices.
    """
    if mode not in (_CLIP, _FILL, lax.GatherScatterMode.PROMISE_IN_BOUNDS):
        raise UnsupportedError(f"indices of mode {mode}")
    starts, inside = [walk.index(batch.get(n, 0)) for n in range(len(shape))], walk.builder.constant(True)
    for n, k in zip(axes, index, strict=True):
        starts[n] = walk.clip_index(k, shape[n] - sizes[n])
        if mode == _FILL:
            same = walk.number("eq", walk.number("convert", k, dtype=np.int64), starts[n])
            inside = walk.number("and", inside, same)
    return starts, inside


def _fill(walk: AbstractWalk, inside: Value, found: Value, value: Any) -> Value:
    """The entry of a gather if it is inside, else the fill value."""
    dtype = found.dtype
    if value is None:
        value = {"f": np.nan, "b": True}.get(dtype.kind)
    if value is None:
        value = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return walk.select(inside, found, walk.builder.constant(value, dtype))


def _gather(
    walk: AbstractWalk,
    inputs: list[np.ndarray],
    out: ShapedArray,
    *,
    dimension_numbers: lax.GatherDimensionNumbers,
    slice_sizes: Sequence[int],
    mode: lax.GatherScatterMode,
    fill_value: Any = None,
) -> np.ndarray:
    (x, indices), numbers = inputs, dimension_numbers
    offset_dims, batching = numbers.offset_dims, numbers.operand_batching_dims
    window_axes = [n for n in range(x.ndim) if n not in (*numbers.collapsed_slice_dims, *batching)]
    found = np.empty(out.shape, object)
    for place in np.ndindex(out.shape):
        batch = [k for n, k in enumerate(place) if n not in offset_dims]
        known = {n: batch[m] for n, m in zip(batching, numbers.start_indices_batching_dims, strict=True)}
        index = list(indices[tuple(batch)])
        at, inside = _window(walk, x.shape, slice_sizes, index, numbers.start_index_map, known, mode)
        for n, m in zip(window_axes, offset_dims, strict=True):
            at[n] = _offset(walk, at[n], place[m])
        found[place] = _fill(walk, inside, _entry_at(walk, x, at), fill_value)
    return found


def _scatter(op: str | None) -> Callable[..., np.ndarray]:
    def scatter(
        walk: AbstractWalk,
        inputs: list[np.ndarray],
        out: ShapedArray,
        *,
        dimension_numbers: lax.ScatterDimensionNumbers,
        mode: lax.GatherScatterMode,
        update_jaxpr: Jaxpr | None = None,
        update_consts: Sequence[Any] = (),
    ) -> np.ndarray:
        (x, indices, updates), numbers = inputs, dimension_numbers

        def combine(old: Value, new: Value) -> Value:
            if update_jaxpr is None:
                return new if op is None else walk.number(op, old, new)
            operands = [array_of([y], ()) for y in (old, new)]
            return walk.jaxpr(ClosedJaxpr(update_jaxpr, update_consts), operands)[0].item()

        batching, axes = numbers.operand_batching_dims, numbers.scatter_dims_to_operand_dims
        batch_axes = [n for n in range(updates.ndim) if n not in numbers.update_window_dims]
        single = sorted((*numbers.inserted_window_dims, *batching))
        windows = []
        for batch in np.ndindex(*(updates.shape[n] for n in batch_axes)):
            chosen: list[Any] = [slice(None)] * updates.ndim
            for n, k in zip(batch_axes, batch, strict=True):
                chosen[n] = k
            part = np.expand_dims(updates[tuple(chosen)], tuple(single))
            known = {n: batch[m] for n, m in zip(batching, numbers.scatter_indices_batching_dims, strict=True)}
            windows.append((*_window(walk, x.shape, part.shape, list(indices[batch]), axes, known, mode), part))
        return _write_windows(walk, x, windows, combine)

    return scatter


def _iota(
    walk: AbstractWalk,
    inputs: list[np.ndarray],
    out: ShapedArray,
    *,
    dtype: DTypeLike,
    shape: Sequence[int],
    dimension: int,
) -> np.ndarray:
    n = shape[dimension]
    sizes = [n if k == dimension else 1 for k in range(len(shape))]
    return walk.constant_array(np.broadcast_to(np.arange(n).reshape(sizes), shape), dtype)


def _platform(
    walk: AbstractWalk, inputs: list[np.ndarray], out: ShapedArray, *, platforms: Sequence[Sequence[str] | None]
) -> np.ndarray:
    """The first of these sets of platforms that has the CPU; None stands for all others."""
    chosen = next(k for k, several in enumerate(platforms) if several is None or "cpu" in several)
    return walk.constant_array(np.array(chosen), out.dtype)


def look_up(
    walk: AbstractWalk, name: str, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray
) -> np.ndarray:
    """An entry of a table, or a few that follow each other."""
    table, few = inputs[0], int(np.prod(out.shape))
    one = name in ("dynamic_slice", "slice") or (name == "gather" and inputs[1].size == few == 1)
    if not (one and isinstance(table, Table) and 0 < few <= _ROW and len(table.shape) == 1):
        raise UnsupportedError(f"{name} of a long array")
    mode = parameters["mode"] if name == "gather" else _CLIP
    first = [walk.index(parameters["start_indices"][0])] if name == "slice" else list(inputs[1].flat)
    [index], inside = _window(walk, table.shape, (few,), first, (0,), {}, mode)
    stride = parameters.get("strides", (1,))[0]
    places = [_offset(walk, index, k * stride) for k in range(few)]
    found = [walk.number("table", k, dtype=table.dtype, data=table.data) for k in places]
    if name == "gather":
        found = [_fill(walk, inside, x, parameters.get("fill_value")) for x in found]
    return array_of(found, out.shape)


INDEXING: dict[str, Callable[..., np.ndarray]] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "iota": _iota,
    "platform_index": _platform,
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "scatter-max": _scatter("max"),
    "scatter-min": _scatter("min"),
    "scatter-mul": _scatter("mul"),
}
