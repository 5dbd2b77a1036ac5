"""Entries at indices that the program computes: selected by comparisons, or read from memory if there are many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.typing import DTypeLike

from lieint_jax.native._primitives.abstract_walk import (
    AbstractWalk,
    Arrays,
    Parameters,
    Table,
    UnsupportedError,
    array_of,
    as_numbers,
    entry_at,
    run_of,
)
from lieint_jax.native._primitives.reductions import reduce_terms
from lieint_jax.native._program import Value

Window = tuple[list[Value], Value, np.ndarray]  # its first index, whether it is written, its numbers
_CLIP, _FILL = lax.GatherScatterMode.CLIP, lax.GatherScatterMode.FILL_OR_DROP
_ROW = 1024  # the most entries of a table that are read at once
_SELECTED = 8  # the most numbers from which one is selected by comparing indices; longer arrays are read from memory


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
    d, row = walk.long_axis(row.shape) or 0, as_numbers(row)
    n = row.size // max(arrays.size, 1)  # entries of each array
    first = k if n == 1 else walk.number("mul", k, walk.index(n))
    columns: Any = np.moveaxis(row, d, 0).reshape(n, -1).T if n > 1 else row.reshape(-1, 1)
    found = []
    for array, column in zip(arrays.flat, columns, strict=True):
        run = run_of(walk, list(column)) if n > 1 else None
        if run is not None and run[1:] == (0, 1) and run[0].op == "rows":
            found.append(walk.number("put", array, first, run[0], dtype=array.dtype, data=n))
            continue
        for j, x in enumerate(column):
            array = walk.number("put", array, walk.offset(first, j), x, dtype=array.dtype)
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
            found[k, *at] = walk.builder.entries(arrays[place])[index]
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
        return entry_at(walk, found, k)
    chosen = found[0]
    for n in range(1, len(found)):
        chosen = walk.select(walk.number("eq", k, walk.builder.constant(n, k.dtype)), found[n], chosen)
    return chosen


def _dynamic_slice(walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, slice_sizes: Sequence[int]) -> np.ndarray:
    x = inputs[0]
    starts = [walk.clip_index(k.item(), n - m) for k, n, m in zip(inputs[1:], x.shape, slice_sizes, strict=True)]
    found = np.empty(slice_sizes, object)
    for index in np.ndindex(*slice_sizes):
        found[index] = _entry_at(walk, x, [walk.offset(s, k) for s, k in zip(starts, index, strict=True)])
    return found


def _dynamic_update_slice(walk: AbstractWalk, inputs: Arrays, out: ShapedArray) -> np.ndarray:
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
            at = [walk.offset(s, k) for s, k in zip(starts, index, strict=True)]
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
    inputs: Arrays,
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
            at[n] = walk.offset(at[n], place[m])
        found[place] = _fill(walk, inside, _entry_at(walk, x, at), fill_value)
    return found


def _scatter(op: str | None) -> Callable[..., np.ndarray]:
    def scatter(
        walk: AbstractWalk,
        inputs: Arrays,
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
    walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, dtype: DTypeLike, shape: Sequence[int], dimension: int
) -> np.ndarray:
    n = shape[dimension]
    sizes = [n if k == dimension else 1 for k in range(len(shape))]
    return walk.constant_array(np.broadcast_to(np.arange(n).reshape(sizes), shape), dtype)


def _platform(
    walk: AbstractWalk, inputs: Arrays, out: ShapedArray, *, platforms: Sequence[Sequence[str] | None]
) -> np.ndarray:
    """The first of these sets of platforms that has the CPU; None stands for all others."""
    chosen = next(k for k, several in enumerate(platforms) if several is None or "cpu" in several)
    return walk.constant_array(np.array(chosen), out.dtype)


def look_up(walk: AbstractWalk, name: str, inputs: Arrays, parameters: Parameters, out: ShapedArray) -> np.ndarray:
    """An entry of a table, or a few that follow each other."""
    table, few = inputs[0], int(np.prod(out.shape))
    one = name in ("dynamic_slice", "slice") or (name == "gather" and inputs[1].size == few == 1)
    if not (one and isinstance(table, Table) and 0 < few <= _ROW and len(table.shape) == 1):
        raise UnsupportedError(f"{name} of a long array")
    mode = parameters["mode"] if name == "gather" else _CLIP
    first = [walk.index(parameters["start_indices"][0])] if name == "slice" else list(inputs[1].flat)
    [index], inside = _window(walk, table.shape, (few,), first, (0,), {}, mode)
    stride = parameters.get("strides", (1,))[0]
    places = [walk.offset(index, k * stride) for k in range(few)]
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
