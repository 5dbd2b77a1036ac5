"""Values of a program: their types, and their names as scalars or as vectors of members."""

from __future__ import annotations

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
        self.names: dict[Value, str] = {}

    def varies(self, x: Value) -> bool:
        return x in self.program.varying

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
        return self.splat(name, x.dtype) if vector and not self.varies(x) else name

    def splat(self, name: str, dtype: DTypeLike) -> str:
        kind, scalar = self.type(dtype, True), self.scalar(dtype)
        first = self.add(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        return self.add(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")
