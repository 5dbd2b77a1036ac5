"""A function of one member, compiled for many: like JAX's vmap and jit, but machine code over blocks of members."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from lieint_jax._xla import compiled_for
from lieint_jax.native._primitives.abstract_walk import unsupported_if_it_fails
from lieint_jax.native._program import Program
from lieint_jax.native._traced import Leaf, Operation, Traced, Tree, make_once

_CHUNKS = 4  # parts of the members per thread, so that all threads end at about the same time


def kernel(function: Callable[..., Tree], kinds: Sequence[Tree], examples: Sequence[Tree]) -> Kernel:
    """The `Kernel` of a function that can be hashed, made once for all arguments of the same shapes."""
    return make_once(Kernel, function, kinds, examples)


class Kernel:
    """A function of one member, as machine code for many.

    Args:
        function, kinds, examples: see `Traced`.
        lanes: members in a vector; by default it follows from the machine.

    Attributes:
        results: the shapes of the results of one member and one row.
        kinds_of_results: for each of them "member" or "shared".
        is_compared: whether its results were compared with XLA's.
        refusal: why it must not be used, if they differed.

    Raises:
        ImportError: llvmlite is missing.
        UnsupportedError: the function cannot be compiled to machine code here.
    """

    def __init__(self, function: Callable[..., Tree], kinds: Sequence[Tree], examples: Sequence[Tree], lanes: int = 0):
        traced = Traced(function, kinds, examples)
        self.results, self.kinds_of_results, self.length = traced.results, traced.kinds_of_results, traced.length
        self._leaves, self._given, self._structure = traced.leaves, traced.given, jax.tree.structure(traced.results)
        self._jaxpr: ClosedJaxpr | None = traced.jaxpr
        self.is_compared, self.refusal = False, ""
        self._outside = [HostOperation(x, Code(x.program, x.leaves, x.operands)) for x in traced.outside]
        self._code = Code(traced.program, self._leaves, jax.tree.leaves(self.results), lanes)
        self.lanes = self._code.lanes

    @property
    def shared(self) -> int:
        """About how many numbers of a step the members share."""
        return self._code.shared

    def with_reference(self, arguments: Sequence[Tree], members: int) -> tuple[Tree, Tree]:
        """The results of all members for one row, with the axes (members, …): by this machine code, and by XLA.

        XLA's program is that of one member, which compiles in half of the time of one for many.
        This method can be called once: then the kernel forgets what was traced.
        """
        assert self._jaxpr is not None
        given = [np.asarray(x) for part in arguments for x in jax.tree.leaves(part)]
        leaves = self._leaves[: self._given]

        def of_member(m: int) -> list[np.ndarray]:
            at = {"carry": m, "member": m, "row": 0}
            return [
                np.asarray(x[at[leaf.kind]]) if leaf.kind in at else x for x, leaf in zip(given, leaves, strict=True)
            ]

        by_xla = compiled_for(jaxpr_as_fun(self._jaxpr), *of_member(0))
        theirs = [np.stack(x) for x in zip(*(by_xla(*of_member(m)) for m in range(members)), strict=True)]
        self._jaxpr = None
        ours = jax.tree.leaves(self(arguments, members))
        carried = self._code.carried
        ours[carried:] = [x[0] for x in ours[carried:]]
        return jax.tree.unflatten(self._structure, ours), jax.tree.unflatten(self._structure, theirs)

    def __call__(self, arguments: Sequence[Tree], members: int, rows: int = 1, threads: int = 1) -> Tree:
        """The results of all members, with the axes (members, …) of carries and (rows, members, …) of others."""
        given = [np.asarray(x) for part in arguments for x in jax.tree.leaves(part)]
        inputs = [np.ascontiguousarray(x, leaf.dtype) for x, leaf in zip(given, self._leaves, strict=False)]
        for x, leaf in zip(inputs, self._leaves[: self._given], strict=True):
            copies = {"carry": members, "member": members, "row": rows}.get(leaf.kind, 1)
            if x.size != copies * leaf.size:
                raise ValueError(f"an array of kind {leaf.kind} of {x.size} entries, not {copies} × {leaf.size}")
        for outside in self._outside:
            inputs += outside.results(inputs, members)
        return jax.tree.unflatten(self._structure, self._code(inputs, members, rows, threads))


class HostOperation(NamedTuple):
    """An operation that JAX computes before the machine code runs, and the code for its operands."""

    operation: Operation
    operands: Code

    def results(self, inputs: list[np.ndarray], members: int) -> list[np.ndarray]:
        """Its results for all members, or once."""
        varies = self.operation.kind == "member"
        operands = [x[0] for x in self.operands(inputs, members if varies else 1, 1, 1)]
        found = self.operation.results(operands if varies else [x[0] for x in operands])
        return [np.ascontiguousarray(x) for x in found]


class Code:
    """A program as machine code.

    Args:
        program: its outputs are the entries of the arrays that are carried, then of others.
        leaves: the arrays that it reads.
        results: the shapes of its outputs.
        lanes: members in a vector; by default it follows from the machine.
    """

    @unsupported_if_it_fails()
    def __init__(
        self, program: Program, leaves: Sequence[Leaf], results: Sequence[jax.ShapeDtypeStruct], lanes: int = 0
    ):
        from lieint_jax.native import _machine
        from lieint_jax.native._pieces import modules

        self._results, self.carried = results, sum(leaf.kind == "carry" for leaf in leaves)
        self.lanes = lanes or _machine.lanes(leaves, program.pressure())
        sizes = [int(np.prod(x.shape)) for x in results[self.carried :]]
        texts, self.shared = modules(program, leaves, sizes, self.lanes)
        self._run = _machine.compile_modules(*texts)

    def __call__(self, inputs: Sequence[np.ndarray], members: int, rows: int, threads: int) -> list[np.ndarray]:
        """The results, with the axes (members, …) of carries and (rows, members, …) of others."""
        outputs = [
            np.empty((members, *x.shape) if n < self.carried else (rows, members, *x.shape), x.dtype)
            for n, x in enumerate(self._results)
        ]
        self._over_blocks(members, rows, _pointers(_addresses([*inputs, *outputs])), threads)
        return outputs

    def _over_blocks(self, members: int, rows: int, pointers: Any, threads: int) -> None:
        blocks = -(-members // self.lanes)
        if threads <= 1 or blocks == 1:
            self._run(0, blocks, members, rows, 1, pointers)
            return
        ends = np.linspace(0, blocks, min(blocks, _CHUNKS * threads) + 1).astype(int)
        parts = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
        for _ in _pool(threads).map(lambda part: self._run(*part, members, rows, 1, pointers), parts):
            pass


def _addresses(arrays: Sequence[np.ndarray]) -> list[int]:
    return [x.ctypes.data for x in arrays]


def _pointers(addresses: list[int]) -> Any:
    return (ctypes.c_void_p * len(addresses))(*addresses)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="lieint")
