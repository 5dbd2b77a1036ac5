"""Loops and branches, in which each member of a vector goes its own way, and the tape of shared numbers."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lieint_jax.native._llvm.operations import Operations
from lieint_jax.native._program import Block, Branch, Loop, Map, Program, Value
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


class Loops(Operations):
    """Text with the loops and branches of a program.

    Args:
        program, lanes, leaves, functions: see `Operations`.
        tape: the numbers that the program writes for another, or reads.
        row_lanes: the most rows of a map that are lanes, if there is one member; 0 if the members are.
    """

    def __init__(
        self,
        program: Program,
        lanes: int,
        leaves: Sequence[Leaf],
        functions: Functions,
        tape: Tape | None,
        row_lanes: int = 0,
    ):
        super().__init__(program, lanes, leaves, functions)
        self.of_rows, shortest = program.depending_on_rows() if row_lanes else (set(), 0)
        self.width = min(row_lanes, 1 << shortest.bit_length() - 1) if shortest else 0
        self.tape, self.tape_pointer, self.capacity = tape, "", ""
        self.wide = "i64" if any(leaf.dtype == np.float64 for leaf in leaves) else "i32"

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, Loop):
                self.loop(item)
            elif isinstance(item, Branch):
                self.branch(item)
            elif isinstance(item, Map):
                self.map(item)
            elif item in self.program.live and item not in self.absorbed and item not in self.names:
                self.names[item] = self.operation(item)

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
        starts = [self.into_phi(self.value(loop.starts[k], self.varies(x := loop.carries[k])), x) for k in carried]
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
                value = self.select(f"{mask} {going}", kind, self.value(after, True), self.names[inside])
            else:
                value = self.value(after, self.varies(inside))
            following.append(self.into_phi(value, inside))
        for k in arrays:
            self.copy(loop.carries[k], loop.following[k], going)
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

    @property
    def mask_type(self) -> str:
        """The type of the members' booleans that a loop carries: integers as wide as a number."""
        return f"<{self.lanes} x {self.wide}>"

    def phi_type(self, carry: Value) -> str:
        return self.mask_type if carry.dtype.kind == "b" and self.varies(carry) else self.type_of(carry)

    def into_phi(self, value: str, carry: Value) -> str:
        kind, mask = self.type_of(carry), self.phi_type(carry)
        return value if kind == mask else self.add(f"sext {kind} {value} to {mask}")

    def out_of_phi(self, phi: str, carry: Value) -> str:
        kind, mask = self.type_of(carry), self.phi_type(carry)
        return phi if kind == mask else self.add(f"trunc {mask} {phi} to {kind}")

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
                self.names[branch.results[k]] = self.select(chosen, kind, yes, no)
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
