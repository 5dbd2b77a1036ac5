"""The modules of a kernel: its steps, and the numbers that all members share, computed once for all of them.

The position on an orbit at the time of a step costs a few hundred operations, as many as the step of a vector of
members that uses it. So a program in which such numbers depend on the counter of a loop only is split in two. The first
program computes and writes them for a piece of the rows, the second reads them. Both run through the same loops and
have no other control flow that depends on data, so the order of writing is the order of reading. The rows of a kernel
are such a loop, too.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from pathlib import Path

from lieint_jax.native._emit import Tape, Writer
from lieint_jax.native._program import Block, Loop, Program, Value
from lieint_jax.native._traced import Leaf
from lieint_jax.native.functions import Functions

_FEW = 30  # the most shared operations that are computed in every block instead
_CAPACITY = 4096  # numbers of a piece, if a row has no more: 32 KiB, which stay in the cache
_ALL_ROWS = """
declare void @steps(i64, i64, i64, i64, i64, i64, i64, ptr)
define void @run(i64 %first, i64 %last, i64 %members, i64 %rows, i64 %every, ptr %pointers) {
  call void @steps(i64 %first, i64 %last, i64 %members, i64 0, i64 %rows, i64 %rows, i64 %every, ptr %pointers)
  ret void
}
"""


def modules(
    program: Program,
    leaves: Sequence[Leaf],
    results: Sequence[int],
    lanes: int,
    reverse: bool = False,
    row_lanes: int = 0,
) -> tuple[list[str], int]:
    """The texts of modules that are compiled together, and about how many numbers of a row the members share.

    The arguments are those of `Writer` and its text.

    The arguments of their function `run` are the first block and the one after the last, the numbers of members and of
    rows, how many rows each stored one stands for, and pointers to the leaves that are in memory; the carries after the
    last row, leaf by leaf; the results.
    """
    functions = Functions()
    parts = _split(program, leaves) if lanes > 1 else None
    if parts is None:
        text = Writer(program, lanes, leaves, functions, row_lanes=row_lanes).text("steps", results, reverse)
        return [text, _ALL_ROWS, functions.text()], 0
    first, rest, numbers = parts
    rest = Writer(rest, lanes, leaves, functions, Tape(numbers, writes=False)).text("steps", results, reverse)
    before = [leaf._replace(kind="member") if leaf.kind == "carry" else leaf for leaf in leaves]  # the first row
    first = Writer(first, 1, before, functions, Tape(numbers, writes=True)).text("first", [], reverse)
    arguments = sum(leaf.kind != "counter" for leaf in leaves)
    carries = sum(leaf.kind == "carry" for leaf in leaves)
    shared = sum(map(len, numbers.values()))
    constants = {
        "arguments": arguments,
        "results": carries + len(results),
        "carries": carries,
        "capacity": max(_CAPACITY, shared),
        "per.row": shared,
    }
    lines = [f"@{name} = internal constant i64 {x}" for name, x in constants.items()]
    pieces = "\n".join([*lines, Path(__file__).with_suffix(".ll").read_text(encoding="utf-8")])
    return [rest, first, pieces, functions.text()], shared


def _split(program: Program, leaves: Sequence[Leaf]) -> tuple[Program, Program, dict[Block, list[Value]]] | None:
    """Two programs, and the numbers that the first writes for the second, by the body of the loop that computes them.

    None if hardly anything is shared inside loops.
    """
    loops = list(_loops(program.block, program))
    of_rows = program.depending_on(lambda x: leaves[x.data[0]].kind in ("counter", "row"))
    shared = {x for x in _numbers(program.block) if x in of_rows} | {x for loop in loops for x in _numbers(loop.body)}
    own = (x for x in shared if x in program.live and x not in program.varying)
    shared = {x for x in own if x.dtype.kind == "f" and not x.is_array}
    rest = Program(program.block, program.outputs, program.varying_arguments, given=frozenset(shared))
    bodies = program.block, *(loop.body for loop in loops)
    numbers = {body: [x for x in _numbers(body) if x in shared and x in rest.live] for body in bodies}
    numbers = {body: inside for body, inside in numbers.items() if inside}
    tests = [loop.test for loop in loops]  # included so that both programs run through the same loops
    written = [*tests, *(x for inside in numbers.values() for x in inside)]
    first = Program(program.block, [], program.varying_arguments, written)
    if sum(_length(body, first, numbers) for body in numbers) <= _FEW:
        return None
    return first, rest, numbers


def _loops(block: Block, program: Program) -> Iterator[Loop]:
    """The loops with the same iterations for all members that carry numbers of the members."""
    for item in block.items:
        if not isinstance(item, Loop) or item.test in program.varying:
            continue
        if any(x in program.varying and x in program.live for x in item.carries):
            yield item
            yield from _loops(item.body, program)


def _numbers(body: Block) -> Iterator[Value]:
    """The numbers of a block, without those inside its loops and branches."""
    for item in body.items:
        if isinstance(item, Value):
            yield item
        else:
            yield from item.results


def _length(block: Block, program: Program, others: Container[Block]) -> int:
    """The number of operations of a block that a program needs, without those of other bodies of loops.

    Those of inner loops count four times.
    """
    found = 0
    for item in block.items:
        if isinstance(item, Value):
            found += item in program.live
        elif not isinstance(item, Loop):
            found += sum(_length(inner, program, others) for inner in item.blocks)
        elif item.body not in others and any(x in program.live for x in item.carries):
            found += 4 * (_length(item.head, program, others) + _length(item.body, program, others))
    return found
