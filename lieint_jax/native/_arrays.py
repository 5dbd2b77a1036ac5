"""A program of numbers as JAX code on arrays of the members, for accelerators and for reversible gradients.

Every number that depends on the member is an array (members,), every other number a scalar. So XLA sees arithmetic
without axes and compiles the operations between two loops into one kernel, whose numbers stay in registers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr

from lieint_jax.native._primitives.abstract_walk import UnsupportedError, unsupported_if_it_fails
from lieint_jax.native._program import Block, Branch, Loop, Number, Program, blocks_of, numbers_of
from lieint_jax.native._traced import Leaf, Operation, Traced, Tree, make_once


def flatten(function: Callable[..., Tree] | ClosedJaxpr, kinds: Sequence[Tree], examples: Sequence[Tree]) -> Flattened:
    """The `Flattened` of a function that can be hashed, made once for all arguments of the same shapes."""
    return make_once(Flattened, function, kinds, examples)


class Flattened:
    """A function of one member, as a function of the arrays of all; for use inside of `jax.jit`.

    Args:
        function, kinds, examples: see `Traced`; a "row" is shared. If all are shared, it is the same function.

    Attributes:
        results: the shapes of the results of one member and one row.
        length: the number of operations.
        width: about how many registers of 32 bits the program needs, if each kernel covers the code between two loops.
        carried: the largest number of values of a member that a loop carries: an iteration reads and writes them.

    Raises:
        UnsupportedError: the function cannot be a program of numbers, or an operation has no counterpart in JAX.
    """

    def __init__(self, function: Callable[..., Tree] | ClosedJaxpr, kinds: Sequence[Tree], examples: Sequence[Tree]):
        self._traced = Traced(function, kinds, examples)
        self.results, self.length = self._traced.results, self._traced.length
        self.width, self.carried = width(self._traced.program), count_carried(self._traced.program)
        _check(self._traced.program.block, self._traced.program)

    @unsupported_if_it_fails()
    def __call__(self, *arguments: Tree, members: int | None = None) -> Tree:
        """The results, each with the leading axis (members,) if any argument has it, or if their number is given."""
        traced = self._traced
        leaves = zip(jax.tree.leaves(arguments), traced.leaves[: traced.given], strict=True)
        arrays: list[Any] = [jnp.asarray(x, leaf.dtype) for x, leaf in leaves]
        lengths = [len(x) for x, leaf in zip(arrays, traced.leaves, strict=False) if leaf.varies]
        members = lengths[0] if lengths else members
        arrays += computed_before(traced.outside, traced.leaves, arrays, members)
        found = _evaluate(traced.program, traced.leaves, arrays, members, jax.tree.leaves(self.results))
        return jax.tree.unflatten(jax.tree.structure(self.results), found)


def computed_before(
    operations: Sequence[Operation], leaves: Sequence[Leaf], arrays: Sequence[Any], members: int | None
) -> list[Array]:
    """The results of the operations that JAX computes before a program runs; arrays that are in no memory are None."""
    arrays, given = list(arrays), len(arrays)
    for x in operations:
        varies = x.kind == "member"
        arrays += x.results(_evaluate(x.program, leaves, arrays, members if varies else None, x.operands))
    return arrays[given:]


def _evaluate(
    program: Program,
    leaves: Sequence[Leaf],
    arrays: Sequence[Any],
    members: int | None,
    shapes: Sequence[jax.ShapeDtypeStruct],
) -> list[Array]:
    """The outputs of a program as arrays (members, …), or (…) if they are shared."""

    def entry(k: int, at: int) -> Array:
        return arrays[k].reshape(*([len(arrays[k])] if leaves[k].varies else []), -1)[..., at]

    axes = () if members is None else (members,)
    values = {x: entry(*x.data) for x in program.live if x.op == "argument"}
    evaluation = _Evaluation(program, members or 1, dict(enumerate(arrays)), values)
    evaluation.block(program.block)
    outputs = iter(program.outputs)
    found = []
    for shape in shapes:
        entries = [evaluation.value(next(outputs), bool(axes)) for _ in range(int(np.prod(shape.shape)))]
        stacked = jnp.stack(entries, -1) if entries else jnp.zeros(0, shape.dtype)
        found.append(stacked.reshape(*axes, *shape.shape))
    return found


Carry = tuple[list[Array], Array | None]  # what a loop carries: its numbers, and which members go on


class _Evaluation:
    """The values of a program's numbers, inside a block and those around it."""

    def __init__(self, program: Program, members: int, tables: dict[int, Array], values: dict[Number, Any]):
        self.program, self.members, self.tables, self.values = program, members, tables, values

    def inner(self) -> _Evaluation:
        """An evaluation of a block that JAX traces separately."""
        return _Evaluation(self.program, self.members, self.tables, dict(self.values))

    def varies(self, x: Number) -> bool:
        return x in self.program.varying

    def value(self, x: Number, vector: bool | None = None) -> Array:
        """A number as an array (members,) or as a scalar."""
        found = lax.full((), x.data, x.dtype) if x.is_constant else self.values[x]
        wanted = self.varies(x) if vector is None else vector
        return lax.broadcast(found, (self.members,)) if wanted and not self.varies(x) else found

    def block(self, block: Block) -> None:
        """Evaluate the items of a block."""
        for item in block.items:
            if isinstance(item, Loop):
                self.loop(item)
            elif isinstance(item, Branch):
                self.branch(item)
            elif item in self.program.live:
                self.values[item] = self.operation(item)

    def operation(self, x: Number) -> Array | None:
        vector = self.varies(x)
        if x.op == "array":
            return None if vector else jnp.stack([self.value(y) for y in x.inputs])
        if x.op == "empty":
            return jnp.zeros(x.data, x.dtype)
        if x.op == "put":
            array, k, y = (self.value(y, vector and n != 1) for n, y in enumerate(x.inputs))
            return array.at[..., k].set(y)
        if x.op == "entry":
            return self.entry(x)
        if x.op in ("table", "values"):
            table = self.tables[x.data] if x.op == "table" else np.frombuffer(x.data[1], x.data[0])
            return jnp.asarray(table)[self.value(x.inputs[0])]
        if x.op == "convert":
            return lax.convert_element_type(self.value(x.inputs[0], vector), x.dtype)
        return _OPERATIONS[x.op](*(self.value(y, vector) for y in x.inputs))

    def entry(self, x: Number) -> Array:
        """The entry of an array of numbers; by selection if they vary, since memory access would split the kernel."""
        if not self.varies(x.inputs[1]):
            return self.value(x.inputs[1])[self.value(x.inputs[0])]
        if x.inputs[1].op != "array":
            return self.value(x.inputs[1])[jnp.arange(self.members), self.value(x.inputs[0])]
        index, array = self.value(x.inputs[0]), [self.value(y, True) for y in x.inputs[1].inputs]
        found = array[-1]
        for k in range(len(array) - 1):
            found = lax.select(lax.eq(index, lax.full_like(index, k)), array[k], found)
        return found

    def loop(self, loop: Loop) -> None:
        """A loop. If its test varies, it runs until all members have finished; finished members do not change."""
        carried = self.program.needed_positions(loop.carries)
        if not carried:
            return
        masked = self.varies(loop.test)

        def evaluate_head(state: Carry) -> tuple[_Evaluation, Any]:
            inner = self.inner()
            for k, value in zip(carried, state[0], strict=True):
                inner.values[loop.carries[k]] = value
            inner.block(loop.head)
            going = inner.value(loop.test)
            return inner, going if state[1] is None else lax.bitwise_and(state[1], going)

        def test(state: Carry) -> Array:
            going = evaluate_head(state)[1]
            return jnp.any(going) if masked else going

        def body(state: Carry) -> Carry:
            inner, going = evaluate_head(state)
            inner.block(loop.body)
            after = []
            for k, before in zip(carried, state[0], strict=True):
                inside_varies = self.varies(loop.carries[k])
                new = inner.value(loop.following[k], inside_varies)
                after.append(lax.select(going, new, before) if masked and inside_varies else new)
            return after, going if masked else None

        starts = [self.value(loop.starts[k], self.varies(loop.carries[k])) for k in carried]
        active = lax.full((self.members,), True) if masked else None
        results, _ = lax.while_loop(test, body, (starts, active))
        for k, value in zip(carried, results, strict=True):
            self.values[loop.results[k]] = value

    def branch(self, branch: Branch) -> None:
        """One of two blocks, or both and a selection, if the test varies."""
        live = self.program.needed_positions(branch.results)
        if not live:
            return
        varies = [self.varies(branch.results[k]) for k in live]

        def side(n: int) -> list[Array]:
            inner = self.inner()
            inner.block(branch.blocks[n])
            return [inner.value(branch.values[n][k], v) for k, v in zip(live, varies, strict=True)]

        test = self.value(branch.test)
        if self.varies(branch.test):
            chosen = [lax.select(test, *pair) for pair in zip(side(0), side(1), strict=True)]
        else:
            chosen = lax.cond(test, lambda: side(0), lambda: side(1))
        for k, value in zip(live, chosen, strict=True):
            self.values[branch.results[k]] = value


_SAME_NAMES = (
    "abs acos acosh add asin asinh atan atan2 atanh cbrt ceil cos cosh div eq erf erfc exp exp2 expm1 floor ge gt le "
    "log log1p logistic lt max min mul ne neg pow rem shift_left shift_right_arithmetic shift_right_logical sin sinh "
    "sqrt sub tan tanh"
)
_OPERATIONS: dict[str, Callable[..., Array]] = {
    name: getattr(lax, name) for name in _SAME_NAMES.split() if hasattr(lax, name)
} | {
    "and": lax.bitwise_and,
    "not": lax.bitwise_not,
    "or": lax.bitwise_or,
    "round_away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    "round_even": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
    "select": lax.select,
    "xor": lax.bitwise_xor,
}
_READS = frozenset({"array", "convert", "empty", "entry", "put", "table", "values"})


def _check(block: Block, program: Program) -> None:
    for item in block.items:
        if isinstance(item, Number):
            if item in program.live and item.op not in _READS and item.op not in _OPERATIONS:
                raise UnsupportedError(item.op)
        else:
            for inner in blocks_of(item):
                _check(inner, program)


def count_carried(program: Program) -> int:
    """The largest number of values of a member that a loop carries from one iteration to the next."""

    def most_in(block: Block) -> int:
        inner = [item for item in block.items if not isinstance(item, Number)]
        own = [sum(x in program.varying and x in program.live for x in y.carries) for y in inner if isinstance(y, Loop)]
        return max([0, *own, *(most_in(part) for item in inner for part in blocks_of(item))])

    return most_in(program.block)


def width(program: Program) -> int:
    """The largest number of 32-bit registers that numbers of a member occupy at the same time, in program order.

    Each part between two loops is counted separately, since numbers pass between the parts through memory. Numbers that
    are used later, or are results, count until the end of their part, where a kernel writes them.
    """
    return max(_width(part, program) for part in _parts(program.block, program, program.outputs))


def _parts(block: Block, program: Program, after: Sequence[Number]) -> list[tuple[list[Number], set[Number]]]:
    """The operations between loops and branches, each with the numbers that are used beyond them."""
    found: list[tuple[list[Number], set[Number]]] = []
    needed = set(after)
    part: list[Number] = []
    for item in reversed(block.items):
        if isinstance(item, Number):
            if item in program.live:
                part.append(item)
            continue
        found.append((part[::-1], set(needed)))
        needed.update(y for x in part for y in x.inputs)
        needed.update(numbers_of(item))
        part = []
        for inner, last in zip(blocks_of(item), _ends(item), strict=True):
            parts = _parts(inner, program, last)
            found += parts
            needed.update(y for inside, _ in parts for x in inside for y in x.inputs)
    return [*found, (part[::-1], needed)]


def _ends(item: Loop | Branch) -> tuple[Sequence[Number], Sequence[Number]]:
    """The numbers that the two blocks of a loop or a branch must provide at their ends."""
    if isinstance(item, Loop):
        return [item.test], item.following
    return item.values[0], item.values[1]


def _width(part: tuple[list[Number], set[Number]], program: Program) -> int:
    numbers, needed = part
    last = {y: k for k, x in enumerate(numbers) for y in (*x.inputs, x)}
    last |= {x: len(numbers) for x in numbers if x in needed}
    alive, most, seen = 0, 0, set()
    ending: dict[int, int] = {}
    for k, x in enumerate(numbers):
        for y in (*x.inputs, x):
            if y in program.varying and y not in seen:
                seen.add(y)
                size = max(1, y.dtype.itemsize // 4)
                alive += size
                ending[last[y]] = ending.get(last[y], 0) + size
        most = max(most, alive)
        alive -= ending.get(k, 0)
    return most
