"""Values of a program, as scalars or as vectors of members, and entries of arrays in memory, in NumPy's layout."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._llvm.text import Module, Text, constant, suffix, with_lanes
from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._program import Program, Value
from lieint_jax.native._traced import Leaf

_TYPES = {"f8": "double", "f4": "float", "b1": "i1"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}


class Memory(Text):
    """Text with the values of a program, and with access to arrays.

    Args:
        program: the program that it computes.
        lanes: members in a vector.
        leaves: the arrays that the program reads.
    """

    def __init__(self, program: Program, lanes: int, leaves: Sequence[Leaf]):
        super().__init__(Module())
        self.program, self.lanes, self.leaves = program, lanes, leaves
        self.names: MutableMapping[Value, str] = {}
        self.outside: Mapping[Value, str] | None = None  # the names outside of a map whose rows are the lanes
        self.of_rows: set[Value] = set()  # the numbers that differ from row to row
        self.inputs: list[str] = []  # pointers to the arrays
        self.index = ""  # the indices of the block's members

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

    def pointer(self, slot: int) -> str:
        at = self.add(f"getelementptr ptr, ptr %pointers, i64 {slot}")
        return self.add(f"load ptr, ptr {at}")

    def stored_type(self, dtype: DTypeLike, vector: bool = False) -> str:
        """The type of numbers in memory; booleans are bytes there."""
        return self.type(np.int8 if np.dtype(dtype).kind == "b" else dtype, vector)

    def place(self, array: str, dtype: DTypeLike, k: str, vector: bool) -> str:
        """The address of an entry of an array."""
        return self.add(f"getelementptr {self.stored_type(dtype, vector)}, ptr {array}, i64 {k}")

    def store(self, value: str, dtype: DTypeLike, at: str, vector: bool, align: str = "") -> None:
        """Write a value to an address."""
        kind, value = self.stored_type(dtype, vector), self.as_stored(value, dtype, vector)
        self.lines.append(f"  store {kind} {value}, ptr {at}{align}")

    def as_stored(self, value: str, dtype: DTypeLike, vector: bool) -> str:
        """A value as it is in memory."""
        if np.dtype(dtype).kind != "b":
            return value
        return self.add(f"zext {self.type(bool, vector)} {value} to {self.stored_type(dtype, vector)}")

    def from_stored(self, value: str, dtype: DTypeLike, vector: bool) -> str:
        """A value that was read from memory."""
        if np.dtype(dtype).kind != "b":
            return value
        return self.add(f"trunc {self.stored_type(dtype, vector)} {value} to {self.type(bool, vector)}")

    def load(self, array: str, dtype: DTypeLike, k: str, vector: bool = False) -> str:
        """An entry of an array, as it is or as a vector."""
        at = self.place(array, dtype, k, vector)
        return self.from_stored(self.add(f"load {self.stored_type(dtype, vector)}, ptr {at}"), dtype, vector)

    def member_index(self) -> str:
        """The indices of the block's members, a vector; none is beyond the last member."""
        first = self.splat(self.add(f"mul i64 %block, {self.lanes}"), np.int64)
        last = self.splat(self.add("sub i64 %members, 1"), np.int64)
        kind = f"<{self.lanes} x i64>"
        each = ", ".join(f"i64 {k}" for k in range(self.lanes))
        index = self.add(f"add {kind} {first}, <{each}>")
        return self.intrinsic("smin", kind, index, last)

    def entry_pointers(
        self, pointer: str, dtype: DTypeLike, size: int, entry: int | str, row: str | None = None
    ) -> str:
        """Pointers to an entry of each member of the block."""
        kind = f"<{self.lanes} x i64>"
        index, stored = self.index, self.stored_type(dtype)
        if size != 1:
            index = self.add(f"mul {kind} {index}, splat (i64 {size})")
        if row is not None:
            start = self.add(f"mul i64 {row}, %members")
            start = self.add(f"mul i64 {start}, {size}")
            pointer = self.add(f"getelementptr {stored}, ptr {pointer}, i64 {start}")
        if entry:
            pointer = self.add(f"getelementptr {stored}, ptr {pointer}, i64 {entry}")
        return self.add(f"getelementptr {stored}, ptr {pointer}, {kind} {index}")

    def gather(self, pointer: str, leaf: Leaf, entry: int | str) -> str:
        at = self.entry_pointers(pointer, leaf.dtype, leaf.size, entry)
        return self.gather_at(at, leaf.dtype)

    def gather_at(self, at: str, dtype: DTypeLike) -> str:
        kind, n = self.stored_type(dtype, True), self.lanes
        name = f"llvm.masked.gather.{suffix(kind)}.v{n}p0"
        mask = f"<{n} x i1>", "splat (i1 true)"
        return self.from_stored(self.call(kind, name, [(f"<{n} x ptr>", at), mask, (kind, "poison")]), dtype, True)

    def scatter(self, value: str, dtype: DTypeLike, at: str) -> None:
        kind, n = self.stored_type(dtype, True), self.lanes
        value = self.as_stored(value, dtype, True)
        name = f"llvm.masked.scatter.{suffix(kind)}.v{n}p0"
        self.module.declared[f"declare void @{name}({kind}, <{n} x ptr>, <{n} x i1>)"] = None
        self.lines.append(f"  call void @{name}({kind} {value}, <{n} x ptr> {at}, <{n} x i1> splat (i1 true))")
