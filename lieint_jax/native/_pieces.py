"""The modules of a kernel: its steps, and, where members share numbers, their computation for a piece of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lieint_jax.native._emit import emit
from lieint_jax.native._llvm.loops import Tape
from lieint_jax.native._program import Program
from lieint_jax.native._stream import split
from lieint_jax.native._traced import Leaf, leaves_before_rows
from lieint_jax.native.functions import Functions

_CAPACITY = 4096  # numbers of a piece, if a row has no more: 32 KiB, which stay in the cache
_ALL_ROWS = """
declare void @steps(i64, i64, i64, i64, i64, i64, i64, ptr)
define void @run(i64 %first, i64 %last, i64 %members, i64 %rows, i64 %every, ptr %pointers) {
  call void @steps(i64 %first, i64 %last, i64 %members, i64 0, i64 %rows, i64 %rows, i64 %every, ptr %pointers)
  ret void
}
"""


class Modules(NamedTuple):
    """Texts of modules with the function `run` of a kernel.

    Attributes:
        texts: to be compiled together.
        shared: about how many numbers of a row its members share.
    """

    texts: list[str]
    shared: int


def modules(
    program: Program,
    leaves: Sequence[Leaf],
    results: Sequence[int],
    lanes: int,
    reverse: bool = False,
    row_lanes: int = 0,
) -> Modules:
    """The modules of a kernel; the arguments are those of `emit`.

    The arguments of `run` are the first block and the one after the last, the numbers of members and of rows, how many
    rows each stored one stands for, and pointers to the leaves that are in memory; the carries after the last row, leaf
    by leaf; the results.
    """
    functions = Functions()
    parts = split(program, leaves) if lanes > 1 else None
    if parts is None:
        text = emit("steps", program, leaves, results, lanes, functions, reverse=reverse, row_lanes=row_lanes)
        return Modules([text, _ALL_ROWS, functions.text()], 0)
    rest = emit("steps", parts.rest, leaves, results, lanes, functions, Tape(parts.numbers, writes=False), reverse)
    before = leaves_before_rows(leaves)
    first = emit("first", parts.first, before, [], 1, functions, Tape(parts.numbers, writes=True), reverse)
    arguments = sum(leaf.kind != "counter" for leaf in leaves)
    carries = sum(leaf.kind == "carry" for leaf in leaves)
    shared = sum(map(len, parts.numbers.values()))
    constants = {
        "arguments": arguments,
        "results": carries + len(results),
        "carries": carries,
        "capacity": max(_CAPACITY, shared),
        "per.row": shared,
    }
    lines = [f"@{name} = internal constant i64 {x}" for name, x in constants.items()]
    pieces = "\n".join([*lines, Path(__file__).with_suffix(".ll").read_text()])
    return Modules([rest, first, pieces, functions.text()], shared)
