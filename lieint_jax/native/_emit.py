"""From a program of numbers to LLVM IR, where every number that depends on the member is a vector of members.

The generated function loops over blocks of members, and in each over rows (the save intervals of a call, or the steps
of a `march`). Arrays have NumPy's layout: (members, …) for data of each member, (rows, …) for data of each row, and
(rows, members, …) for data of each member and row and for results, of which only each `every`-th row may be stored.
Lanes of the last block beyond the last member repeat that member. In loops and branches of the program each member of
a vector goes its own way.

A product that is used once, in a sum, is fused with it (`llvm.fma`). The compiler may not change any other rounding, so
results depend neither on the number of lanes nor on LLVM's optimizations.
"""

from __future__ import annotations

import collections
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lieint_jax.native._operations import Operations
from lieint_jax.native._program import Block, Branch, Column, Loop, Map, Program, Value
from lieint_jax.native._traced import Leaf
from lieint_jax.native.functions import Functions


class Tape(NamedTuple):
    """Numbers that one program writes and another reads, in the common order of their loops.

    Attributes:
        numbers: the numbers, by the body of the loop that computes them.
        writes: True if this program writes them.
    """

    numbers: dict[Block, list[Value]]
    writes: bool


class Writer(Operations):
    """A function that runs a part of the rows.

    Args:
        program: its first outputs are the numbers carried to the next row, one for each entry of the leaves of kind
            "carry"; the others are the results of each row.
        lanes: members in a vector.
        leaves: the arrays that it reads; the data of an argument is (number of the leaf, number of the entry).
        functions: collects the elementary functions that it calls.
        tape: the numbers that it writes for another program, or reads.
        row_lanes: the most rows of a map that are lanes, if there is one member; 0 if the members are.
    """

    def __init__(
        self,
        program: Program,
        lanes: int,
        leaves: Sequence[Leaf],
        functions: Functions,
        tape: Tape | None = None,
        row_lanes: int = 0,
    ):
        super().__init__(program, lanes, leaves, functions)
        self.of_rows, shortest = program.depending_on_rows() if row_lanes else (set(), 0)
        self.width = min(row_lanes, 1 << shortest.bit_length() - 1) if shortest else 0
        self.tape, self.tape_pointer, self.capacity = tape, "", ""

    def text(self, name: str, results: Sequence[int], reverse: bool) -> str:
        """The text of a module with this function.

        Its arguments are the first block and the one after the last, the number of members, the first row and the one
        after the last, the number of all rows, how many rows each stored one stands for, and pointers to: the leaves
        that are in memory; the carries after these rows, leaf by leaf; the results; the tape, of 8 bytes per number,
        and two integers, its capacity and how many numbers there were to write. Nothing is written beyond its end.

        Args:
            name: of the function.
            results: the sizes of the result arrays of one row.
            reverse: whether the last row comes first.
        """
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
        self.used = sorted(
            (x for x in self.program.live if x.op in ("argument", "column")), key=lambda x: (x.op, x.data)
        )
        self.read_leaves("shared")
        with self.counted_loop("block", "%last", first="%first") as block:
            if self.tape is not None:
                self.lines.append("  store i64 0, ptr %cursor")
            self.index = self.member_index(block)
            self.read_leaves("carry", "member")
            self.rows()
        if self.tape is not None and self.tape.writes:
            self.lines.append(f"  store i64 {self.add('load i64, ptr %cursor')}, ptr {self.count_pointer}")
        self.reserve()
        self.lines.append("  ret void")
        numbers = ", ".join(f"i64 %{x}" for x in ("first", "last", "members", "begin", "end", "rows", "every"))
        self.define(name, f"void @{name}({numbers}, ptr %pointers) nounwind")
        return self.module.text()

    def read_leaves(self, *kinds: str, row: str | None = None) -> None:
        """Read the arguments and the columns of leaves of these kinds, at a row if they have rows."""
        for x in self.used:
            leaf, pointer, entry = self.leaves[x.data[0]], self.inputs[x.data[0]], x.data[1]
            if leaf.kind not in kinds:
                continue
            if leaf.kind == "counter":
                self.names[x] = self.add(f"trunc i64 {row} to i32" if leaf.dtype.itemsize == 4 else f"add i64 {row}, 0")
            elif x.op == "argument":
                if leaf.kind == "row":
                    entry = self.add(f"add i64 {self.add(f'mul i64 {row}, {leaf.size}')}, {entry}")
                self.names[x] = self.read_entry(pointer, leaf, entry, row)
            else:
                self.names[x] = self.new_array(x.length, x)
                with self.counted_loop("fill", x.length) as k:
                    value = self.read_entry(pointer, leaf, self.entry_at(x.data, k))
                    self.store(value, leaf.dtype, self.place(self.names[x], leaf.dtype, k, leaf.varies), leaf.varies)

    def read_entry(self, pointer: str, leaf: Leaf, entry: int | str, row: str | None = None) -> str:
        """An entry of a leaf; a vector if each member has its own."""
        if not leaf.varies:
            return self.load(pointer, leaf.dtype, str(entry))
        return self.gather(self.entry_pointers(pointer, leaf.dtype, leaf.size, entry, row), leaf.dtype)

    def entry_at(self, column: Column, k: str) -> str:
        """The place in its leaf, or in a result, of an entry of a column."""
        return self.add(f"add i64 {self.add(f'mul i64 {k}, {column.stride}')}, {column.first}")

    def write_result(
        self, x: Value, pointer: str, size: int, entry: int, row: str | None = None, value: str = ""
    ) -> None:
        """Write a number of a result, or another `value` of it; or a column: if carried, as before the next row."""
        if x.op != "stored":
            value = value or self.value(x, True)
            self.scatter(value, x.dtype, self.entry_pointers(pointer, x.dtype, size, entry, row))
            return
        with self.counted_loop("write", x.length) as k:
            at = self.entry_pointers(pointer, x.dtype, size, self.entry_at(x.data, k), row)
            self.scatter(self.as_vector(x.inputs[-1], k), x.dtype, at)

    def rows(self) -> None:
        """The loop over rows."""
        arguments = {x.data: x for x in self.used if x.op == "argument" and self.leaves[x.data[0]].kind == "carry"}
        carries = [(k, entry) for k, found in self.after.items() for entry, x in found if x.op != "stored"]
        starts = [
            self.names[arguments[at]]
            if at in arguments
            else self.read_entry(self.inputs[at[0]], self.leaves[at[0]], at[1])
            for at in carries
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
        self.read_leaves("counter", "row", "series", row=at)
        self.body(self.program.block)
        outputs = [x for found in self.after.values() for _, x in found]
        following = [self.value(x, True) for x in outputs if x.op != "stored"]
        store = self.store_rows() if self.results else []
        for x in outputs:
            if x.op == "stored":
                array, column = x.inputs
                self.copy(column, array)
        after = self.add(f"add i64 {row}, 1")
        phis = [(row, "i64", "%begin", after), *store]
        for (leaf, entry), start, value in zip(carries, starts, following, strict=True):
            phis.append((inside[leaf, entry], self.type(self.leaves[leaf].dtype, True), start, value))
        self.insert_phis(place, before, phis)
        self.jump(head)
        self.begin("row.exit")
        for (k, found), pointer in zip(self.after.items(), self.carry_outputs, strict=True):
            for entry, x in found:
                self.write_result(x, pointer, self.leaves[k].size, entry, value=inside.get((k, entry), ""))

    def from_the_end(self, count: str, index: str) -> str:
        return self.add(f"sub i64 {self.add(f'sub i64 {count}, 1')}, {index}")

    def store_rows(self) -> list[tuple[str, str, str, str]]:
        """Store each `every`-th row; returns what the loop carries for it, see `insert_phis`."""
        left, stored = "%left", "%stored.row"
        due = self.add(f"icmp eq i64 {left}, 1")
        self.lines.append(f"  br i1 {due}, label %row.store, label %row.after")
        self.begin("row.store")
        at = self.from_the_end("%stored", stored) if self.reverse else stored
        for found, size, pointer in zip(self.stored, self.results, self.row_outputs, strict=True):
            for entry, x in found:
                self.write_result(x, pointer, size, entry, at)
        self.jump("row.after")
        self.begin("row.after")
        fewer = self.add(f"sub i64 {left}, 1")
        fewer = self.add(f"select i1 {due}, i64 %every, i64 {fewer}")
        more = self.add(f"add i64 {stored}, {self.add(f'zext i1 {due} to i64')}")
        return [(left, "i64", "%first.left", fewer), (stored, "i64", "%first.stored", more)]

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, Value):
                if item in self.program.live and item not in self.absorbed and item not in self.names:
                    self.names[item] = self.operation(item)
            elif isinstance(item, Loop):
                self.loop(item)
            elif isinstance(item, Branch):
                self.branch(item)
            else:
                self.map(item)

    def loop(self, loop: Loop) -> None:
        carried = self.program.needed_positions(loop.carries)
        if not carried:
            return
        arrays = [k for k in carried if loop.starts[k].is_array]
        for k in arrays:
            array = self.new_array(loop.starts[k].length, loop.carries[k])
            self.names[loop.carries[k]] = self.names[loop.results[k]] = array
            self.copy(loop.carries[k], loop.starts[k])
        carried = [k for k in carried if k not in arrays]
        masked = self.varies(loop.test)
        starts = [self.value(loop.starts[k], self.varies(loop.carries[k])) for k in carried]
        before, head, body, exit_ = self.label, *(self.new_label(x) for x in ("loop.head", "loop.body", "loop.exit"))
        self.jump(head)
        self.begin(head)
        place = len(self.lines)
        mask = f"<{self.lanes} x i1>"
        active = self.new() if masked else ""
        for k in carried:
            self.names[loop.carries[k]] = self.names[loop.results[k]] = self.new()
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
                value = self.value(after, True)
                value = self.add(f"select {mask} {going}, {kind} {value}, {kind} {self.names[inside]}")
            else:
                value = self.value(after, self.varies(inside))
            following.append(value)
        for k in arrays:
            self.copy(loop.carries[k], loop.following[k], going)
        phis = [(active, mask, "splat (i1 true)", going)] if masked else []
        for k, start, after in zip(carried, starts, following, strict=True):
            phis.append((self.names[loop.carries[k]], self.type_of(loop.carries[k]), start, after))
        self.insert_phis(place, before, phis)
        self.jump(head)
        self.begin(exit_)

    def map(self, item: Map) -> None:
        """A loop over rows; of one member, over as many rows as there are lanes, of which the last end with the last.

        So some rows are computed twice, with the same results.
        """
        live = [(x, rows) for x, rows in zip(item.values, item.results, strict=True) if rows in self.program.live]
        if not live:
            return
        for _, rows in live:
            self.names[rows] = self.new_array(item.length, rows)
        with self.counted_loop("map", item.length, self.width or 1) as row:
            if self.width:
                self.rows_at_once(item, live, row)
            else:
                self.names[item.index] = row
                self.block(item.body)
                for x, rows in live:
                    self.write(self.names[rows], row, x, self.varies(x))

    def rows_at_once(self, item: Map, live: list[tuple[Value, Value]], row: str) -> None:
        """The body of a map, for rows that are lanes."""
        members, self.lanes = self.lanes, self.width
        self.outside, self.names = self.names, collections.ChainMap({}, self.names)
        self.first_row = self.intrinsic("smin", "i64", row, str(item.length - self.width))
        each = ", ".join(f"i64 {k}" for k in range(self.width))
        self.names[item.index] = self.add(f"add <{self.lanes} x i64> {self.splat(self.first_row, np.int64)}, <{each}>")
        self.block(item.body)
        for x, rows in live:
            at = self.place(self.names[rows], x.dtype, self.first_row, False)
            self.store(self.value(x, True), x.dtype, at, True, f", align {x.dtype.itemsize}")
        self.names, self.outside, self.lanes = self.outside, None, members

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

    def branch(self, branch: Branch) -> None:
        live = self.program.needed_positions(branch.results)
        if not live:
            return
        test = branch.test
        if self.varies(test):
            for side in branch.blocks:
                self.block(side)
            chosen = f"{self.type(bool, True)} {self.value(test)}"
            for k in live:
                kind = self.type(branch.results[k].dtype, True)
                yes, no = (self.value(values[k], True) for values in branch.values)
                self.names[branch.results[k]] = self.add(f"select {chosen}, {kind} {yes}, {kind} {no}")
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
