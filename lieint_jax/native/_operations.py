"""Values of a program, as scalars or as vectors of members, arrays in memory, in NumPy's layout, and operations."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from typing import ClassVar, Self

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._llvm import Module, Text, constant, instruction, literal, suffix, with_lanes
from lieint_jax.native._primitives.abstract_walk import NEXT, UnsupportedError
from lieint_jax.native._program import Program, Value, all_items, numbers_of
from lieint_jax.native._traced import Leaf
from lieint_jax.native.functions import Functions

# Bytes that arrays may have on the stack: LLVM needs three times as long where they come from the heap.
_STACK = 2**20 if sys.platform == "linux" else 2**17
_LINE = 64  # bytes of a line of the cache
_TYPES = {"f8": "double", "f4": "float", "b1": "i1"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}
_INTRINSICS = {  # of real numbers
    "abs": "fabs", "ceil": "ceil", "floor": "floor", "max": "maximum", "min": "minimum",
    "round_away": "round", "round_even": "roundeven", "sqrt": "sqrt",
}  # fmt: skip


class Operations(Text):
    """Text with the values of a program, and with access to arrays.

    Args:
        program: the program that it computes.
        lanes: members in a vector.
        leaves: the arrays that the program reads.
        functions: collects the elementary functions that it calls.
    """

    def __init__(self, program: Program, lanes: int, leaves: Sequence[Leaf], functions: Functions):
        super().__init__(Module())
        self.program, self.lanes, self.leaves, self.functions = program, lanes, leaves, functions
        self.names: MutableMapping[Value, str] = {}
        self.outside: Mapping[Value, str] | None = None  # the names outside of a map whose rows are the lanes
        self.of_rows: set[Value] = set()  # the numbers that differ from row to row
        self.first_row = ""  # of those that are lanes
        self.inputs: list[str] = []  # pointers to the arrays
        self.index = ""  # the indices of the block's members
        self.arrays: list[tuple[str, str, int, int]] = []  # in memory: name, type and number of entries, their bytes
        self.fused, self.absorbed = _fusions(program)

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
        kind = self.stored_type(dtype, vector)
        value = self.converted("zext", value, self.type(dtype, vector), kind)
        self.lines.append(f"  store {kind} {value}, ptr {at}{align}")

    def converted(self, instruction: str, value: str, before: str, after: str) -> str:
        """A value of one type as one of another, by an instruction if they differ."""
        return value if before == after else self.add(f"{instruction} {before} {value} to {after}")

    def from_stored(self, value: str, dtype: DTypeLike, vector: bool) -> str:
        """A value that was read from memory."""
        return self.converted("trunc", value, self.stored_type(dtype, vector), self.type(dtype, vector))

    def load(self, array: str, dtype: DTypeLike, k: str, vector: bool = False) -> str:
        """An entry of an array, as it is or as a vector."""
        at = self.place(array, dtype, k, vector)
        return self.from_stored(self.add(f"load {self.stored_type(dtype, vector)}, ptr {at}"), dtype, vector)

    def member_index(self, block: str) -> str:
        """The indices of a block's members, a vector; none is beyond the last member."""
        first = self.splat(self.add(f"mul i64 {block}, {self.lanes}"), np.int64)
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

    def gather(self, at: str, dtype: DTypeLike) -> str:
        kind, n = self.stored_type(dtype, True), self.lanes
        name = f"llvm.masked.gather.{suffix(kind)}.v{n}p0"
        mask = f"<{n} x i1>", "splat (i1 true)"
        return self.from_stored(self.call(kind, name, [(f"<{n} x ptr>", at), mask, (kind, "poison")]), dtype, True)

    def scatter(self, value: str, dtype: DTypeLike, at: str) -> None:
        kind, n = self.stored_type(dtype, True), self.lanes
        value = self.converted("zext", value, self.type(dtype, True), kind)
        name = f"llvm.masked.scatter.{suffix(kind)}.v{n}p0"
        self.module.declared[f"declare void @{name}({kind}, <{n} x ptr>, <{n} x i1>)"] = None
        self.lines.append(f"  call void @{name}({kind} {value}, <{n} x ptr> {at}, <{n} x i1> splat (i1 true))")

    def operation(self, x: Value) -> str:
        """The result of an operation, a new name in most cases."""
        vector = self.varies(x)
        if x in self.fused:
            product, other, sign = self.fused[x]
            a, b, c = (self.value(y, vector) for y in (*product.inputs, other))
            kind = self.type_of(x)
            if sign == "product":
                a = self.add(f"fneg {kind} {a}")
            elif sign == "other":
                c = self.add(f"fneg {kind} {c}")
            return self.intrinsic("fma", kind, a, b, c)
        if x.op in self.own:
            return self.own[x.op](self, x, vector)
        values = [self.value(y, vector) for y in x.inputs]
        kind = self.type(x.inputs[0].dtype, vector)
        name = instruction(x.op, x.inputs[0].dtype.kind)
        if name:
            return self.add(f"{name} {kind} {values[0]}, {values[1]}")
        if x.op in _INTRINSICS and x.dtype.kind == "f":
            return self.intrinsic(_INTRINSICS[x.op], kind, *values)
        if x.op in ("max", "min"):
            return self.intrinsic(f"{'s' if x.dtype.kind == 'i' else 'u'}{x.op}", kind, *values)
        if x.op == "abs":
            return self.call(kind, f"llvm.abs.{suffix(kind)}", [(kind, values[0]), ("i1", "false")])
        if x.op == "neg":
            return self.add(
                f"fneg {kind} {values[0]}" if x.dtype.kind == "f" else f"sub {kind} zeroinitializer, {values[0]}"
            )
        if x.op == "not":
            ones = constant(self.scalar(x.dtype), True if x.dtype.kind == "b" else -1, self.lanes * vector)
            return self.add(f"xor {kind} {values[0]}, {ones}")
        name = self.functions.name(x.op, self.scalar(x.dtype), self.lanes * vector, len(values))
        return self.call(kind, name, [(kind, value) for value in values])

    def op_select(self, x: Value, vector: bool) -> str:
        test, *sides = x.inputs
        tested, kind = f"{self.type_of(test)} {self.value(test)}", self.type_of(x)
        yes, no = (self.value(y, vector) for y in sides)
        return self.add(f"select {tested}, {kind} {yes}, {kind} {no}")

    def op_convert(self, x: Value, vector: bool) -> str:
        [y] = x.inputs
        a, b, value = self.type(y.dtype, vector), self.type(x.dtype, vector), self.value(y, vector)
        before, after = y.dtype, x.dtype
        if after.kind == "b":
            return self.add(f"{instruction('ne', before.kind)} {a} {value}, zeroinitializer")
        if before.kind == "f" and after.kind == "f":
            return self.add(f"{'fpext' if after.itemsize > before.itemsize else 'fptrunc'} {a} {value} to {b}")
        if before.kind == "f":
            how = "fptosi" if after.kind == "i" else "fptoui"
            return self.call(b, f"llvm.{how}.sat.{suffix(b)}.{suffix(a)}", [(a, value)])
        if after.kind == "f":
            return self.add(f"{'sitofp' if before.kind == 'i' else 'uitofp'} {a} {value} to {b}")
        if before.kind == "b" or after.itemsize > before.itemsize:
            return self.add(f"{'sext' if before.kind == 'i' else 'zext'} {a} {value} to {b}")
        return self.converted("trunc", value, a, b)

    def op_sin(self, x: Value, vector: bool) -> str:
        """The sine or cosine; if both are needed, one call computes both."""
        scalar, kind = self.scalar(x.dtype), self.type(x.dtype, vector)
        lanes, [angle] = self.lanes * vector, x.inputs
        key = "cos" if x.op == "sin" else "sin", x.inputs, x.dtype, None
        other = x.block.by_operation.get(key) if x.block else None
        if other is None or other not in self.program.live:
            return self.call(kind, self.functions.name(x.op, scalar, lanes, 1), [(kind, self.value(angle, vector))])
        pair = f"{{ {kind}, {kind} }}"
        both = self.call(pair, self.functions.name("sincos", scalar, lanes, 1), [(kind, self.value(angle, vector))])
        sine, cosine = (self.add(f"extractvalue {pair} {both}, {k}") for k in (0, 1))
        self.names[other] = cosine if x.op == "sin" else sine
        return sine if x.op == "sin" else cosine

    def op_values(self, x: Value, vector: bool) -> str:
        parts = self.module.parts
        if x.data not in parts:
            dtype, values = np.dtype(x.data[0]), np.frombuffer(x.data[1], x.data[0])
            scalar = self.stored_type(dtype)
            entries = ", ".join(f"{scalar} {literal(v) if dtype.kind != 'b' else int(v)}" for v in values)
            parts[x.data] = f"@values{len(parts)} = private constant [{len(values)} x {scalar}] [{entries}]"
        return self.read(parts[x.data].split(" ")[0], x, vector)

    def op_table(self, x: Value, vector: bool) -> str:
        return self.read(self.inputs[x.data], x, vector)

    def read(self, pointer: str, x: Value, vector: bool) -> str:
        """The entry of an array in memory whose index is the input of x."""
        if not vector:
            return self.load(pointer, x.dtype, self.value(x.inputs[0], False))
        kind, index = self.stored_type(x.dtype), self.value(x.inputs[0], True)
        at = self.add(f"getelementptr {kind}, ptr {pointer}, <{self.lanes} x i64> {index}")
        return self.gather(at, x.dtype)

    def op_array(self, x: Value, vector: bool) -> str:
        name = self.new_array(len(x.inputs), x)
        for k, y in enumerate(x.inputs):
            self.write(name, str(k), y, vector)
        return name

    def op_empty(self, x: Value, vector: bool) -> str:
        return ""  # the loop that writes it knows whether its entries vary

    def op_put(self, x: Value, vector: bool) -> str:
        array, k, y = x.inputs
        at = self.place(self.names[array], x.dtype, self.value(k, False), vector)
        if y.is_array:
            self.copy_to(at, vector, y, x.data)
        else:
            self.write(at, "0", y, vector)
        return self.names[array]

    def copy(self, to: Value, array: Value, going: str = "") -> None:
        """Write the entries of an array to another, for the members that go on if they are given."""
        if array.op == "empty" or self.names[array] == self.names[to]:
            return
        vector = self.varies(to)
        if not (going and vector):
            self.copy_to(self.names[to], vector, array, to.length)
            return
        with self.counted_loop("copy", to.length) as k:
            old, new = self.entry(to, k, True), self.as_vector(array, k)
            kind = self.type(to.dtype, True)
            chosen = self.add(f"select <{self.lanes} x i1> {going}, {kind} {new}, {kind} {old}")
            self.store(chosen, to.dtype, self.place(self.names[to], to.dtype, k, True), True)

    def copy_to(self, at: str, vector: bool, array: Value, count: int) -> None:
        """Write the first entries of an array to a place in memory."""
        if vector == self.varies(array):
            size = count * array.dtype.itemsize * (self.lanes if vector else 1)
            self.module.declared["declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)"] = None
            self.lines.append(
                f"  call void @llvm.memcpy.p0.p0.i64(ptr {at}, ptr {self.names[array]}, i64 {size}, i1 false)"
            )
            return
        with self.counted_loop("copy", count) as k:
            self.store(self.as_vector(array, k), array.dtype, self.place(at, array.dtype, k, True), True)

    def as_vector(self, array: Value, k: str) -> str:
        """An entry of an array, for each member."""
        entry = self.entry(array, k, self.varies(array))
        return entry if self.varies(array) else self.splat(entry, array.dtype)

    def new_array(self, length: int, x: Value) -> str:
        """Memory for the array that a number stands for."""
        vector, name = self.varies(x), self.new()
        size = x.dtype.itemsize * (self.lanes if vector else 1)
        self.arrays.append((name, self.stored_type(x.dtype, vector), length + 2 * NEXT, size))
        return name

    def reserve(self) -> None:
        """Memory for all arrays: on the stack, or, if they are large, from the heap, until the function ends."""
        total = 0
        large = sum(-(-n * size // _LINE) * _LINE for *_, n, size in self.arrays) > _STACK
        for name, kind, n, size in self.arrays:
            memory = self.new()
            if large:
                self.front.append(f"  {memory} = getelementptr i8, ptr %memory, i64 {total}")
                total += -(-n * size // _LINE) * _LINE
            else:
                self.front.append(f"  {memory} = alloca [{n} x {kind}], align {_LINE}")
            self.front.append(f"  {name} = getelementptr {kind}, ptr {memory}, i64 {NEXT}")
        if large:
            self.module.declared["declare ptr @malloc(i64)\ndeclare void @free(ptr)"] = None
            heap = [
                f"%heap = call ptr @malloc(i64 {total + _LINE})",
                f"%heap.end = getelementptr i8, ptr %heap, i64 {_LINE - 1}",
                f"%memory = call ptr @llvm.ptrmask.p0.i64(ptr %heap.end, i64 {-_LINE})",
            ]
            self.module.declared["declare ptr @llvm.ptrmask.p0.i64(ptr, i64)"] = None
            self.front[:0] = [f"  {line}" for line in heap]
            self.lines.append("  call void @free(ptr %heap)")

    def write(self, array: str, k: str, x: Value, vector: bool) -> None:
        self.store(self.value(x, vector), x.dtype, self.place(array, x.dtype, k, vector), vector)

    def op_entry(self, x: Value, vector: bool) -> str:
        index, array = x.inputs
        if not self.varies(index):
            return self.entry(array, self.value(index, False), self.varies(array))
        if array.op == "array":
            entries = [self.value(y, True) for y in array.inputs]
        else:
            entries = [self.entry(array, str(k), self.varies(array)) for k in range(array.length)]
            entries = entries if self.varies(array) else [self.splat(y, x.dtype) for y in entries]
        kind, found = self.type(x.dtype, True), entries[0]
        for k, y in enumerate(entries[1:], 1):
            here = self.add(f"icmp eq <{self.lanes} x i64> {self.value(index, True)}, splat (i64 {k})")
            found = self.add(f"select <{self.lanes} x i1> {here}, {kind} {y}, {kind} {found}")
        return found

    def op_row(self, x: Value, vector: bool) -> str:
        """The entry of an array in the row of a map, or in one near it; of several rows that are lanes."""
        (index, array), (first, stride) = x.inputs, x.data
        row = self.value(index, False) if self.outside is None else self.first_row
        k = row if stride == 1 else self.add(f"mul i64 {row}, {stride}")
        k = self.add(f"add i64 {k}, {first}") if first else k
        if self.outside is None:
            return self.entry(array, k, vector)
        at, scalar = self.place(self.names[array], x.dtype, k, False), self.stored_type(x.dtype)
        if stride != 1:
            each = ", ".join(f"i64 {j * stride}" for j in range(self.lanes))
            return self.gather(self.add(f"getelementptr {scalar}, ptr {at}, <{self.lanes} x i64> <{each}>"), x.dtype)
        found = self.add(f"load {self.stored_type(x.dtype, True)}, ptr {at}, align {x.dtype.itemsize}")
        return self.from_stored(found, x.dtype, True)

    own: ClassVar[dict[str, Callable[[Self, Value, bool], str]]] = {
        "array": op_array, "convert": op_convert, "cos": op_sin, "empty": op_empty, "entry": op_entry, "put": op_put,
        "row": op_row, "select": op_select, "sin": op_sin, "table": op_table, "values": op_values,
    }  # fmt: skip

    def entry(self, array: Value, k: str, vector: bool) -> str:
        return self.load(self.names[array], array.dtype, k, vector)


def _fusions(program: Program) -> tuple[dict[Value, tuple[Value, Value, str]], set[Value]]:
    """The sums that are fused with a product, as (product, other term, which of them is negative), and the products."""
    uses: Counter[Value] = Counter([*program.outputs, *program.written])
    needed = program.live - program.given
    items = [x for x in all_items(program.block) if not isinstance(x, Value) or x in needed]
    for item in items:
        uses.update(numbers_of(item))
    fused: dict[Value, tuple[Value, Value, str]] = {}
    absorbed: set[Value] = set()
    for x in items:
        if not isinstance(x, Value) or x.op not in ("add", "sub") or x.dtype.kind != "f":
            continue
        for n in (1, 0):
            product = x.inputs[n]
            alone = uses[product] == 1 and product.block is x.block and product not in absorbed
            if product.op == "mul" and alone and (product in program.varying) == (x in program.varying):
                sign = "" if x.op == "add" else ("other", "product")[n]
                fused[x] = (product, x.inputs[1 - n], sign)
                absorbed.add(product)
                break
    return fused, absorbed
