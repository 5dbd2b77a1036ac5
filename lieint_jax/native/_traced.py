"""A function of one member, walked into a program of numbers: what machine code and arrays are made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from lieint_jax.native._program import Builder, Number, Program
from lieint_jax.native._walk import Table, UnsupportedError, Walk, array_of

_LONGEST_SHARED = 256  # the most entries of a shared array that are numbers of the program, not a table in memory


class Leaf(NamedTuple):
    """An array that a function reads.

    Attributes:
        kind: "carry" (changed from row to row), "member", "shared", "row", or "table" (shared, read by index).
        dtype: its type.
        size: the number of entries that a member, a row, or all share.
    """

    kind: str
    dtype: np.dtype
    size: int

    @property
    def varies(self) -> bool:
        """Whether each member has its own."""
        return self.kind in ("carry", "member")


def before_rows(leaves: Sequence[Leaf]) -> list[Leaf]:
    """The leaves of a program that runs before the first row: what is carried is as given, each member's."""
    return [leaf._replace(kind="member") if leaf.kind == "carry" else leaf for leaf in leaves]


class Traced:
    """A function of one member as a program of numbers.

    Args:
        function: of trees of arrays.
        kinds: for each argument, or for its parts, what it is: "carry" (changed from row to row, the first result, of
            the same tree), "member" (each member has its own), "shared", or "row" (shared, another one for each row).
        examples: the arguments of one member and one row, as arrays or shapes.

    Attributes:
        leaves: the arrays of the arguments; the data of an argument of the program is (number of the leaf, of the
            entry), and a table is read by the number of its leaf.
        given: the number of leaves that are arguments; the others are results of `outside`, in this order.
        outside: operations that are no arithmetic, done before the program runs.
        program: its outputs are the entries of the results, leaf by leaf.
        length: the number of its operations.
        results: the shapes of the results of one member and one row.
        kinds_of_results: for each of them "member" or "shared".

    Raises:
        UnsupportedError: the function does what cannot be a program of numbers.
    """

    def __init__(self, function: Callable[..., Any], kinds: Sequence[Any], examples: Sequence[Any]):
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), jax.numpy.result_type(x)), tuple(examples))
        closed, self.results = jax.make_jaxpr(function, return_shape=True)(*shapes)
        each = jax.tree.map(lambda kind, part: [kind] * len(jax.tree.leaves(part)), tuple(kinds), shapes)
        self._builder, self.leaves, arguments = Builder(), [], []
        self.outside: list[Operation] = []
        for kind, x in zip(jax.tree.leaves(each), jax.tree.leaves(shapes), strict=True):
            long = kind == "shared" and x.size > _LONGEST_SHARED and len(x.shape) == 1
            arguments.append(self._argument("table" if long else kind, x))
        self.given = len(self.leaves)
        outputs = Walk(self._builder, self._computed_before).jaxpr(closed, arguments)
        self.program = self._program([x for array in outputs for x in array.flat])
        self.length = self._builder.length
        varying = [any(x in self.program.varying for x in array.flat) for array in outputs]
        structure = jax.tree.structure(self.results)
        self.kinds_of_results = jax.tree.unflatten(structure, ["member" if x else "shared" for x in varying])

    def _argument(self, kind: str, x: Any) -> Any:
        """A new argument, as numbers of the program."""
        k = len(self.leaves)
        self.leaves.append(Leaf(kind, np.dtype(x.dtype), int(np.prod(x.shape))))
        if kind == "table":
            return Table(k, x.dtype, x.shape)
        numbers = [self._builder.argument(x.dtype, (k, entry)) for entry in range(self.leaves[k].size)]
        return array_of(numbers, x.shape)

    def _program(self, outputs: list[Number]) -> Program:
        return Program(self._builder.root, outputs, lambda x: self.leaves[x.data[0]].varies)

    def _computed_before(self, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray] | None:
        """The results of an operation that is no arithmetic, if its operands do not change during a call."""
        numbers = [x for array in inputs for x in array.flat]
        program = self._program(numbers)
        if equation.effects or not all(map(self._is_fixed, program.live)):
            return None
        kind = "member" if any(x in program.varying for x in numbers) else "shared"
        shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
        self.outside.append(Operation(equation, kind, program, before_rows(self.leaves), shapes))
        return [self._argument(kind, x.aval) for x in equation.outvars]

    def _is_fixed(self, x: Number) -> bool:
        """Whether a number is the same during a call, if its inputs are."""
        if x.op == "argument":
            return self.leaves[x.data[0]].kind in ("member", "shared")
        return x.block in (None, self._builder.root) and x.op not in ("carry", "result")


class Operation(NamedTuple):
    """An operation that JAX does before the program runs, such as an eigendecomposition of the inertia.

    Attributes:
        equation: the operation.
        kind: "member" or "shared", as of its operands.
        program: computes its operands, from `leaves`.
        leaves: the arrays of the arguments, those that are carried as each member's.
        operands: their shapes.
    """

    equation: Any
    kind: str
    program: Program
    leaves: list[Leaf]
    operands: list[jax.ShapeDtypeStruct]

    def results(self, operands: Sequence[Any]) -> list[Any]:
        """Its results; operands of kind "member" have a leading axis of members."""

        def operation(*operands: Any) -> Any:
            return self.equation.primitive.bind(*operands, **self.equation.params)

        found = jax.vmap(operation)(*operands) if self.kind == "member" else operation(*operands)
        return list(found) if self.equation.primitive.multiple_results else [found]


_made: dict[Any, Any] = {}


def made_once(kind: Any, function: Callable[..., Any], kinds: Sequence[Any], examples: Sequence[Any]) -> Any:
    """`kind(function, kinds, examples)`, made once for all arguments of the same shapes; so is its failure.

    Raises:
        UnsupportedError: see `Traced`.
    """
    leaves, structure = jax.tree.flatten(tuple(examples))
    shapes = tuple((np.shape(x), jax.numpy.result_type(x)) for x in leaves)
    key = kind, function, tuple(jax.tree.leaves(tuple(kinds))), jax.tree.structure(tuple(kinds)), structure, shapes
    if key not in _made:
        try:
            _made[key] = kind(function, kinds, examples)
        except UnsupportedError as reason:
            _made[key] = reason
    found = _made[key]
    if isinstance(found, UnsupportedError):
        raise found
    return found
