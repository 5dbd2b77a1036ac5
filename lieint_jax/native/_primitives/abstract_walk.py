"""Numbers and arrays of numbers, in which the formulas of primitives are written."""

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

    Attributes:
        builder: the program so far.
        unrolled: the most numbers of a longer unrolled loop, in all iterations together.
        rows_at_once: for which a formula is evaluated, inside a map.
    """

    builder: Builder
    unrolled: int
    rows_at_once: int

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

    @abc.abstractmethod
    def long_axis(self, shape: Sequence[int]) -> int | None:
        """The axis of an array over whose rows there is a map."""

    @abc.abstractmethod
    def packed(self, x: Any, own: Sequence[Value] = ()) -> list[Value]:
        """The numbers, or arrays in memory, that a loop carries for an array; see `columns_of`."""

    @abc.abstractmethod
    def unpacked(self, numbers: list[Value], like: Any) -> Any:
        """The array for which a loop carries these numbers or arrays in memory."""

    @abc.abstractmethod
    def matched(self, arrays: Sequence[np.ndarray], like: Sequence[Any]) -> Arrays:
        """Arrays of the shapes of others, which have one row where these have all: the row of a map."""

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
