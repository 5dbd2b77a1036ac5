"""From a program of numbers to LLVM IR, where every number that depends on the member is a vector of members.

The generated function loops over blocks of members, and in each over rows (the save intervals of a call). Arrays have
NumPy's layout: (members, …) for data of each member, (rows, …) for data of each row, and (rows, members, …) for the
results of each row. Lanes of the last block beyond the last member repeat that member.

A product that is used once, in a sum, is fused with it (`llvm.fma`). The compiler may not change any other rounding, so
results depend neither on the number of lanes nor on LLVM's optimizations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike

from lieint_jax.native._calls import Functions
from lieint_jax.native._program import Block, Branch, Loop, Number, Program, blocks_of, numbers_of
from lieint_jax.native._traced import Leaf
from lieint_jax.native._walk import UnsupportedError

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
_ARITHMETIC = {"add": ("fadd", "add"), "sub": ("fsub", "sub"), "mul": ("fmul", "mul"), "div": ("fdiv", "sdiv")}
_ORDERED = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_SIGNED = {"eq": "eq", "ne": "ne", "lt": "slt", "le": "sle", "gt": "sgt", "ge": "sge"}
_INTRINSICS = {
    "abs": "fabs",
    "ceil": "ceil",
    "floor": "floor",
    "max": "maximum",
    "min": "minimum",
    "round_away": "round",
    "round_even": "roundeven",
    "sqrt": "sqrt",
}
_BITS = {"and": "and", "or": "or", "xor": "xor", "shift_left": "shl", "shift_right_logical": "lshr"} | {
    "shift_right_arithmetic": "ashr"
}


class Tape(NamedTuple):
    """Numbers that one program writes and another reads, in the common order of their loops.

    Attributes:
        numbers: the numbers, by the body of the loop that computes them.
        writes: True if this program writes them.
    """

    numbers: dict[Block, list[Number]]
    writes: bool


def emit(
    program: Program,
    leaves: Sequence[Leaf],
    results: Sequence[int],
    lanes: int,
    functions: Functions,
    tape: Tape | None = None,
) -> str:
    """The text of a module with the function `run`.

    Args:
        program: its first outputs are the numbers carried to the next row, one for each entry of the leaves of kind
            "carry"; the others are the results of each row.
        leaves: the arrays that it reads; the data of an argument is (number of the leaf, number of the entry).
        results: the sizes of the result arrays of one row.
        lanes: members in a vector.
        functions: collects the elementary functions that it calls.
        tape: the numbers that it writes for another program, or reads.

    The function's arguments are the first block and the one after the last, the numbers of members and of rows, and
    pointers to: the leaves; the carries after the last row, leaf by leaf; the results; the tape, of 8 bytes per number,
    and two integers, its capacity and how many numbers there were to write. Nothing is written beyond its end.
    """
    return _Writer(program, leaves, results, lanes, functions, tape).text()


class _Writer:
    def __init__(
        self,
        program: Program,
        leaves: Sequence[Leaf],
        results: Sequence[int],
        lanes: int,
        functions: Functions,
        tape: Tape | None,
    ):
        self.tape = tape
        self.program, self.leaves, self.results, self.lanes = program, leaves, results, lanes
        self.carried = len(program.outputs) - sum(results)
        self.functions = functions
        self.lines: list[str] = []
        self.front: list[str] = []
        self.globals: dict[object, str] = {}
        self.declared: dict[str, None] = {}
        self.label = "entry"
        self.names: dict[Number, str] = {}
        self.count = 0
        self.fused, self.absorbed = _fusions(program)
        self.wide = "i64" if any(leaf.dtype == np.float64 for leaf in leaves) else "i32"

    # names and types

    def new(self) -> str:
        self.count += 1
        return f"%v{self.count}"

    def varies(self, x: Number) -> bool:
        return x in self.program.varying

    def scalar(self, dtype: DTypeLike) -> str:
        name = np.dtype(dtype).str[1:]
        if name not in _TYPES:
            raise UnsupportedError(f"numbers of type {np.dtype(dtype)}")
        return _TYPES[name]

    def type(self, dtype: DTypeLike, vector: bool) -> str:
        return f"<{self.lanes} x {self.scalar(dtype)}>" if vector else self.scalar(dtype)

    def type_of(self, x: Number) -> str:
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

    def value(self, x: Number, vector: bool | None = None) -> str:
        """The name of a number's value, as a vector or as a scalar."""
        vector = self.varies(x) if vector is None else vector
        if x.is_constant:
            text = _literal(x.data)
            return f"splat ({self.scalar(x.dtype)} {text})" if vector else text
        name = self.names[x]
        return self.splat(name, x.dtype) if vector and not self.varies(x) else name

    def splat(self, name: str, dtype: DTypeLike) -> str:
        kind, scalar = self.type(dtype, True), self.scalar(dtype)
        first = self.add(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        return self.add(f"shufflevector {kind} {first}, {kind} poison, <{self.lanes} x i32> zeroinitializer")

    # the function

    def text(self) -> str:
        pointers = self.leaves, _carry_leaves(self.leaves), self.results
        slots = iter(range(sum(len(x) for x in pointers) + 2))
        self.inputs, self.carry_outputs, self.row_outputs = ([self.pointer(next(slots)) for _ in x] for x in pointers)
        if self.tape is not None:
            self.tape_pointer, counts = self.pointer(next(slots)), self.pointer(next(slots))
            self.front.append("  %cursor = alloca i64")
            self.capacity = self.add(f"load i64, ptr {counts}")
            self.count_pointer = self.add(f"getelementptr i64, ptr {counts}, i64 1")
        used = [x for x in self.program.live if x.op == "argument"]
        used.sort(key=lambda x: x.data)
        for x in used:
            leaf = self.leaves[x.data[0]]
            if leaf.kind == "shared":
                self.names[x] = self.load(self.inputs[x.data[0]], leaf.dtype, str(x.data[1]))
        self.jump("block.head")
        self.begin("block.head")
        self.lines.append("  %block = phi i64 [ %first, %entry ], [ %block.next, %block.end ]")
        self.lines.append("  %more.blocks = icmp slt i64 %block, %last")
        self.lines.append("  br i1 %more.blocks, label %block.body, label %done")
        self.begin("block.body")
        if self.tape is not None:
            self.lines.append("  store i64 0, ptr %cursor")
        self.index = self.member_index()
        for x in used:
            if self.leaves[x.data[0]].varies:
                self.names[x] = self.gather(self.inputs[x.data[0]], self.leaves[x.data[0]], x.data[1])
        self.rows(used)
        self.begin("block.end")
        self.lines.append("  %block.next = add i64 %block, 1")
        self.jump("block.head")
        self.begin("done")
        if self.tape is not None and self.tape.writes:
            self.lines.append(f"  store i64 {self.add('load i64, ptr %cursor')}, ptr {self.count_pointer}")
        self.lines.append("  ret void")
        head = "define void @run(i64 %first, i64 %last, i64 %members, i64 %rows, ptr %pointers) #0 {\nentry:"
        tail = "}\nattributes #0 = { nounwind }"
        parts = [*self.globals.values(), *self.declared, head, *self.front, *self.lines, tail]
        return "\n".join(parts) + "\n"

    def pointer(self, slot: int) -> str:
        at = self.add(f"getelementptr ptr, ptr %pointers, i64 {slot}")
        return self.add(f"load ptr, ptr {at}")

    def load(self, pointer: str, dtype: DTypeLike, index: str) -> str:
        stored = "i8" if np.dtype(dtype).kind == "b" else self.scalar(dtype)
        at = self.add(f"getelementptr {stored}, ptr {pointer}, i64 {index}")
        found = self.add(f"load {stored}, ptr {at}")
        return self.add(f"trunc i8 {found} to i1") if np.dtype(dtype).kind == "b" else found

    def member_index(self) -> str:
        """The indices of the block's members, a vector; none is beyond the last member."""
        first = self.splat(self.add(f"mul i64 %block, {self.lanes}"), np.int64)
        last = self.splat(self.add("sub i64 %members, 1"), np.int64)
        kind = f"<{self.lanes} x i64>"
        each = ", ".join(f"i64 {k}" for k in range(self.lanes))
        index = self.add(f"add {kind} {first}, <{each}>")
        return self.intrinsic("smin", np.int64, True, index, last)

    def entry_pointers(self, pointer: str, dtype: DTypeLike, size: int, entry: int, row: str | None = None) -> str:
        """Pointers to an entry of each member of the block."""
        kind = f"<{self.lanes} x i64>"
        stored = "i8" if np.dtype(dtype).kind == "b" else self.scalar(dtype)
        index = self.index
        if size != 1:
            index = self.add(f"mul {kind} {index}, splat (i64 {size})")
        if row is not None:
            start = self.add(f"mul i64 {row}, %members")
            start = self.add(f"mul i64 {start}, {size}")
            pointer = self.add(f"getelementptr {stored}, ptr {pointer}, i64 {start}")
        if entry:
            pointer = self.add(f"getelementptr {stored}, ptr {pointer}, i64 {entry}")
        return self.add(f"getelementptr {stored}, ptr {pointer}, {kind} {index}")

    def gather(self, pointer: str, leaf: Leaf, entry: int) -> str:
        at = self.entry_pointers(pointer, leaf.dtype, leaf.size, entry)
        return self.gather_at(at, leaf.dtype)

    def gather_at(self, at: str, dtype: DTypeLike) -> str:
        stored = np.dtype(np.int8) if np.dtype(dtype).kind == "b" else np.dtype(dtype)
        kind, n = self.type(stored, True), self.lanes
        name = f"llvm.masked.gather.{self.suffix(stored, True)}.v{n}p0"
        mask = f"<{n} x i1>", "splat (i1 true)"
        found = self.call(kind, name, [(f"<{n} x ptr>", at), mask, (kind, "poison")])
        return self.add(f"trunc {kind} {found} to <{n} x i1>") if np.dtype(dtype).kind == "b" else found

    def scatter(self, value: str, dtype: DTypeLike, at: str) -> None:
        stored = np.dtype(np.int8) if np.dtype(dtype).kind == "b" else np.dtype(dtype)
        kind, n = self.type(stored, True), self.lanes
        if np.dtype(dtype).kind == "b":
            value = self.add(f"zext <{n} x i1> {value} to {kind}")
        name = f"llvm.masked.scatter.{self.suffix(stored, True)}.v{n}p0"
        self.declared[f"declare void @{name}({kind}, <{n} x ptr>, <{n} x i1>)"] = None
        self.lines.append(f"  call void @{name}({kind} {value}, <{n} x ptr> {at}, <{n} x i1> splat (i1 true))")

    def rows(self, used: list[Number]) -> None:
        """The loop over rows."""
        arguments = {x.data: x for x in used if self.leaves[x.data[0]].kind == "carry"}
        carries = [(k, arguments.get(at)) for k, at in enumerate(_carry_entries(self.leaves))]
        starts = {k: self.names[x] for k, x in carries if x is not None}
        whole = {
            k: self.gather(self.inputs[at[0]], self.leaves[at[0]], at[1])
            for k, at in enumerate(_carry_entries(self.leaves))
            if k not in starts
        }
        before, head = self.label, "row.head"
        self.jump(head)
        self.begin(head)
        row = self.new()
        place = len(self.lines)
        inside: dict[int, str] = {}
        for k, x in carries:
            inside[k] = self.new()
            if x is not None:
                self.names[x] = inside[k]
        more = self.new()
        self.lines.append(f"  {more} = icmp slt i64 {row}, %rows")
        self.lines.append(f"  br i1 {more}, label %row.body, label %row.exit")
        self.begin("row.body")
        for x in used:
            leaf = self.leaves[x.data[0]]
            if leaf.kind == "row":
                index = self.add(f"mul i64 {row}, {leaf.size}")
                index = self.add(f"add i64 {index}, {x.data[1]}")
                self.names[x] = self.load(self.inputs[x.data[0]], leaf.dtype, index)
        self.block(self.program.block)
        following = {k: self.value(x, True) for k, x in enumerate(self.program.outputs[: self.carried])}
        results = iter(self.program.outputs[self.carried :])
        for size, pointer in zip(self.results, self.row_outputs, strict=True):
            for entry in range(size):
                x = next(results)
                self.scatter(self.value(x, True), x.dtype, self.entry_pointers(pointer, x.dtype, size, entry, row))
        after = self.add(f"add i64 {row}, 1")
        end = self.label
        self.jump(head)
        entries = list(_carry_entries(self.leaves))
        phis = [f"  {row} = phi i64 [ 0, %{before} ], [ {after}, %{end} ]"]
        for k, (leaf, _) in enumerate(entries):
            kind = self.type(self.leaves[leaf].dtype, True)
            start = starts.get(k) or whole[k]
            phis.append(f"  {inside[k]} = phi {kind} [ {start}, %{before} ], [ {following[k]}, %{end} ]")
        self.lines[place:place] = phis
        self.begin("row.exit")
        leaves = _carry_leaves(self.leaves)
        for k, (leaf, entry) in enumerate(entries):
            pointer = self.carry_outputs[leaves.index(leaf)]
            at = self.entry_pointers(pointer, self.leaves[leaf].dtype, self.leaves[leaf].size, entry)
            self.scatter(inside[k], self.leaves[leaf].dtype, at)
        self.jump("block.end")

    # operations

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, Loop):
                self.loop(item)
            elif isinstance(item, Branch):
                self.branch(item)
            elif item in self.program.live and item not in self.absorbed and item not in self.names:
                self.names[item] = self.operation(item)

    def operation(self, x: Number) -> str:
        vector = self.varies(x)
        if x in self.fused:
            product, other, sign = self.fused[x]
            a, b = (self.value(y, vector) for y in product.inputs)
            c = self.value(other, vector)
            kind = self.type(x.dtype, vector)
            if sign == "product":
                a = self.add(f"fneg {kind} {a}")
            elif sign == "other":
                c = self.add(f"fneg {kind} {c}")
            return self.intrinsic("fma", x.dtype, vector, a, b, c)
        method = getattr(self, f"op_{x.op}", None)
        if method is not None:
            return method(x, vector)
        values = [self.value(y, vector) for y in x.inputs]
        kind = self.type(x.inputs[0].dtype, vector)
        real = x.inputs[0].dtype.kind == "f"
        if x.op in _ARITHMETIC:
            name = "udiv" if x.op == "div" and x.dtype.kind == "u" else _ARITHMETIC[x.op][not real]
            return self.add(f"{name} {kind} {values[0]}, {values[1]}")
        if x.op in _ORDERED:
            compare = f"fcmp {_ORDERED[x.op]}" if real else f"icmp {self.predicate(x)}"
            return self.add(f"{compare} {kind} {values[0]}, {values[1]}")
        if x.op in _BITS:
            return self.add(f"{_BITS[x.op]} {kind} {values[0]}, {values[1]}")
        if x.op in _INTRINSICS and real:
            return self.intrinsic(_INTRINSICS[x.op], x.dtype, vector, *values)
        name = self.functions.name(x.op, self.scalar(x.dtype), self.lanes if vector else 0, len(values))
        return self.call(kind, name, [(kind, value) for value in values])

    def predicate(self, x: Number) -> str:
        found = _SIGNED[x.op]
        return found.replace("s", "u", 1) if x.inputs[0].dtype.kind in "ub" and found[0] == "s" else found

    def op_neg(self, x: Number, vector: bool) -> str:
        kind, value = self.type(x.dtype, vector), self.value(x.inputs[0], vector)
        if x.dtype.kind == "f":
            return self.add(f"fneg {kind} {value}")
        return self.add(f"sub {kind} {'zeroinitializer' if vector else '0'}, {value}")

    def op_abs(self, x: Number, vector: bool) -> str:
        value = self.value(x.inputs[0], vector)
        if x.dtype.kind == "f":
            return self.intrinsic("fabs", x.dtype, vector, value)
        kind = self.type(x.dtype, vector)
        name = f"llvm.abs.{self.suffix(x.dtype, vector)}"
        return self.call(kind, name, [(kind, value), ("i1", "false")])

    def op_max(self, x: Number, vector: bool) -> str:
        values = [self.value(y, vector) for y in x.inputs]
        name = {"f": {"max": "maximum", "min": "minimum"}, "i": {"max": "smax", "min": "smin"}}
        name |= {"u": {"max": "umax", "min": "umin"}, "b": {"max": "umax", "min": "umin"}}
        return self.intrinsic(name[x.dtype.kind][x.op], x.dtype, vector, *values)

    op_min = op_max

    def op_not(self, x: Number, vector: bool) -> str:
        kind = self.type(x.dtype, vector)
        ones = "true" if x.dtype.kind == "b" else "-1"
        ones = f"splat ({self.scalar(x.dtype)} {ones})" if vector else ones
        return self.add(f"xor {kind} {self.value(x.inputs[0], vector)}, {ones}")

    def op_select(self, x: Number, vector: bool) -> str:
        test, on_true, on_false = x.inputs
        kind = self.type(x.dtype, vector)
        tested = self.varies(test)
        return self.add(
            f"select {self.type(bool, tested)} {self.value(test, tested)}, {kind} {self.value(on_true, vector)}, "
            f"{kind} {self.value(on_false, vector)}"
        )

    def op_convert(self, x: Number, vector: bool) -> str:
        [y] = x.inputs
        a, b, value = self.type(y.dtype, vector), self.type(x.dtype, vector), self.value(y, vector)
        before, after = y.dtype, x.dtype
        if after.kind == "b":
            zero = "zeroinitializer" if vector else ("0.0" if before.kind == "f" else "0")
            return self.add(f"{'fcmp une' if before.kind == 'f' else 'icmp ne'} {a} {value}, {zero}")
        if before.kind == "f" and after.kind == "f":
            return self.add(f"{'fpext' if after.itemsize > before.itemsize else 'fptrunc'} {a} {value} to {b}")
        if before.kind == "f":
            how = "fptosi" if after.kind == "i" else "fptoui"
            name = f"llvm.{how}.sat.{self.suffix(after, vector)}.{self.suffix(before, vector)}"
            return self.call(b, name, [(a, value)])
        if after.kind == "f":
            return self.add(f"{'sitofp' if before.kind == 'i' else 'uitofp'} {a} {value} to {b}")
        if before.kind == "b" or after.itemsize > before.itemsize:
            return self.add(f"{'sext' if before.kind == 'i' else 'zext'} {a} {value} to {b}")
        return value if a == b else self.add(f"trunc {a} {value} to {b}")

    def op_sin(self, x: Number, vector: bool) -> str:
        """The sine or cosine; if both are needed, one call computes both."""
        scalar, kind = self.scalar(x.dtype), self.type(x.dtype, vector)
        lanes, [angle] = self.lanes if vector else 0, x.inputs
        other = (
            x.block.by_operation.get(("cos" if x.op == "sin" else "sin", x.inputs, x.dtype, None)) if x.block else None
        )
        if other is None or other not in self.program.live:
            return self.call(kind, self.functions.name(x.op, scalar, lanes, 1), [(kind, self.value(angle, vector))])
        pair = f"{{ {kind}, {kind} }}"
        both = self.call(pair, self.functions.name("sincos", scalar, lanes, 1), [(kind, self.value(angle, vector))])
        sine, cosine = (self.add(f"extractvalue {pair} {both}, {k}") for k in (0, 1))
        self.names[other] = cosine if x.op == "sin" else sine
        return sine if x.op == "sin" else cosine

    op_cos = op_sin

    def op_rem(self, x: Number, vector: bool) -> str:
        kind, values = self.type(x.dtype, vector), [self.value(y, vector) for y in x.inputs]
        name = {"f": "frem", "i": "srem", "u": "urem"}[x.dtype.kind]
        return self.add(f"{name} {kind} {values[0]}, {values[1]}")

    def op_values(self, x: Number, vector: bool) -> str:
        if x.data not in self.globals:
            dtype, values = np.dtype(x.data[0]), np.frombuffer(x.data[1], x.data[0])
            scalar = "i8" if dtype.kind == "b" else self.scalar(dtype)
            entries = ", ".join(f"{scalar} {_literal(v) if dtype.kind != 'b' else int(v)}" for v in values)
            name = f"@values{len(self.globals)}"
            self.globals[x.data] = f"{name} = private constant [{len(values)} x {scalar}] [{entries}]"
        return self.read(self.globals[x.data].split(" ")[0], x, vector)

    def op_table(self, x: Number, vector: bool) -> str:
        return self.read(self.inputs[x.data], x, vector)

    def read(self, pointer: str, x: Number, vector: bool) -> str:
        """The entry of an array in memory whose index is the input of x."""
        if not vector:
            return self.load(pointer, x.dtype, self.value(x.inputs[0], False))
        stored = "i8" if x.dtype.kind == "b" else self.scalar(x.dtype)
        at = self.add(f"getelementptr {stored}, ptr {pointer}, <{self.lanes} x i64> {self.value(x.inputs[0], True)}")
        return self.gather_at(at, x.dtype)

    def op_array(self, x: Number, vector: bool) -> str:
        kind, name = self.type(np.int8 if x.dtype.kind == "b" else x.dtype, vector), self.new()
        self.front.append(f"  {name} = alloca [{len(x.inputs)} x {kind}], align 64")
        for k, y in enumerate(x.inputs):
            value = self.value(y, vector)
            if x.dtype.kind == "b":
                value = self.add(f"zext {self.type(bool, vector)} {value} to {kind}")
            at = self.add(f"getelementptr {kind}, ptr {name}, i64 {k}")
            self.lines.append(f"  store {kind} {value}, ptr {at}")
        return name

    def op_entry(self, x: Number, vector: bool) -> str:
        index, array = x.inputs
        if not self.varies(index):
            stored, vector = np.int8 if x.dtype.kind == "b" else x.dtype, self.varies(array)
            kind = self.type(stored, vector)
            at = self.add(f"getelementptr {kind}, ptr {self.names[array]}, i64 {self.value(index, False)}")
            found = self.add(f"load {kind}, ptr {at}")
            return found if x.dtype.kind != "b" else self.add(f"trunc {kind} {found} to {self.type(bool, vector)}")
        kind, found = self.type(x.dtype, True), self.value(array.inputs[0], True)
        for k, y in enumerate(array.inputs[1:], 1):
            here = self.add(f"icmp eq <{self.lanes} x i64> {self.value(index, True)}, splat (i64 {k})")
            found = self.add(f"select <{self.lanes} x i1> {here}, {kind} {self.value(y, True)}, {kind} {found}")
        return found

    # loops and branches

    def loop(self, loop: Loop) -> None:
        carried = self.program.needed_positions(loop.carries)
        if not carried:
            return
        masked = self.varies(loop.test)
        starts = [self.into_phi(loop.starts[k], loop.carries[k]) for k in carried]
        before, head, body, exit_ = self.label, *(self.new_label(x) for x in ("loop.head", "loop.body", "loop.exit"))
        self.jump(head)
        self.begin(head)
        place = len(self.lines)
        phis = [self.new() for _ in carried]
        mask = f"<{self.lanes} x i1>"
        active = self.new() if masked else ""
        mask_phi = self.new() if masked else ""
        if masked:
            self.lines.append(f"  {active} = trunc {self.mask_type} {mask_phi} to {mask}")
        for k, phi in zip(carried, phis, strict=True):
            self.names[loop.carries[k]] = self.names[loop.results[k]] = self.out_of_phi(phi, loop.carries[k])
        self.block(loop.head)
        if masked:
            going = self.add(f"and {mask} {active}, {self.value(loop.test, True)}")
            test = self.call("i1", f"llvm.vector.reduce.or.v{self.lanes}i1", [(mask, going)])
        else:
            going, test = "", self.value(loop.test, False)
        self.lines.append(f"  br i1 {test}, label %{body}, label %{exit_}")
        self.begin(body)
        self.body(loop.body)
        following = []
        for k in carried:
            inside, after = loop.carries[k], loop.following[k]
            if masked and self.varies(inside):
                kind = self.type_of(inside)
                chosen = self.add(
                    f"select {mask} {going}, {kind} {self.value(after, True)}, {kind} {self.names[inside]}"
                )
                following.append(self.as_mask(chosen) if inside.dtype.kind == "b" else chosen)
            else:
                following.append(self.into_phi(after, inside))
        going = self.add(f"sext {mask} {going} to {self.mask_type}") if masked else ""
        end = self.label
        self.jump(head)
        text = []
        if masked:
            text.append(
                f"  {mask_phi} = phi {self.mask_type} [ splat ({self.wide} -1), %{before} ], [ {going}, %{end} ]"
            )
        for k, phi, start, after in zip(carried, phis, starts, following, strict=True):
            kind = self.phi_type(loop.carries[k])
            text.append(f"  {phi} = phi {kind} [ {start}, %{before} ], [ {after}, %{end} ]")
        self.lines[place:place] = text
        self.begin(exit_)

    def body(self, block: Block) -> None:
        """The body of a loop, with the numbers that are read from the tape or written to it."""
        shared = self.tape.numbers.get(block, []) if self.tape is not None else []
        if self.tape is None or not shared:
            self.block(block)
            return
        start = self.add("load i64, ptr %cursor")
        end = self.add(f"add i64 {start}, {len(shared)}")
        self.lines.append(f"  store i64 {end}, ptr %cursor")
        if self.tape.writes:
            self.block(block)
            fits = self.add(f"icmp sle i64 {end}, {self.capacity}")
            start = self.add(f"select i1 {fits}, i64 {start}, i64 0")
        for k, x in enumerate(shared):
            at = self.add(f"getelementptr i64, ptr {self.tape_pointer}, i64 {start}")
            at = self.add(f"getelementptr i64, ptr {at}, i64 {k}")
            if self.tape.writes:
                self.lines.append(f"  store {self.scalar(x.dtype)} {self.value(x, False)}, ptr {at}")
            else:
                self.names[x] = self.add(f"load {self.scalar(x.dtype)}, ptr {at}")
        if not self.tape.writes:
            self.block(block)

    @property
    def mask_type(self) -> str:
        """The type of the members' booleans that a loop carries: integers as wide as a number."""
        return f"<{self.lanes} x {self.wide}>"

    def phi_type(self, carry: Number) -> str:
        return self.mask_type if carry.dtype.kind == "b" and self.varies(carry) else self.type_of(carry)

    def as_mask(self, name: str) -> str:
        return self.add(f"sext <{self.lanes} x i1> {name} to {self.mask_type}")

    def into_phi(self, x: Number, carry: Number) -> str:
        value = self.value(x, self.varies(carry))
        return self.as_mask(value) if carry.dtype.kind == "b" and self.varies(carry) else value

    def out_of_phi(self, phi: str, carry: Number) -> str:
        if carry.dtype.kind == "b" and self.varies(carry):
            return self.add(f"trunc {self.mask_type} {phi} to <{self.lanes} x i1>")
        return phi

    def branch(self, branch: Branch) -> None:
        live = self.program.needed_positions(branch.results)
        if not live:
            return
        test = branch.test
        if self.varies(test):
            for side in branch.blocks:
                self.block(side)
            chosen = self.value(test)
            for k in live:
                kind = self.type(branch.results[k].dtype, True)
                yes, no = (self.value(values[k], True) for values in branch.values)
                self.names[branch.results[k]] = self.add(
                    f"select {self.type(bool, True)} {chosen}, {kind} {yes}, {kind} {no}"
                )
            return
        labels = [self.new_label(x) for x in ("yes", "no", "after")]
        self.lines.append(f"  br i1 {self.value(test, False)}, label %{labels[0]}, label %{labels[1]}")
        ends = []
        for label, side, values in zip(labels, branch.blocks, branch.values, strict=False):
            self.begin(label)
            self.block(side)
            found = [self.value(values[k], self.varies(branch.results[k])) for k in live]
            ends.append((found, self.label))
            self.jump(labels[2])
        self.begin(labels[2])
        (yes, end), (no, other) = ends
        for n, k in enumerate(live):
            kind = self.type_of(branch.results[k])
            self.names[branch.results[k]] = self.add(f"phi {kind} [ {yes[n]}, %{end} ], [ {no[n]}, %{other} ]")


def _carry_leaves(leaves: Sequence[Leaf]) -> list[int]:
    return [k for k, leaf in enumerate(leaves) if leaf.kind == "carry"]


def _carry_entries(leaves: Sequence[Leaf]) -> list[tuple[int, int]]:
    return [(k, entry) for k in _carry_leaves(leaves) for entry in range(leaves[k].size)]


def _literal(value: np.generic) -> str:
    dtype = np.asarray(value).dtype
    if dtype.kind == "f":
        return f"0x{np.float64(value).view(np.uint64):016X}"
    if dtype.kind == "b":
        return "true" if value else "false"
    return str(int(value))


def _fusions(program: Program) -> tuple[dict[Number, tuple[Number, Number, str]], set[Number]]:
    """The sums that are fused with a product, as (product, other term, which of them is negative), and the products."""
    uses: Counter[Number] = Counter([*program.outputs, *program.written])
    items: list[Number] = []

    def visit(block: Block) -> None:
        for item in block.items:
            if isinstance(item, Number):
                if item in program.live and item not in program.given:
                    uses.update(item.inputs)
                    items.append(item)
            else:
                uses.update(numbers_of(item))
                for inner in blocks_of(item):
                    visit(inner)

    visit(program.block)
    fused: dict[Number, tuple[Number, Number, str]] = {}
    absorbed: set[Number] = set()
    for x in items:
        if x.op not in ("add", "sub") or x.dtype.kind != "f":
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
