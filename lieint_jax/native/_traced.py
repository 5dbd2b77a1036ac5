"""A function of one member, traced into a program of numbers, from which machine code or array code is generated."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn
from jax.typing import ArrayLike

from lieint_jax._checks import dtype_of
from lieint_jax._xla import Kept
from lieint_jax.native._primitives.abstract_walk import (
    LARGEST,
    Rows,
    Table,
    TooLongError,
    UnsupportedError,
    array_of,
    as_numbers,
    columns_of,
    shapes_of,
    unsupported_if_it_fails,
)
from lieint_jax.native._program import Builder, Column, Program, Value
from lieint_jax.native._walk import LONGEST, Walk

_Compiled = TypeVar("_Compiled")
Tree = Any  # a tree of arrays, of shapes, or of the kinds of arguments
_UNROLLED = 8_000  # the most numbers of a program without maps, if it may have them
_UNROLLED_ONCE = 2_000  # of one that runs once, and costs its compilation only
_LONGEST_SHARED = 256  # the most entries of a shared array that are numbers of a program without maps, not a table
_IN_COLUMNS = ("carry", "member", "shared")  # kinds of leaves that a program with maps has as arrays in memory


class Leaf(NamedTuple):
    """An array that a function reads.

    Attributes:
        kind: "carry" (changed from row to row), "member", "shared", "row", "series" (of each member, another one for
            each row), "table" (shared, read by index), or "counter" (the number of the row, which is not in memory).
        dtype: its type.
        size: the number of entries that a member, a row, or all share.
    """

    kind: str
    dtype: np.dtype
    size: int

    @property
    def varies(self) -> bool:
        """True if each member has its own."""
        return self.kind in ("carry", "member", "series")

    @property
    def has_rows(self) -> bool:
        """True if there is another one for each row."""
        return self.kind in ("row", "series")


class Traced:
    """A function of one member and one row as a program of numbers.

    Args:
        jaxpr: the function.
        kinds: what each argument is: "carry" (changed from row to row, one of the first results), "member" (each member
            has its own), "shared", "row" (shared, another one for each row), "series" (each member has its own for each
            row), or "counter" (the number of the row).
        with_maps: whether a long program has maps over long axes.
        runs_once: whether it is a single step, of which a shorter program is long.

    Attributes:
        leaves: the arrays of the arguments; the data of an argument of the program is (number of the leaf, of the
            entry), and a table is read by the number of its leaf.
        outside: operations without formulas here, such as those of LAPACK, which JAX computes before the program runs;
            their results, in this order, are the last of the leaves.
        program: its outputs are the entries of the results, leaf by leaf.
        length: the number of its operations.
        pressure: how many numbers of a step are alive at once.

    Raises:
        UnsupportedError: the function cannot be a program of numbers.
    """

    def __init__(self, jaxpr: ClosedJaxpr, kinds: Sequence[str], with_maps: bool = False, runs_once: bool = False):
        for x in jaxpr.in_avals:
            if jax.numpy.issubdtype(x.dtype, jax.dtypes.extended):
                raise UnsupportedError(f"an argument of type {x.dtype}")
        with unsupported_if_it_fails():
            try:
                unrolled = _UNROLLED_ONCE if runs_once else _UNROLLED
                self._walk(jaxpr, kinds, unrolled if with_maps else LONGEST, False)
            except UnsupportedError as reason:
                has_tables = any(leaf.kind == "table" for leaf in self.leaves)
                if not with_maps or not (isinstance(reason, TooLongError) or has_tables):
                    raise
                self._walk(jaxpr, kinds, LONGEST, True)
            self.pressure = self.program.pressure() or sum(leaf.size for leaf in self.leaves if leaf.varies)

    def _walk(self, closed: ClosedJaxpr, kinds: Sequence[str], longest: int, with_maps: bool) -> None:
        self._builder, self.leaves, arguments = Builder(), [], []
        self.outside: list[Operation] = []
        self._walker = walk = Walk(self._builder, self._compute_before, longest, with_maps)
        for kind, x in zip(kinds, closed.in_avals, strict=True):
            most = LARGEST if walk.long_axis(x.shape) is not None else _LONGEST_SHARED
            long = kind == "shared" and x.size > most and len(x.shape) == 1
            arguments.append(self._argument("table" if long else kind, x))
        found = walk.jaxpr(closed, arguments)
        carried = (x for x, kind in zip(arguments, kinds, strict=True) if kind == "carry")
        pairs = itertools.zip_longest(found, carried)
        self.program = self._program([x for pair in pairs for x in self._outputs(*pair)])
        self.length = self._builder.length

    def _argument(self, kind: str, x: ShapedArray) -> np.ndarray | Rows | Table:
        """A new argument, as numbers of the program, or in memory."""
        k = len(self.leaves)
        self.leaves.append(Leaf(kind, np.dtype(x.dtype), int(np.prod(x.shape))))
        if kind == "table":
            return Table(k, x.dtype, x.shape)
        d = self._walker.long_axis(x.shape) if kind in _IN_COLUMNS else None
        if d is None:
            numbers = [self._builder.argument(x.dtype, (k, entry)) for entry in range(self.leaves[k].size)]
            return array_of(numbers, x.shape)
        columns = [self._builder.argument(x.dtype, Column(k, *place)) for place in _places(x.shape, d)]
        return Rows(self._walker, columns, x.shape, d)

    def _outputs(self, x: np.ndarray, before: np.ndarray | None) -> list[Value]:
        """The numbers of a result, or its columns; `before` is the argument that it replaces, if it is carried."""
        d = self._walker.long_axis(x.shape)
        if d is None:
            return list(as_numbers(x).flat)
        own = [] if before is None else columns_of(self._walker, before, d)
        columns = zip(columns_of(self._walker, x, d, own), _places(x.shape, d), strict=True)
        pairs = itertools.zip_longest(columns, own)
        return [self._builder.result_column(array, Column(-1, *place), old) for (array, place), old in pairs]

    def _program(self, outputs: list[Value]) -> Program:
        return Program(self._builder.root, outputs, lambda x: self.leaves[x.data[0]].varies)

    def _compute_before(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[Any] | None:
        """The results of an operation that JAX must compute, if its operands do not change during a call; else None."""
        numbers = [x for array in inputs for x in array.flat]
        program = self._program(numbers)
        if equation.effects or not all(map(self._is_fixed, program.live)):
            return None
        kind = "member" if any(x in program.varying for x in numbers) else "shared"
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in shapes_of(equation.invars)]
        self.outside.append(Operation(equation, kind, program, shapes))
        return [self._argument(kind, x) for x in shapes_of(equation.outvars)]

    def _is_fixed(self, x: Value) -> bool:
        """True if a number does not change during a call, provided that its inputs do not."""
        if x.op in ("argument", "column"):
            return self.leaves[x.data[0]].kind in ("member", "shared")
        return x.block in (None, self._builder.root) and x.op not in ("carry", "result") and not x.is_array


class Operation(NamedTuple):
    """An operation that JAX computes before the program runs, such as an eigendecomposition of the inertia.

    Attributes:
        equation: the operation.
        kind: "member" or "shared", the kind of its operands.
        program: computes its operands.
        operands: the shapes of its operands.
    """

    equation: JaxprEqn
    kind: str
    program: Program
    operands: list[jax.ShapeDtypeStruct]

    def results(self, operands: Sequence[ArrayLike]) -> list[Array]:
        """Its results; operands of kind "member" have a leading axis of members."""
        operation = functools.partial(self.equation.primitive.bind, **self.equation.params)
        found = jax.vmap(operation)(*operands) if self.kind == "member" else operation(*operands)
        return list(found) if self.equation.primitive.multiple_results else [found]


def _places(shape: Sequence[int], axis: int) -> list[tuple[int, int, int]]:
    """First entry, stride and length of all columns along an axis of an array."""
    entries = np.moveaxis(np.arange(np.prod(shape)).reshape(shape), axis, 0).reshape(shape[axis], -1)
    return [(int(k), int(entries[1, 0] - entries[0, 0]), shape[axis]) for k in entries[0]]


def _dtype(x: ArrayLike | jax.ShapeDtypeStruct) -> np.dtype:
    """The type of an array or a number in JAX; `jax.numpy.result_type` takes ten times as long for an array."""
    dtype = dtype_of(x)
    if dtype is None:
        return jax.numpy.result_type(x)
    return dtype if jax.numpy.issubdtype(dtype, jax.dtypes.extended) else jax.dtypes.canonicalize_dtype(dtype)


_MOST_KEPT = 12  # of each kind that is made once; each holds a jaxpr or a program of numbers, some MiB
_cache: dict[object, Kept] = {}


def make_once(
    kind: Callable[..., _Compiled],
    function: object,
    kinds: Sequence[Tree],
    examples: Sequence[Tree],
    read: Hashable = (),
) -> _Compiled:
    """`kind(function, kinds, examples)`, made once for all arguments of the same shapes; failures are stored too.

    Those of each kind used last are kept, so that a session that makes ever new functions does not fill the memory.

    Args:
        kind, function, kinds, examples: see above.
        read: the key of what the function reads; None if it is to be made in each call.

    Raises:
        UnsupportedError: see `Traced`.
    """
    leaves, structure = jax.tree.flatten(tuple(examples))
    shapes = tuple((np.shape(x), _dtype(x)) for x in leaves)
    key = function, tuple(jax.tree.leaves(tuple(kinds))), jax.tree.structure(tuple(kinds)), structure, shapes, read

    def make() -> _Compiled | UnsupportedError:
        try:
            return kind(function, kinds, examples)
        except UnsupportedError as reason:
            return reason

    found = _cache.setdefault(kind, Kept()).get(None if read is None else key, make, _MOST_KEPT)
    if isinstance(found, UnsupportedError):
        raise found
    return found
