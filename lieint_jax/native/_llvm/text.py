"""Instructions, names, types and labels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._program import Program, Value

_TYPES = {
    "f8": "double",
    "f4": "float",
    "i8": "i64",
    "i4": "i32",
    "u4": "i32",
    "u8": "i64",
    "i2": "i16",
    "u2": "i16",
    "i1": "i8",
    "u1": "i8",
    "b1": "i1",
}


class Text:
    """The text of a function as it grows.

    Args:
        program: the program that it computes.
        lanes: members in a vector.
    """

    def __init__(self, program: Program, lanes: int):
        self.program, self.lanes = program, lanes
        self.lines: list[str] = []
        self.front: list[str] = []
        self.globals: dict[object, str] = {}
        self.declared: dict[str, None] = {}
        self.label = "entry"
        self.names: dict[Value, str] = {}
        self.count = 0

    def new(self) -> str:
        self.count += 1
        return f"%v{self.count}"

    def varies(self, x: Value) -> bool:
        return x in self.program.varying

    def scalar(self, dtype: DTypeLike) -> str:
        name = np.dtype(dtype).str[1:]
        if name not in _TYPES:
            raise UnsupportedError(f"numbers of type {np.dtype(dtype)}")
        return _TYPES[name]

    def type(self, dtype: DTypeLike, vector: bool) -> str:
        return f"<{self.lanes} x {self.scalar(dtype)}>" if vector else self.scalar(dtype)

    def type_of(self, x: Value) -> str:
        return self.type(x.dtype, self.varies(x))

    def add(self, text: str) -> str:
        """Write an instruction that has a result, and return its name."""
        name = self.new()
        self.lines.append(f"  {name} = {text}")
        return name

    def begin(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.label = label

    def new_label(self, name: str) -> str:
        self.count += 1
        return f"{name}{self.count}"

    def jump(self, label: str) -> None:
        self.lines.append(f"  br label %{label}")

    def call(self, result: str, name: str, arguments: Sequence[tuple[str, str]]) -> str:
        """Call a function that is declared elsewhere; arguments are (type, value)."""
        self.declared[f"declare {result} @{name}({', '.join(t for t, _ in arguments)})"] = None
        return self.add(f"call {result} @{name}({', '.join(f'{t} {v}' for t, v in arguments)})")

    def intrinsic(self, name: str, dtype: DTypeLike, vector: bool, *values: str) -> str:
        kind = self.type(dtype, vector)
        return self.call(kind, f"llvm.{name}.{self.suffix(dtype, vector)}", [(kind, v) for v in values])

    def suffix(self, dtype: DTypeLike, vector: bool) -> str:
        scalar = {"double": "f64", "float": "f32"}.get(self.scalar(dtype), self.scalar(dtype))
        return f"v{self.lanes}{scalar}" if vector else scalar

    def value(self, x: Value, vector: bool | None = None) -> str:
        """The name of a number's value, as a vector or as a scalar."""
        vector = self.varies(x) if vector is None else vector
        if x.is_constant:
            text = literal(x.data)
            return f"splat ({self.scalar(x.dtype)} {text})" if vector else text
        name = self.names[x]
        return self.splat(name, x.dtype) if vector and not self.varies(x) else name

    def splat(self, name: str, dtype: DTypeLike) -> str:
        kind, scalar = self.type(dtype, True), self.scalar(dtype)
        first = self.add(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        return self.add(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")


def literal(value: np.generic) -> str:
    dtype = np.asarray(value).dtype
    if dtype.kind == "f":
        return f"0x{np.float64(value).view(np.uint64):016X}"
    if dtype.kind == "b":
        return "true" if value else "false"
    return str(int(value))
