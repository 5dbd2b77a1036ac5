"""The numbers that all members share in an iteration of a loop, computed once for all blocks of members.

The position on an orbit at the time of a step costs a few hundred operations, as many as the step of a vector of
members that uses it. So a program in which such numbers depend on the counter of a loop only is split in two. The first
program computes and writes them, the second reads them. Both run through the same loops and have no other control flow
that depends on data, so the order of writing is the order of reading. The rows of a kernel are such a loop, too.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from typing import NamedTuple

from lieint_jax.native._program import Block, Loop, Program, Value, blocks_of
from lieint_jax.native._traced import Leaf

_FEW = 30  # the most shared operations that are computed in every block instead


class Stream(NamedTuple):
    """A program in two parts.

    Attributes:
        first: computes and writes the shared numbers.
        rest: computes everything else.
        numbers: the shared numbers, by the body of the loop that computes them.
    """

    first: Program
    rest: Program
    numbers: dict[Block, list[Value]]


def split(program: Program, leaves: Sequence[Leaf]) -> Stream | None:
    """Split a program in two; None if hardly anything is shared inside loops.

    Args:
        program: of one row.
        leaves: the arrays that it reads.
    """
    loops = list(_loops(program.block, program))
    of_rows = program.depending_on(lambda x: leaves[x.data[0]].kind in ("counter", "row"))
    shared = {x for x in _numbers(program.block) if x in of_rows} | {x for loop in loops for x in _numbers(loop.body)}
    shared = {x for x in shared if _is_shared(x, program)}
    rest = program.with_given(shared)
    bodies = program.block, *(loop.body for loop in loops)
    numbers = {body: [x for x in _numbers(body) if x in shared and x in rest.live] for body in bodies}
    numbers = {body: inside for body, inside in numbers.items() if inside}
    tests = [loop.test for loop in loops]  # included so that both programs run through the same loops
    first = program.part_that_computes([*tests, *(x for inside in numbers.values() for x in inside)])
    if sum(_length(body, first, numbers) for body in numbers) <= _FEW:
        return None
    return Stream(first, rest, numbers)


def _is_shared(x: Value, program: Program) -> bool:
    if x.op in ("argument", "constant") or x not in program.live or x in program.varying:
        return False
    return x.dtype.kind == "f" and not x.is_array


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
            found += sum(_length(inner, program, others) for inner in blocks_of(item))
        elif item.body not in others and any(x in program.live for x in item.carries):
            found += 4 * (_length(item.head, program, others) + _length(item.body, program, others))
    return found
