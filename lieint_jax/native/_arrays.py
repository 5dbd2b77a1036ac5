"""A program of numbers in JAX: for what is computed before a program runs, and inside of a kernel for a GPU.

Every number that depends on the member is an array (members,), every other number a scalar, and an array of numbers a
list of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._program import Block, Branch, Loop, Program, Value, all_items
from lieint_jax.native._traced import Leaf, Operation

_LONGEST_ARRAY = 64  # numbers of an array with an index: all of them are looked at
_Value = Any  # a number as an array (members,) or a scalar; of an array of numbers a list of these


def computed_before(
    operations: Sequence[Operation], leaves: Sequence[Leaf], arrays: Sequence[Any], members: int | None
) -> list[Array]:
    """The results of the operations that JAX computes before a program runs; arrays that are in no memory are None."""
    arrays, given = list(arrays), len(arrays)
    for x in operations:
        arrays += x.results(_operands(x, leaves, arrays, members))
    return arrays[given:]


def _operands(operation: Operation, leaves: Sequence[Leaf], arrays: Sequence[Any], members: int | None) -> list[Array]:
    """The operands of an operation as arrays (members, …), or (…) if they are shared."""

    def entry(k: int, at: int) -> Array:
        return arrays[k].reshape(*([len(arrays[k])] if leaves[k].varies else []), -1)[..., at]

    program, axes = operation.program, () if members is None or operation.kind == "shared" else (members,)
    values: dict[Value, _Value] = {x: entry(*x.data) for x in program.live if x.op == "argument"}
    for x in program.live:
        if x.op == "column":
            k, first, stride, length = x.data
            values[x] = [entry(k, first + stride * n) for n in range(length)]
    tables = dict(enumerate(arrays)) | {
        x.data: np.frombuffer(x.data[1], x.data[0]) for x in program.live if x.op == "values"
    }
    evaluation = Evaluation(program, math.prod(axes), lambda name, k: jnp.asarray(tables[name])[k], values)
    evaluation.block(program.block)
    outputs = iter(program.outputs)
    found = []
    for shape in operation.operands:
        entries = [evaluation.value(next(outputs), bool(axes)) for _ in range(int(np.prod(shape.shape)))]
        stacked = jnp.stack(entries, -1) if entries else jnp.zeros(0, shape.dtype)
        found.append(stacked.reshape(*axes, *shape.shape))
    return found


Carry = tuple[Array, list[_Value]]  # what a loop carries: which members go on, and its numbers


class Evaluation:
    """The values of a program's numbers, inside a block and those around it.

    Args:
        program: the program.
        members: their number.
        table: (name of a table, indices) ↦ its entries.
        values: those of its arguments.
    """

    def __init__(
        self, program: Program, members: int, table: Callable[[Any, Array], Array], values: dict[Value, _Value]
    ):
        self.program, self.members, self.table, self.values = program, members, table, values

    def inner(self) -> Evaluation:
        """An evaluation of a block that JAX traces separately."""
        return Evaluation(self.program, self.members, self.table, dict(self.values))

    def varies(self, x: Value) -> bool:
        """Whether a number depends on the member."""
        return x in self.program.varying

    def value(self, x: Value, vector: bool | None = None) -> _Value:
        """A number as an array (members,) or as a scalar."""
        found = lax.full((), x.data, jax.dtypes.canonicalize_dtype(x.dtype)) if x.is_constant else self.values[x]
        wanted = self.varies(x) if vector is None else vector
        if not wanted:
            return found
        return jax.tree.map(lambda y: y if y.ndim else lax.broadcast(y, (self.members,)), found)

    def block(self, block: Block) -> None:
        """Evaluate the items of a block."""
        for item in block.items:
            if isinstance(item, Loop):
                self.loop(item)
            elif isinstance(item, Branch):
                self.branch(item)
            elif item in self.program.live:
                self.values[item] = self.operation(item)

    def operation(self, x: Value) -> _Value:
        """The value of an operation."""
        vector = self.varies(x)
        if x.op == "array":
            return [self.value(y, vector) for y in x.inputs]
        if x.op == "empty":
            zero = lax.full((self.members,) if vector else (), 0, x.dtype)
            return [zero] * x.length
        if x.op == "put":
            array, k, y = (self.value(y, vector) for y in x.inputs)
            return [lax.select(lax.eq(k, lax.full_like(k, j)), y, old) for j, old in enumerate(array)]
        if x.op == "entry":
            if x.inputs[0].is_constant:
                return self.value(x.inputs[1], vector)[int(x.inputs[0].data)]
            k, array = (self.value(y, vector) for y in x.inputs)
            found = array[-1]
            for j, entry in enumerate(array[:-1]):
                found = lax.select(lax.eq(k, lax.full_like(k, j)), entry, found)
            return found
        if x.op in ("table", "values"):
            return self.table(x.data, self.value(x.inputs[0]))
        if x.op == "convert":
            return lax.convert_element_type(self.value(x.inputs[0], vector), x.dtype)
        return _OPERATIONS[x.op](*(self.value(y, vector) for y in x.inputs))

    def loop(self, loop: Loop) -> None:
        """A loop. If its test varies, it runs until all members have finished; finished members do not change."""
        carried = self.program.needed_positions(loop.carries)
        if not carried:
            return
        masked = self.varies(loop.test)

        def evaluate_head(state: Carry) -> tuple[Evaluation, Array]:
            inner = self.inner()
            for k, value in zip(carried, state[1], strict=True):
                inner.values[loop.carries[k]] = value
            inner.block(loop.head)
            return inner, lax.bitwise_and(state[0], inner.value(loop.test))

        def test(state: Carry) -> Array:
            going = evaluate_head(state)[1]
            return jnp.max(going.astype(jnp.int32)) > 0 if masked else going  # Triton has no `any`

        def body(state: Carry) -> Carry:
            inner, going = evaluate_head(state)
            inner.block(loop.body)
            after = []
            for k, before in zip(carried, state[1], strict=True):
                inside_varies = self.varies(loop.carries[k])
                new = inner.value(loop.following[k], inside_varies)
                after.append(_select(going, new, before) if masked and inside_varies else new)
            return going, after

        starts = [self.value(loop.starts[k], self.varies(loop.carries[k])) for k in carried]
        active = lax.full((self.members,) if masked else (), True)
        _, results = lax.while_loop(test, body, (active, starts))
        for k, value in zip(carried, results, strict=True):
            self.values[loop.results[k]] = value

    def branch(self, branch: Branch) -> None:
        """One of two blocks, or both and a selection, if the test varies."""
        live = self.program.needed_positions(branch.results)
        if not live:
            return
        varies = [self.varies(branch.results[k]) for k in live]

        def side(n: int) -> list[_Value]:
            inner = self.inner()
            inner.block(branch.blocks[n])
            return [inner.value(branch.values[n][k], v) for k, v in zip(live, varies, strict=True)]

        test = self.value(branch.test)
        if self.varies(branch.test):
            chosen = [_select(test, *pair) for pair in zip(side(0), side(1), strict=True)]
        else:
            chosen = lax.cond(test, lambda: side(0), lambda: side(1))
        for k, value in zip(live, chosen, strict=True):
            self.values[branch.results[k]] = value


def _select(test: Array, on_true: _Value, on_false: _Value) -> _Value:
    return jax.tree.map(lambda x, y: lax.select(test, x, y), on_true, on_false)


def _round_even(x: Array) -> Array:
    """The nearest whole number, of two the even one: Triton has no rounding."""
    low = lax.floor(x)
    above = x - low
    is_odd = jnp.floor(low / 2) * 2 != low
    return jnp.where((above > 0.5) | ((above == 0.5) & is_odd), low + 1, low)


def _round_away(x: Array) -> Array:
    low = lax.floor(lax.abs(x))
    return lax.sign(x) * jnp.where(lax.abs(x) - low >= 0.5, low + 1, low)


_SAME_NAMES = (
    "abs acos acosh add asin asinh atan atan2 atanh cbrt ceil cos cosh div eq exp exp2 expm1 floor ge gt le log log1p "
    "logistic lt max min mul ne neg pow rem select shift_left shift_right_arithmetic shift_right_logical sin sinh sqrt "
    "sub tan tanh"
)
_OPERATIONS: dict[str, Callable[..., Array]] = {name: getattr(lax, name) for name in _SAME_NAMES.split()} | {
    "and": lax.bitwise_and,
    "not": lax.bitwise_not,
    "or": lax.bitwise_or,
    "round_away": _round_away,
    "round_even": _round_even,
    "xor": lax.bitwise_xor,
}
_READS = frozenset({"convert", "entry", "put", "table", "values"})


def check_operations(program: Program) -> None:
    """UnsupportedError if a program has an operation without counterpart here, or an index into a long array."""
    for item in all_items(program.block):
        if isinstance(item, Value) and item in program.live:
            length = item.length if item.op in ("array", "empty") else None
            if length is None and item.op not in _READS and item.op not in _OPERATIONS:
                raise UnsupportedError(item.op)
            if length is not None and length > _LONGEST_ARRAY:
                raise UnsupportedError(f"an index into {length} numbers, more than {_LONGEST_ARRAY}")
