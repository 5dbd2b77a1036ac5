"""Numbers and arrays of numbers, in which the formulas of primitives are written, and entries of long arrays.

Entries at indices that the program computes, such as the number of a row of a map, are read from columns. A column is
the list of the numbers along an axis. Its entries are read from memory, where most columns already are.
"""

from __future__ import annotations

import abc
import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.typing import ArrayLike, DTypeLike

from lieint_jax.native._program import Builder, Value

Parameters = Mapping[str, Any]  # of a primitive
Arrays = list[np.ndarray]  # of numbers
Shapes = Sequence[ShapedArray]
LARGEST = 10_000  # the most entries of an array
_UNROLLED = (400, 6000)  # without and with maps: see `AbstractWalk.unrolled`
_LONG = 8  # the shortest axis of a map
_COPIED = 256  # the longest array that is put together from numbers: LLVM needs 10 s for 400, minutes for 2000
_STORED = ("array", "carry array", "column", "result array", "rows")  # arrays that rows of a map are read from
_PARTS = 3  # of which the most a column of a map is put together
NEXT = 2  # entries before and after an array that may be read


class UnsupportedError(Exception):
    """A function cannot be a program of numbers; the message names the unsupported operation."""


class TooLongError(UnsupportedError):
    """A function has too many operations."""


@contextlib.contextmanager
def unsupported_if_it_fails() -> Iterator[None]:
    """Any failure of code that reads what JAX wrote, and of code that writes LLVM's, becomes an `UnsupportedError`.

    Neither of the two is a stable interface; what a later release changes there may cost speed, but ends no run.
    """
    try:
        yield
    except (ImportError, UnsupportedError):
        raise
    except Exception as failure:
        raise UnsupportedError(f"{type(failure).__name__}: {failure}") from failure


class Table:
    """An array in memory whose entries a program reads by a computed index, such as the times of all steps."""

    def __init__(self, data: int, dtype: DTypeLike, shape: tuple[int, ...]):
        self.data, self.dtype, self.shape = data, np.dtype(dtype), shape

    def __getattr__(self, name: str) -> NoReturn:
        raise UnsupportedError(f"{name} of a long array")


def array_of(numbers: Sequence[object], shape: Sequence[int]) -> np.ndarray:
    """Numbers as an array."""
    found = np.empty(len(numbers), object)
    for k, x in enumerate(numbers):
        found[k] = x
    return found.reshape(shape)


def as_numbers(x: Any) -> Any:
    """An array as one of numbers, which `Rows` make when they are read; a table as it is."""
    return x if isinstance(x, np.ndarray | Table) else x.numbers()


def shapes_of(variables: Sequence[Any]) -> list[ShapedArray]:
    """The shapes and types of variables of a jaxpr."""
    return [x.aval for x in variables]


class AbstractWalk(abc.ABC):
    """What the formulas of primitives use of a walk through a jaxpr.

    Args:
        builder: the program so far.
        with_maps: whether operations along a long axis become maps.

    Attributes:
        builder: the program so far.
        unrolled: the most numbers of a longer unrolled loop, in all iterations together.
        rows_at_once: for which a formula is evaluated, inside a map.
    """

    def __init__(self, builder: Builder, with_maps: bool = False):
        self.builder, self.unrolled, self.rows_at_once = builder, _UNROLLED[with_maps], 1
        self._with_maps = with_maps
        self._row: Value | None = None  # the number of the row inside of a map
        self._rows_read: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @abc.abstractmethod
    def jaxpr(self, closed: ClosedJaxpr | Jaxpr, arguments: Sequence[np.ndarray]) -> Arrays:
        """The results of a jaxpr, as arrays of numbers."""

    def constant_array(self, x: ArrayLike, dtype: DTypeLike) -> np.ndarray:
        """An array of constants."""
        if jax.numpy.issubdtype(dtype, jax.dtypes.prng_key):
            raise UnsupportedError("random keys have no formula in machine code")
        x = np.asarray(x, bool if dtype == jax.dtypes.float0 else dtype)
        if x.size > LARGEST:
            raise UnsupportedError(f"an array of {x.size} entries")
        return array_of([self.builder.constant(value) for value in x.flat], x.shape)

    def number(self, op: str, *inputs: Value, dtype: DTypeLike | None = None, data: object = None) -> Value:
        """The result of an operation on numbers; a sum of booleans is "or", and their product "and", as in XLA."""
        if inputs[0].dtype == bool:
            op = {"add": "or", "mul": "and"}.get(op, op)
        return self.builder.number(op, *inputs, dtype=dtype, data=data)

    def index(self, k: int) -> Value:
        """A constant index."""
        return self.builder.constant(k, np.int64)

    def offset(self, start: Value, k: int) -> Value:
        """An index plus a number."""
        return self.number("add", start, self.index(k))

    def clip_index(self, index: Value, last: int) -> Value:
        """An index from 0 to `last`, an int64."""
        if index.dtype == np.uint64:  # beyond the range of int64 too
            index = self.number("min", index, self.builder.constant(last, np.uint64))
        index = self.number("convert", index, dtype=np.int64)
        return self.number("min", self.number("max", index, self.index(0)), self.index(last))

    def _row_of(self, x: np.ndarray, axis: int) -> np.ndarray:
        """The row of a map, of an array that has all."""
        assert self._row is not None
        if isinstance(x, Rows) and x.axis == axis:
            return x.row(self._row)
        x, key = as_numbers(x), (id(x), axis)
        if key not in self._rows_read:
            rows = np.moveaxis(x, axis, 0)
            numbers = [row_number(self, list(column), self._row) for column in rows.reshape(len(rows), -1).T]
            self._rows_read[key] = x, np.moveaxis(array_of(numbers, (1, *rows.shape[1:])), 0, axis)
        return self._rows_read[key][1]

    def long_axis(self, shape: Sequence[int]) -> int | None:
        """The axis of an array over whose rows there is a map."""
        return long_axis(shape) if self._with_maps and self._row is None else None

    def packed(self, x: np.ndarray | Rows, own: Sequence[Value] = ()) -> list[Value]:
        """The numbers, or arrays in memory, that a loop carries for an array; see `columns_of`."""
        d = self.long_axis(x.shape)
        if d is None or (isinstance(x, np.ndarray) and x.flat[0].is_array):
            return list(as_numbers(x).flat)
        return columns_of(self, x, d, own)

    def unpacked(self, numbers: list[Value], like: Any) -> Any:
        """The array for which a loop carries these numbers or arrays in memory."""
        d = self.long_axis(like.shape)
        if d is None or len(numbers) == np.prod(like.shape):
            return array_of(numbers, like.shape)
        return Rows(self, numbers, like.shape, d)

    def matched(self, arrays: Sequence[np.ndarray], like: Sequence[Any]) -> Arrays:
        """Arrays of the shapes of others, which have one row where these have all: the row of a map."""
        found = list(arrays[: len(like)])
        if self._row is None:
            return found
        for k, (x, y) in enumerate(zip(found, like, strict=False)):
            longer = other_axis(x.shape, y.shape)
            found[k] = x if longer is None else self._row_of(x, longer)
        return found

    def select(self, test: Value, on_true: Any, on_false: Any) -> Any:
        """Numbers or arrays, by a boolean."""
        if isinstance(on_true, Value):
            return self.number("select", test, on_true, on_false, dtype=on_true.dtype)
        pairs = zip(on_true.flat, on_false.flat, strict=True)
        return array_of([self.select(test, x, y) for x, y in pairs], on_true.shape)

    def loop_over_arrays(
        self, starts: Arrays, test: Callable[[Arrays], Value], next_carry: Callable[[Arrays], Arrays]
    ) -> Arrays:
        """A loop that carries arrays."""
        packed = [self.packed(x) for x in starts]
        ends = [0, *itertools.accumulate(map(len, packed))]

        def parts(numbers: list[Value]) -> list[list[Value]]:
            return [numbers[i:j] for i, j in itertools.pairwise(ends)]

        def joined(numbers: list[Value]) -> Arrays:
            return [self.unpacked(own, x) for own, x in zip(parts(numbers), starts, strict=True)]

        def following(numbers: list[Value]) -> list[Value]:
            arrays = self.matched(next_carry(joined(numbers)), starts)
            return [x for pair in zip(arrays, parts(numbers), strict=True) for x in self.packed(*pair)]

        first = [x for numbers in packed for x in numbers]
        return joined(self.builder.loop(first, lambda c: test(joined(c)), following))


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
    near = all(  # entries of an array in memory, or next to it
        array.op in _STORED and n >= -NEXT and n + len(column) <= array.length + NEXT
        for array, n in parts
        if n is not None
    )
    if len(parts) > _PARTS or not near:
        if all(x.is_constant for x in column):
            return entry_at(walk, column, k)
        parts, ends = [(walk.number("array", *column, dtype=column[0].dtype), 0)], [0]
    numbers = [x if n is None else walk.number("row", k, x, dtype=x.dtype, data=(n, 1)) for x, n in parts]
    found = numbers[-1]
    for end, x in zip(ends[:0:-1], numbers[-2::-1], strict=True):
        found = walk.select(walk.number("lt", k, walk.index(end)), x, found)
    return found


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


def long_axis(shape: Sequence[int], length: int = 0) -> int | None:
    """The first or second axis if it is long, and of this length."""
    return next((k for k, n in enumerate(shape[:2]) if n >= _LONG and length in (0, n)), None)


def other_axis(shape: Sequence[int], other: Sequence[int]) -> int | None:
    """The axis along which arrays of these shapes differ in length, if there is one."""
    return next((d for d, (n, m) in enumerate(zip(shape, other, strict=True)) if n != m), None)
