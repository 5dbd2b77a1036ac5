"""The loop of `march` as one kernel of a GPU: a thread computes a member from the first step to the last.

The program of numbers is written in Pallas for a block of members: a number is an array of them, or a scalar if they
share it. Triton compiles it. Numbers stay in registers from step to step; only the stored rows go to memory.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr

from lieint_jax.native._arrays import Evaluation, check_operations, computed_before
from lieint_jax.native._march import AnyArray, AnyArrays, Arrays, Deferred, Loop, jaxpr_of, march_p
from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._traced import Leaf, Traced

_BLOCK, _WARPS = 64, 2  # the members of a block, one for each thread, and the warps that they are
_LONGEST = 4000  # operations; longer programs take minutes to compile
_Numbers = list[Array]  # each an array of the members of a block


class KernelCode:
    """The step of a loop as a program of numbers for a kernel.

    Attributes:
        engine, length, pressure, seconds: as of machine code.
        lanes: the members of a block.
        shared: 0, since each thread computes what the members share.

    Raises:
        UnsupportedError: the step is no program of numbers, or too long, or has an operation that Triton lacks.
    """

    engine, lanes, shared = "kernel", _BLOCK, 0

    def __init__(self, step: ClosedJaxpr | Deferred, kinds: Sequence[str], _: AnyArrays):
        importlib.import_module("jax.experimental.pallas.triton")  # ImportError where JAX has none

        begin = time.perf_counter()
        self._traced = traced = Traced(jaxpr_of(step), kinds)
        self.length = traced.length
        if self.length > _LONGEST:
            raise UnsupportedError(f"{self.length} operations are more than the {_LONGEST} of a kernel")
        check_operations(traced.program)
        self.pressure = traced.pressure
        self.seconds = {"walk": time.perf_counter() - begin}

    def call(self, arguments: AnyArrays, loop: Loop, interpret: bool = False) -> Arrays:
        """The carries after the last step and the stored rows; without a GPU if it is to `interpret` the kernel."""
        from jax.experimental import pallas as pl
        from jax.experimental.pallas import triton

        traced = self._traced
        before = computed_before(traced.outside, traced.leaves, [None, *arguments], loop.members)
        arrays = {k: x for k, x in enumerate([None, *arguments, *before]) if x is not None and traced.leaves[k].size}
        inputs = {k: _three_axes(x, traced.leaves[k], loop.members) for k, x in arrays.items()}
        tables = {x.data: np.frombuffer(x.data[1], x.data[0]) for x in traced.program.live if x.op == "values"}
        inputs |= {key: jnp.asarray(x)[None, None] for key, x in tables.items()}
        kernel = _Kernel(traced, loop, list(inputs))
        found = pl.pallas_call(
            kernel,
            out_shape=kernel.outputs,
            grid=(pl.cdiv(loop.members or 1, _BLOCK),),
            compiler_params=triton.CompilerParams(num_warps=_WARPS),
            interpret=interpret,
        )(*inputs.values())
        full = iter(found)
        shapes = march_p.abstract_eval(*arguments, loop=loop)[0]
        return [next(full).reshape(x.shape) if x.size else jnp.zeros(x.shape, x.dtype) for x in shapes]


def _three_axes(x: AnyArray, leaf: Leaf, members: int | None) -> Array:
    """An array of axes (rows, members, entries), of which the first two have length 1 where they make no difference."""
    rows = len(x) if leaf.has_rows else 1
    return jnp.asarray(x).reshape(rows, (members or 1) if leaf.varies else 1, leaf.size)


class _Kernel:
    """The kernel, a function of references to arrays of axes (rows, members, entries), inputs and then outputs.

    Args:
        traced, loop: the step and the loop.
        names: of the inputs: the numbers of their leaves, and the data of the tables of the program.

    Attributes:
        outputs: the shapes of its outputs.
    """

    def __init__(self, traced: Traced, loop: Loop, names: Sequence[Any]):
        self.leaves, self.program, self.loop, self.names = traced.leaves, traced.program, loop, names
        sizes = [int(np.prod(x.shape)) for x in loop.step.out_avals]
        numbers = iter(traced.program.outputs)
        results = [[next(numbers) for _ in range(n)] for n in sizes]
        self.places = [(k + 1, entry) for k, n in enumerate(sizes[: loop.carried]) for entry in range(n)]
        self.carries = [x for x in results[: loop.carried] if x]
        self.rows = [x for x in results[loop.carried :] if x]
        self.after = [x for result in self.carries for x in result]
        carried = set(self.after)  # a saved state is the one that the loop carries
        self.saved = [x for x in dict.fromkeys(x for row in self.rows for x in row) if x not in carried]
        self.outputs = [
            jax.ShapeDtypeStruct((rows, loop.members or 1, len(x)), x[0].dtype)
            for results, rows in ((self.carries, 1), (self.rows, loop.rows))
            for x in results
        ]

    def __call__(self, *refs: Any) -> None:
        loop, inputs = self.loop, len(self.names)
        block = _Members(dict(zip(self.names, refs[:inputs], strict=True)), self.leaves, loop.members or 1)
        ends, stored = refs[inputs : inputs + len(self.carries)], refs[inputs + len(self.carries) :]
        every, count = self._counts(block)
        empty = [jnp.zeros(_BLOCK, x.dtype) for x in self.saved]
        step = self._step_on(block)

        def row(k: Array, carry: _Numbers) -> _Numbers:
            k = count - 1 - k if loop.reverse else k

            def next_step(i: Array | int, both: tuple[_Numbers, _Numbers]) -> tuple[_Numbers, _Numbers]:
                return step(k * every + (every - 1 - i if loop.reverse else i), both[0])

            both = carry, empty
            both = next_step(0, both) if loop.every == 1 else lax.fori_loop(0, every, next_step, both)
            values = dict(zip([*self.after, *self.saved], [*both[0], *both[1]], strict=True))
            for ref, numbers in zip(stored, self.rows, strict=True):
                block.write(ref, k, [values[x] for x in numbers])
            return both[0]

        carry = [block.read(k, entry) for k, entry in self.places]
        after = iter(lax.fori_loop(0, count, row, carry))
        for ref, numbers in zip(ends, self.carries, strict=True):
            block.write(ref, 0, [next(after) for _ in numbers])

    def _counts(self, block: _Members) -> tuple[Array, Array]:
        """The number of steps for a row, and of rows."""
        loop, dtype = self.loop, self.leaves[0].dtype
        if loop.every is None:
            every, count = (block.read(1 + loop.carried + k, 0) for k in (0, 1))
            return every.astype(dtype), count.astype(dtype)
        return jnp.asarray(loop.every, dtype), jnp.asarray(loop.rows, dtype)

    def _step_on(self, block: _Members) -> Any:
        """The step of a block of members, (n, carry) ↦ (carry, what only rows need)."""
        arguments = {x.data: x for x in self.program.live if x.op == "argument"}
        leaves = {place: self.leaves[place[0]] for place in arguments}
        fixed = {x: block.read(*place) for place, x in arguments.items() if leaves[place].kind in ("member", "shared")}
        of_rows = {x: place for place, x in arguments.items() if leaves[place].has_rows}

        def step(n: Array, carry: _Numbers) -> tuple[_Numbers, _Numbers]:
            values = fixed | {x: block.read(k, entry, n) for x, (k, entry) in of_rows.items()}
            values |= {arguments[p]: x for p, x in zip(self.places, carry, strict=True) if p in arguments}
            values |= {x: n for place, x in arguments.items() if leaves[place].kind == "counter"}
            evaluation = Evaluation(self.program, _BLOCK, block.entry, values)
            evaluation.block(self.program.block)
            return [evaluation.value(x, True) for x in self.after], [evaluation.value(x, True) for x in self.saved]

        return step


class _Members:
    """The members that the threads of a block compute, and their memory; threads beyond the last compute it again."""

    def __init__(self, inputs: dict[Any, Any], leaves: Sequence[Leaf], members: int):
        from jax.experimental import pallas as pl

        self._inputs, self._leaves = inputs, leaves
        at = pl.program_id(0) * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32)
        self._at = jnp.minimum(at, members - 1)

    def entry(self, name: Any, k: AnyArray, row: AnyArray = 0, member: AnyArray = 0) -> Array:
        """Entry k of an input, such as a table."""
        from jax.experimental.pallas import triton

        return triton.load(self._inputs[name].at[_index(row), _index(member), _index(k)])

    def read(self, k: int, entry: int, row: AnyArray = 0) -> Array:
        """An entry of a leaf, at a row if it has rows."""
        leaf = self._leaves[k]
        return self.entry(k, entry, row if leaf.has_rows else 0, self._at if leaf.varies else 0)

    def write(self, ref: Any, row: AnyArray, values: _Numbers) -> None:
        """Write the entries of a result."""
        from jax.experimental.pallas import triton

        for k, x in enumerate(values):
            triton.store(ref.at[_index(row), self._at, _index(k)], x)


def _index(k: AnyArray) -> Array:
    return jnp.asarray(k, jnp.int32)  # Pallas wants arrays, of one type
