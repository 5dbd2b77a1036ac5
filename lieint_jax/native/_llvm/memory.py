"""Entries of arrays: loads and stores, for one value or a vector of members."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._llvm.text import suffix
from lieint_jax.native._llvm.values import Values
from lieint_jax.native._program import Program
from lieint_jax.native._traced import Leaf


class Memory(Values):
    """Text with access to arrays, whose layout is NumPy's.

    Args:
        program, lanes: see `Values`.
        leaves: the arrays that the program reads.
    """

    def __init__(self, program: Program, lanes: int, leaves: Sequence[Leaf]):
        super().__init__(program, lanes)
        self.leaves = leaves
        self.inputs: list[str] = []  # pointers to them
        self.index = ""  # the indices of the block's members

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
        kind = self.stored_type(dtype, vector)
        if np.dtype(dtype).kind == "b":
            value = self.add(f"zext {self.type(bool, vector)} {value} to {kind}")
        self.lines.append(f"  store {kind} {value}, ptr {at}{align}")

    def load(self, pointer: str, dtype: DTypeLike, index: str) -> str:
        stored = self.stored_type(dtype)
        found = self.add(f"load {stored}, ptr {self.place(pointer, dtype, index, False)}")
        return self.add(f"trunc i8 {found} to i1") if np.dtype(dtype).kind == "b" else found

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
        found = self.call(kind, name, [(f"<{n} x ptr>", at), mask, (kind, "poison")])
        return self.add(f"trunc {kind} {found} to <{n} x i1>") if np.dtype(dtype).kind == "b" else found

    def scatter(self, value: str, dtype: DTypeLike, at: str) -> None:
        kind, n = self.stored_type(dtype, True), self.lanes
        if np.dtype(dtype).kind == "b":
            value = self.add(f"zext <{n} x i1> {value} to {kind}")
        name = f"llvm.masked.scatter.{suffix(kind)}.v{n}p0"
        self.module.declared[f"declare void @{name}({kind}, <{n} x ptr>, <{n} x i1>)"] = None
        self.lines.append(f"  call void @{name}({kind} {value}, <{n} x ptr> {at}, <{n} x i1> splat (i1 true))")
