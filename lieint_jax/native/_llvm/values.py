"""Values of a program: their types, and their names as scalars or as vectors of members."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._llvm.text import Module, Text, constant, with_lanes
from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._program import Program, Value

_TYPES = {"f8": "double", "f4": "float", "b1": "i1"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}


class Values(Text):
    """Text with the values of a program.

    Args:
        program: the program that it computes.
        lanes: members in a vector.
    """

    def __init__(self, program: Program, lanes: int):
        super().__init__(Module())
        self.program, self.lanes = program, lanes
        self.names: MutableMapping[Value, str] = {}
        self.outside: Mapping[Value, str] | None = None  # the names outside of a map whose rows are the lanes
        self.of_rows: set[Value] = set()  # the numbers that differ from row to row

    def varies(self, x: Value) -> bool:
        """Whether it is a vector: of members, or, inside a map of one member, of rows."""
        return x in (self.program.varying if self.outside is None else self.of_rows)

    def scalar(self, dtype: DTypeLike) -> str:
        name = np.dtype(dtype).str[1:]
        if name not in _TYPES:
            raise UnsupportedError(f"numbers of type {np.dtype(dtype)}")
        return _TYPES[name]

    def type(self, dtype: DTypeLike, vector: bool) -> str:
        return with_lanes(self.scalar(dtype), self.lanes * vector)

    def type_of(self, x: Value) -> str:
        return self.type(x.dtype, self.varies(x))

    def value(self, x: Value, vector: bool | None = None) -> str:
        """The name of a value, as a vector or as a scalar."""
        vector = self.varies(x) if vector is None else vector
        if x.is_constant:
            return constant(self.scalar(x.dtype), x.data, self.lanes * vector)
        name = self.names[x]
        if self.outside is not None and x in self.outside and x in self.program.varying:
            name = self.add(f"extractelement {with_lanes(self.scalar(x.dtype), 1)} {name}, i64 0")
        return self.splat(name, x.dtype) if vector and not self.varies(x) else name

    def splat(self, name: str, dtype: DTypeLike) -> str:
        kind, scalar = self.type(dtype, True), self.scalar(dtype)
        first = self.add(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        return self.add(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")
