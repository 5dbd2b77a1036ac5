"""From a program of numbers to LLVM IR, where every number that depends on the member is a vector of members.

The generated function loops over blocks of members, and in each over rows (the save intervals of a call, or the steps
of a `march`). Arrays have NumPy's layout: (members, …) for data of each member, (rows, …) for data of each row, and
(rows, members, …) for data of each member and row and for results, of which only each `every`-th row may be stored.
Lanes of the last block beyond the last member repeat that member.

A product that is used once, in a sum, is fused with it (`llvm.fma`). The compiler may not change any other rounding, so
results depend neither on the number of lanes nor on LLVM's optimizations.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from lieint_jax.native._llvm.loops import Loops, Tape
from lieint_jax.native._program import Column, Program, Value
from lieint_jax.native._traced import Leaf
from lieint_jax.native.functions import Functions


def emit(
    name: str,
    program: Program,
    leaves: Sequence[Leaf],
    results: Sequence[int],
    lanes: int,
    functions: Functions,
    tape: Tape | None = None,
    reverse: bool = False,
    row_lanes: int = 0,
) -> str:
    """The text of a module with a function that runs a part of the rows.

    Args:
        name: of the function.
        program: its first outputs are the numbers carried to the next row, one for each entry of the leaves of kind
            "carry"; the others are the results of each row.
        leaves: the arrays that it reads; the data of an argument is (number of the leaf, number of the entry).
        results: the sizes of the result arrays of one row.
        lanes: members in a vector.
        functions: collects the elementary functions that it calls.
        tape: the numbers that it writes for another program, or reads.
        reverse: whether the last row comes first.
        row_lanes: see `Loops`.

    The function's arguments are the first block and the one after the last, the number of members, the first row and
    the one after the last, the number of all rows, how many rows each stored one stands for, and pointers to: the
    leaves that are in memory; the carries after these rows, leaf by leaf; the results; the tape, of 8 bytes per number,
    and two integers, its capacity and how many numbers there were to write. Nothing is written beyond its end.
    """
    return _Writer(program, lanes, leaves, functions, tape, row_lanes).text(name, results, reverse)


class _Writer(Loops):
    def text(self, name: str, results: Sequence[int], reverse: bool) -> str:
        self.results, self.reverse = results, reverse
        slots = itertools.count()
        self.inputs = ["" if leaf.kind == "counter" else self.pointer(next(slots)) for leaf in self.leaves]
        carried = [k for k, leaf in enumerate(self.leaves) if leaf.kind == "carry"]
        outputs = _outputs(self.program, [*(self.leaves[k].size for k in carried), *results])
        self.after, self.stored = dict(zip(carried, outputs, strict=False)), outputs[len(carried) :]
        self.carry_outputs = [self.pointer(next(slots)) for _ in carried]
        self.row_outputs = [self.pointer(next(slots)) for _ in self.results]
        if self.results:
            self.lines.append("  %stored = sdiv i64 %rows, %every")
            self.lines.append("  %first.stored = sdiv i64 %begin, %every")
            self.lines.append("  %behind = srem i64 %begin, %every")
            self.lines.append("  %first.left = sub i64 %every, %behind")
        if self.tape is not None:
            self.tape_pointer, counts = self.pointer(next(slots)), self.pointer(next(slots))
            self.front.append("  %cursor = alloca i64")
            self.capacity = self.add(f"load i64, ptr {counts}")
            self.count_pointer = self.add(f"getelementptr i64, ptr {counts}, i64 1")
        used = [x for x in self.program.live if x.op == "argument"]
        used.sort(key=lambda x: x.data)
        self.columns = sorted((x for x in self.program.live if x.op == "column"), key=lambda x: x.data)
        for x in used:
            leaf = self.leaves[x.data[0]]
            if leaf.kind == "shared":
                self.names[x] = self.load(self.inputs[x.data[0]], leaf.dtype, str(x.data[1]))
        self.fill("shared")
        before = self.label
        self.jump("block.head")
        self.begin("block.head")
        self.lines.append(f"  %block = phi i64 [ %first, %{before} ], [ %block.next, %block.end ]")
        self.lines.append("  %more.blocks = icmp slt i64 %block, %last")
        self.lines.append("  br i1 %more.blocks, label %block.body, label %done")
        self.begin("block.body")
        if self.tape is not None:
            self.lines.append("  store i64 0, ptr %cursor")
        self.index = self.member_index()
        for x in used:
            if self.leaves[x.data[0]].kind in ("carry", "member"):
                self.names[x] = self.gather(self.inputs[x.data[0]], self.leaves[x.data[0]], x.data[1])
        self.fill("carry", "member")
        self.rows(used)
        self.begin("block.end")
        self.lines.append("  %block.next = add i64 %block, 1")
        self.jump("block.head")
        self.begin("done")
        if self.tape is not None and self.tape.writes:
            self.lines.append(f"  store i64 {self.add('load i64, ptr %cursor')}, ptr {self.count_pointer}")
        self.reserve()
        self.lines.append("  ret void")
        numbers = ", ".join(f"i64 %{x}" for x in ("first", "last", "members", "begin", "end", "rows", "every"))
        self.define(name, f"void @{name}({numbers}, ptr %pointers) nounwind")
        return self.module.text()

    def fill(self, *kinds: str) -> None:
        """Read columns of leaves of these kinds."""
        for x in self.columns:
            leaf, pointer = self.leaves[x.data.leaf], self.inputs[x.data.leaf]
            if leaf.kind in kinds:
                self.names[x] = self.new_array(x.length, x)
                with self.counted_loop("fill", x.length) as k:
                    at = self.entry_at(x.data, k)
                    value = self.gather(pointer, leaf, at) if leaf.varies else self.load(pointer, leaf.dtype, at)
                    self.store(value, leaf.dtype, self.place(self.names[x], leaf.dtype, k, leaf.varies), leaf.varies)

    def entry_at(self, column: Column, k: str) -> str:
        """The place in its leaf, or in a result, of an entry of a column."""
        return self.add(f"add i64 {self.add(f'mul i64 {k}, {column.stride}')}, {column.first}")

    def write_column(self, x: Value, pointer: str, size: int, row: str | None = None) -> None:
        """Write a column of a result; of what is carried, as it is before the next row."""
        with self.counted_loop("write", x.length) as k:
            at = self.entry_pointers(pointer, x.dtype, size, self.entry_at(x.data, k), row)
            self.scatter(self.as_vector(x.inputs[-1], k), x.dtype, at)

    def rows(self, used: list[Value]) -> None:
        """The loop over rows."""
        arguments = {x.data: x for x in used if self.leaves[x.data[0]].kind == "carry"}
        carries = [(k, entry) for k, found in self.after.items() for entry, x in found if x.op != "stored"]
        starts = [
            self.names[arguments[k, entry]]
            if (k, entry) in arguments
            else self.gather(self.inputs[k], self.leaves[k], entry)
            for k, entry in carries
        ]
        before, head = self.label, "row.head"
        self.jump(head)
        self.begin(head)
        row = self.new()
        place = len(self.lines)
        inside = {at: self.new() for at in carries}
        self.names.update((x, inside[at]) for at, x in arguments.items())
        more = self.new()
        self.lines.append(f"  {more} = icmp slt i64 {row}, %end")
        self.lines.append(f"  br i1 {more}, label %row.body, label %row.exit")
        self.begin("row.body")
        at = self.from_the_end("%rows", row) if self.reverse else row
        for x in used:
            self.read_row(x, at)
        self.body(self.program.block)
        outputs = [x for found in self.after.values() for _, x in found]
        following = [self.value(x, True) for x in outputs if x.op != "stored"]
        store = self.store_rows() if self.results else []
        for x in outputs:
            if x.op == "stored":
                array, column = x.inputs
                self.copy(column, array)
        after = self.add(f"add i64 {row}, 1")
        end = self.label
        self.jump(head)
        phis = [f"  {row} = phi i64 [ %begin, %{before} ], [ {after}, %{end} ]"]
        for (leaf, entry), start, value in zip(carries, starts, following, strict=True):
            kind = self.type(self.leaves[leaf].dtype, True)
            phis.append(f"  {inside[leaf, entry]} = phi {kind} [ {start}, %{before} ], [ {value}, %{end} ]")
        self.lines[place:place] = [*phis, *(line.format(before=before, end=end) for line in store)]
        self.begin("row.exit")
        for (k, found), pointer in zip(self.after.items(), self.carry_outputs, strict=True):
            leaf = self.leaves[k]
            for entry, x in found:
                if x.op == "stored":
                    self.write_column(x, pointer, leaf.size)
                else:
                    at = self.entry_pointers(pointer, leaf.dtype, leaf.size, entry)
                    self.scatter(inside[k, entry], leaf.dtype, at)
        self.jump("block.end")

    def from_the_end(self, count: str, index: str) -> str:
        return self.add(f"sub i64 {self.add(f'sub i64 {count}, 1')}, {index}")

    def read_row(self, x: Value, row: str) -> None:
        """An argument that differs from row to row, if it is one."""
        leaf, pointer = self.leaves[x.data[0]], self.inputs[x.data[0]]
        if leaf.kind == "counter":
            self.names[x] = self.add(f"trunc i64 {row} to i32" if leaf.dtype.itemsize == 4 else f"add i64 {row}, 0")
        elif leaf.kind == "row":
            index = self.add(f"add i64 {self.add(f'mul i64 {row}, {leaf.size}')}, {x.data[1]}")
            self.names[x] = self.load(pointer, leaf.dtype, index)
        elif leaf.kind == "series":
            at = self.entry_pointers(pointer, leaf.dtype, leaf.size, x.data[1], row)
            self.names[x] = self.gather_at(at, leaf.dtype)

    def store_rows(self) -> list[str]:
        """Store each `every`-th row; returns the phis of its counters, for labels `before` and `end` of the loop."""
        left, stored = "%left", "%stored.row"
        due = self.add(f"icmp eq i64 {left}, 1")
        self.lines.append(f"  br i1 {due}, label %row.store, label %row.after")
        self.begin("row.store")
        at = self.from_the_end("%stored", stored) if self.reverse else stored
        for found, size, pointer in zip(self.stored, self.results, self.row_outputs, strict=True):
            for entry, x in found:
                if x.op == "stored":
                    self.write_column(x, pointer, size, at)
                else:
                    self.scatter(self.value(x, True), x.dtype, self.entry_pointers(pointer, x.dtype, size, entry, at))
        self.jump("row.after")
        self.begin("row.after")
        fewer = self.add(f"sub i64 {left}, 1")
        fewer = self.add(f"select i1 {due}, i64 %every, i64 {fewer}")
        more = self.add(f"add i64 {stored}, {self.add(f'zext i1 {due} to i64')}")
        return [
            f"  {left} = phi i64 [ %first.left, %{{before}} ], [ {fewer}, %{{end}} ]",
            f"  {stored} = phi i64 [ %first.stored, %{{before}} ], [ {more}, %{{end}} ]",
        ]


def _outputs(program: Program, sizes: Sequence[int]) -> list[list[tuple[int, Value]]]:
    """For each result, of such a size, its numbers or columns, with the first entry that each of them is."""
    left = iter(program.outputs)
    found = []
    for size in sizes:
        parts, count = [], 0
        while count < size:
            x = next(left)
            parts.append((x.data.first, x) if x.op == "stored" else (count, x))
            count += x.length if x.op == "stored" else 1
        found.append(parts)
    return found
