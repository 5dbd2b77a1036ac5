"""What all members share in each iteration of a loop, computed once: for all blocks, not in each of them.

The position on an orbit at the time of a step is a few hundred operations, as many as the step of a vector of members
that uses it. So a program in which such numbers depend on a loop's counter alone is split in two. The first computes
them and writes them down, the second reads them: both go through the same loops, and through nothing else that depends
on data, so the order of writing is that of reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from lieint_jax.native._program import Block, Branch, Loop, Number, Program

_FEW = 30  # operations that are not worth a table


class Stream(NamedTuple):
    """A program, split.

    Attributes:
        first: computes and writes what is shared.
        rest: all else.
        numbers: what is written, by the loop's body in which it is computed.
    """

    first: Program
    rest: Program
    numbers: dict[Block, list[Number]]


def split(program: Program) -> Stream | None:
    """The two programs, or None if next to nothing is shared inside loops."""
    loops = list(_loops(program.block, program))
    shared = {
        x
        for loop in loops
        for x in _numbers(loop.body)
        if x in program.live and x not in program.varying and x.dtype.kind == "f" and x.op != "array"
    }
    if not shared:
        return None
    rest = program.without(shared)
    numbers = {loop.body: [x for x in _numbers(loop.body) if x in shared and x in rest.live] for loop in loops}
    numbers = {body: some for body, some in numbers.items() if some}
    tests = [loop.test for loop in loops]  # else what does not change in a loop would be no reason to go through it
    first = program.only([*tests, *(x for some in numbers.values() for x in some)])
    if sum(_length(body, first) for body in numbers) <= _FEW:
        return None
    return Stream(first, rest, numbers)


def _loops(block: Block, program: Program) -> Iterator[Loop]:
    """The loops that all members go through alike, and which change what is theirs."""
    for item in block.items:
        alike = isinstance(item, Loop) and item.test not in program.varying
        if alike and any(x in program.varying and x in program.live for x in item.carries):
            yield item
            yield from _loops(item.body, program)


def _numbers(body: Block) -> Iterator[Number]:
    """The numbers that a block itself computes."""
    for item in body.items:
        if isinstance(item, Number):
            yield item
        else:
            yield from item.results


def _length(block: Block, program: Program) -> int:
    """The operations of a block that a program needs, those of inner loops as often as these may go around."""
    found = 0
    for item in block.items:
        if isinstance(item, Number):
            found += item in program.live
        elif isinstance(item, Branch):
            found += sum(_length(side, program) for side in item.blocks)
        elif any(x in program.live for x in item.carries):
            found += 4 * (_length(item.head, program) + _length(item.body, program))
    return found
