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
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from lieint_jax.native._march import by_xla, march_p
from lieint_jax.native._primitives.abstract_walk import LARGEST, AbstractWalk, Table, UnsupportedError, array_of
from lieint_jax.native._primitives.control_flow import CONTROL_FLOW
from lieint_jax.native._primitives.elementwise import ELEMENTWISE
from lieint_jax.native._primitives.indexing import INDEXING, look_up
from lieint_jax.native._primitives.linear_algebra import LINEAR_ALGEBRA
from lieint_jax.native._primitives.moves import MOVES
from lieint_jax.native._primitives.reductions import REDUCTIONS
from lieint_jax.native._program import Builder

_LONGEST = 60_000  # the most numbers of a program
_TYPES = {f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)} | {"bool", "float32", "float64"}
# They change no value here. A formula names all others that it reads: by any more, Python's TypeError, XLA runs it.
_HARMLESS = {"accuracy", "indices_are_sorted", "out_sharding", "sharding", "unique_indices", "weak_type"}


def shapes_of(variables: Sequence[Any]) -> list[ShapedArray]:
    """The shapes and types of variables of a jaxpr."""
    return [x.aval for x in variables]


class Walk(AbstractWalk):
    """A walk through a jaxpr, which adds its operations to a builder.

    Args:
        builder: the program so far.
        compute_before: (equation, operands) ↦ the results of an operation without a formula here, or None.
    """

    def __init__(
        self, builder: Builder, compute_before: Callable[[JaxprEqn, list[np.ndarray]], list[np.ndarray] | None]
    ):
        super().__init__(builder)
        self._compute_before = compute_before

    def jaxpr(self, closed: ClosedJaxpr | Jaxpr, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The results of a jaxpr, as arrays of numbers."""
        jaxpr: Any = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
        given = closed.consts if isinstance(closed, ClosedJaxpr) else []
        consts = [self.constant_array(x, var.aval.dtype) for x, var in zip(given, jaxpr.constvars, strict=True)]
        values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

        def read(atom: Any) -> Any:
            if isinstance(atom, Literal):
                return self.constant_array(atom.val, atom.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
            return values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
            if self.builder.length > _LONGEST:
                raise UnsupportedError(f"more than {_LONGEST} operations")
        return [read(x) for x in jaxpr.outvars]

    def _equation(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name, parameters = equation.primitive.name, equation.params
        out = shapes_of(equation.outvars)
        if out and all(x.dtype == jax.dtypes.float0 for x in out):  # tangents of integers, which nothing reads
            return [self.constant_array(np.zeros(x.shape), x.dtype) for x in out]
        other = {str(x.dtype) for x in (*shapes_of(equation.invars), *out)} - _TYPES
        if other:
            raise UnsupportedError(f"{name} of {', '.join(sorted(other))}")
        if any(np.prod(x.shape) > LARGEST for x in out):
            raise UnsupportedError(f"an array of shape {out[0].shape}")
        if name in CONTROL_FLOW:
            return CONTROL_FLOW[name](self, inputs, parameters, out)
        expanded = _expand(equation)
        if expanded is not None:
            return self.jaxpr(expanded, inputs)
        parameters = {k: x for k, x in parameters.items() if x is not None and k not in _HARMLESS}
        if any(isinstance(x, Table) for x in inputs):
            return [look_up(self, name, inputs, parameters, out[0])]
        if name in MOVES:
            found = MOVES[name](*inputs, **parameters)
            return found if isinstance(found, list) else [found]
        if name in LINEAR_ALGEBRA:
            return LINEAR_ALGEBRA[name](self, inputs, out, **parameters)
        if name in REDUCTIONS:
            return [REDUCTIONS[name](self, inputs, out[0], **parameters)]
        if name in INDEXING:
            return [INDEXING[name](self, inputs, out[0], **parameters)]
        if name in ELEMENTWISE:
            arrays, dtype = np.broadcast_arrays(*inputs), np.dtype(out[0].dtype)
            rows = zip(*(x.flat for x in arrays), strict=True)
            return [array_of([ELEMENTWISE[name](self, row, dtype, **parameters) for row in rows], arrays[0].shape)]
        results = self._compute_before(equation, inputs)
        if results is None:
            raise UnsupportedError(f"{name} has no formula in machine code")
        return results


def _expand(equation: JaxprEqn) -> ClosedJaxpr | None:
    """The operations of which a composite primitive consists, such as `custom_root` of JAX ≥ 0.12; None for others."""
    primitive, operands = equation.primitive, shapes_of(equation.invars)
    if primitive is march_p:  # a loop inside of a step
        return jax.make_jaxpr(lambda *x: by_xla(*x, **equation.params))(*operands)
    if not primitive.is_high(*operands, **equation.params):
        return None
    return jax.make_jaxpr(lambda *x: primitive.to_lojax(*x, **equation.params))(*operands)
