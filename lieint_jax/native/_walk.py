"""From a jaxpr to a program of numbers.

An array is a NumPy array of its numbers, so that operations which only move entries cost nothing, and a matrix product
becomes products and sums.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from lieint_jax.native._march import by_xla, march_p
from lieint_jax.native._primitives.abstract_walk import (
    LARGEST,
    AbstractWalk,
    Arrays,
    Parameters,
    Rows,
    Table,
    TooLongError,
    UnsupportedError,
    array_of,
    as_numbers,
    other_axis,
    shapes_of,
)
from lieint_jax.native._primitives.control_flow import CONTROL_FLOW, READ_ROWS
from lieint_jax.native._primitives.elementwise import ELEMENTWISE, MOVES
from lieint_jax.native._primitives.indexing import INDEXING, look_up
from lieint_jax.native._primitives.linear_algebra import LINEAR_ALGEBRA
from lieint_jax.native._primitives.parallel import Axes, Region, of_one_row, rows_along, walk_regions
from lieint_jax.native._primitives.reductions import REDUCTIONS
from lieint_jax.native._program import Builder, Value

_LARGEST_WITH_MAPS = 80_000  # the most entries of an array, most of which maps never make numbers of the program
LONGEST = 100_000  # the most operations of a program
_TYPES = set(map(np.dtype, ["bool", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"]))
# They change no value here. A formula names all others that it reads: by any more, Python's TypeError, XLA runs it.
_HARMLESS = {"accuracy", "indices_are_sorted", "out_sharding", "sharding", "unique_indices", "weak_type"}
_OF_ONE_RESULT = REDUCTIONS | INDEXING


class Walk(AbstractWalk):
    """A walk through a jaxpr, which adds its operations to a builder.

    Args:
        builder: the program so far.
        compute_before: (equation, operands) ↦ the results of an operation without a formula here, or None.
        longest: the most operations.
        with_maps: whether operations along a long axis become maps.
    """

    def __init__(
        self,
        builder: Builder,
        compute_before: Callable[[JaxprEqn, Arrays], Arrays | None],
        longest: int = LONGEST,
        with_maps: bool = False,
    ):
        super().__init__(builder, with_maps)
        self._compute_before, self._longest = compute_before, longest

    def jaxpr(self, closed: ClosedJaxpr | Jaxpr, arguments: Sequence[np.ndarray]) -> Arrays:
        """The results of a jaxpr, as arrays of numbers."""
        jaxpr: Any = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
        given = closed.consts if isinstance(closed, ClosedJaxpr) else []
        consts = [self.constant_array(x, var.aval.dtype) for x, var in zip(given, jaxpr.constvars, strict=True)]
        values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

        def read(atom: Any) -> Any:
            if isinstance(atom, Literal):
                return self.constant_array(atom.val, atom.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
            return values[atom]

        def walk_one(equation: JaxprEqn) -> None:
            inputs, axes = [read(x) for x in equation.invars], list[int | None]()
            if self._row is not None:  # some operands may have one row, where the equation has all
                axes = [other_axis(x.shape, y.shape) for x, y in zip(inputs, shapes_of(equation.invars), strict=True)]
            if any(d is not None for d in axes):
                results = self._one_row(equation, inputs, *rows_along(equation, axes))
            else:
                results = self._apply(equation, inputs, equation.params, shapes_of(equation.outvars))
            values.update(zip(equation.outvars, results, strict=True))
            if self.builder.length > self._longest:
                raise TooLongError(f"more than {self._longest} operations")

        def walk_rows(region: Region, needed: Sequence[Any]) -> None:
            values.update(self._map(region, needed, read))

        if self._with_maps and self._row is None:
            walk_regions(jaxpr, values, walk_one, walk_rows)
        else:
            for equation in jaxpr.eqns:
                walk_one(equation)
        return [read(x) for x in jaxpr.outvars]

    def _map(self, region: Region, needed: Sequence[Any], read: Callable[[Any], np.ndarray]) -> dict[Any, np.ndarray]:
        """Some results of a region, by a map over its rows."""
        found: dict[Any, np.ndarray] = {}

        def row(index: Value) -> list[Value]:
            self._row, self.rows_at_once, self._rows_read = index, region.length, {}
            for equation, axes, out in region.equations:
                inputs = [found[x] if isinstance(x, Var) and x in found else read(x) for x in equation.invars]
                found.update(zip(equation.outvars, self._one_row(equation, inputs, axes, out), strict=True))
            self._row, self.rows_at_once = None, 1
            return [number for x in needed for number in found[x].flat]

        arrays = iter(self.builder.map(region.length, row))
        results = {}
        for x in needed:
            shape, axis = found[x].shape, region.axes[x]
            if axis is None:  # by a loop with rows in other results: any row has it
                same = [next(arrays) for _ in range(found[x].size)]
                results[x] = array_of([self.builder.entries(n)[0] if n.is_array else n for n in same], shape)
                continue
            columns = [next(arrays) for _ in range(found[x].size)]
            results[x] = Rows(self, columns, (*shape[:axis], region.length, *shape[axis + 1 :]), axis)
        return results

    def _one_row(self, equation: JaxprEqn, inputs: Arrays, axes: Axes, out: Axes) -> Arrays:
        """The results of an equation for one row along these axes of its operands and results."""
        shapes = [
            x if d is None else x.update(shape=(*x.shape[:d], 1, *x.shape[d + 1 :]))
            for x, d in zip(shapes_of(equation.outvars), out, strict=True)
        ]
        operands = zip(inputs, axes, shapes_of(equation.invars), strict=True)
        rows = [x if d is None or x.shape != y.shape else self._row_of(x, d) for x, d, y in operands]
        parameters = of_one_row(equation.primitive.name, equation.params, axes, out)
        return self._apply(equation, rows, parameters, shapes)

    def _apply(self, equation: JaxprEqn, inputs: Arrays, parameters: Parameters, out: list[ShapedArray]) -> Arrays:
        name = equation.primitive.name
        if out and all(x.dtype == jax.dtypes.float0 for x in out):  # tangents of integers, which nothing reads
            return [self.constant_array(np.zeros(x.shape), x.dtype) for x in out]
        other = {x.dtype for x in (*shapes_of(equation.invars), *out)} - _TYPES
        if other:
            raise UnsupportedError(f"{name} of {', '.join(sorted(map(str, other)))}")
        if any(x.size > (_LARGEST_WITH_MAPS if self._with_maps else LARGEST) for x in out):
            raise UnsupportedError(f"an array of shape {out[0].shape}")
        if name not in READ_ROWS:
            inputs = [as_numbers(x) for x in inputs]
        if name in CONTROL_FLOW:
            return CONTROL_FLOW[name](self, inputs, parameters, out)
        operations = expanded(equation)
        if operations is not None:
            return self.jaxpr(operations, inputs)
        parameters = {k: x for k, x in parameters.items() if x is not None and k not in _HARMLESS}
        if any(isinstance(x, Table) for x in inputs):
            return [look_up(self, name, inputs, parameters, out[0])]
        if name in MOVES:
            found = MOVES[name](*inputs, **parameters)
            return found if isinstance(found, list) else [found]
        if name in LINEAR_ALGEBRA:
            return LINEAR_ALGEBRA[name](self, inputs, out, **parameters)
        if name in _OF_ONE_RESULT:
            return [_OF_ONE_RESULT[name](self, inputs, out[0], **parameters)]
        if name in ELEMENTWISE:
            arrays, dtype = np.broadcast_arrays(*inputs), np.dtype(out[0].dtype)
            rows = zip(*(x.flat for x in arrays), strict=True)
            return [array_of([ELEMENTWISE[name](self, row, dtype, **parameters) for row in rows], arrays[0].shape)]
        results = self._compute_before(equation, inputs)
        if results is None:
            raise UnsupportedError(f"{name} has no formula in machine code")
        return results


def expanded(equation: JaxprEqn) -> ClosedJaxpr | None:
    """The operations of which a composite primitive consists, such as `custom_root` of JAX ≥ 0.12; None for others."""
    primitive, operands = equation.primitive, shapes_of(equation.invars)
    if primitive is march_p:  # a loop inside of a step
        return jax.make_jaxpr(lambda *x: by_xla(*x, **equation.params))(*operands)
    if not primitive.is_high(*operands, **equation.params):
        return None
    return jax.make_jaxpr(lambda *x: primitive.to_lojax(*x, **equation.params))(*operands)
