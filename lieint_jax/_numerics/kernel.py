"""Functions that XLA's CPU backend compiles as one kernel.

XLA cuts a program into kernels, one for each fusion, and between them goes through a scheduler; and what it fuses into
several uses it computes once for each. In a loop over short steps that is half of the time. Two attributes of a call,
which XLA documents nowhere, keep it from being inlined and emit it whole. Where they mean nothing, on other devices or
in another XLA, results are the same, only slower.
"""

from __future__ import annotations

import functools
import math
import operator
import os
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from lieint_jax._numerics import scalars

try:
    from jax.experimental.xla_metadata import set_xla_metadata
except ImportError:  # an older JAX
    set_xla_metadata = None

SWITCH = "LIEINT_ONE_KERNEL"  # environment variable; 0 turns this off
_FOREIGN = ("custom_call", "dot", "convolution", "fft", "cholesky", "triangular_solve", "sort")  # library calls
_MOST_PAIRS = 128  # of pointers that LLVM compares at run time, so that it may vectorise a loop
_MOST_ARRAYS = 15  # of which one loop could not do with fewer pairs
_LONG = 16_000  # operations of a function that would compile slowly
_trace = threading.local()


def wanted() -> bool:
    """Whether there are such kernels here: on a CPU, unless switched off."""
    return set_xla_metadata is not None and jax.default_backend() == "cpu" and os.environ.get(SWITCH) != "0"


def one_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays or trees of them, compiled as one kernel where that is `wanted`.

    For arithmetic and loops. Calls of LAPACK and the like inside it fail to compile.
    """

    compiled = jax.jit(_as_part(function))
    return lambda *arguments: _whole(compiled, *arguments) if wanted() else function(*arguments)


def _as_part(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, traced as a part of a kernel."""

    def part(*arguments: Any) -> Any:
        before, _trace.inside = inside(), True
        try:
            return function(*arguments)
        finally:
            _trace.inside = before

    return part


def suits(function: Callable[..., Any], *arguments: Any) -> bool:
    """Whether a function may be part of a kernel: it is no longer than a kernel can be, and calls no library."""
    program = jax.jit(_as_part(function) if wanted() else function).lower(*arguments).as_text()
    return program.count("\n") < _LONG and not any(f"stablehlo.{name}" in program for name in _FOREIGN)


def inside() -> bool:
    """Whether the function that is being traced is to be one kernel."""
    return getattr(_trace, "inside", False)


def stored(tree: Any) -> Any:
    """The same arrays; in one kernel each is computed once and kept, for however many uses. Elsewhere XLA decides."""
    return _whole(_same, tree) if inside() and not _in_numbers() else tree


def stage(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`; in one kernel its results are computed once and kept, as by `stored`, but without a copy."""
    compiled = jax.jit(function)
    return lambda *arguments: _whole(compiled, *arguments) if inside() and not _in_numbers() else function(*arguments)


def together(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of small arrays, which closes over no traced value; in one kernel one loop over the members does it.

    XLA's CPU backend writes a loop for each result, and each loads all that it needs: a vector field spends its time on
    that. It writes one loop only for an operation that has several results, and of those a windowed reduction takes any
    function. Ours has windows of one element, so nothing is reduced: in place of the initial value stands what all
    members share. Where LLVM would not vectorise that, `function` is called as it is, with what in it is together or a
    `stage`. For use in loops of a kernel: outside of them XLA may not compile it.
    """

    def called(*arguments: Any) -> Any:
        if not inside() or _in_numbers():
            return function(*arguments)
        leaves, tree = jax.tree.flatten(arguments)
        return _OverMembers(function, tree, tuple(map(jnp.ndim, leaves))).call(*leaves)

    return called


class _OverMembers:
    """A function of leaves that may have axes in front, of members and of stages, all of the same sizes or 1."""

    def __init__(self, function: Callable[..., Any], tree: Any, ndims: tuple[int, ...]):
        self.function, self.tree, self.ndims = function, tree, ndims
        self.batched = jax.custom_batching.custom_vmap(self._all)
        self.batched.def_vmap(self._with_axis)
        self.call = jax.custom_jvp(self.batched)  # a windowed reduction has no derivative
        self.call.defjvp(lambda primals, tangents: jax.jvp(self._plain, primals, tangents))

    def _plain(self, *leaves: Array) -> Any:
        return self.function(*jax.tree.unflatten(self.tree, leaves))

    def _with_axis(self, size: int, batched: Any, *leaves: Array) -> tuple[Any, Any]:
        in_front = max(x.ndim - n - has for x, n, has in zip(leaves, self.ndims, batched, strict=True))

        def wide(x: Array, n: int, has: bool) -> Array:
            missing = in_front - (x.ndim - n - has)
            return x.reshape(size, *[1] * missing, *x.shape[1:]) if has else x

        result = self.batched(*map(wide, leaves, self.ndims, batched))
        return result, jax.tree.map(lambda _: True, result)

    def _all(self, *leaves: Array) -> Any:
        """The results for all members."""
        pairs = list(zip(leaves, self.ndims, strict=True))
        shape = jnp.broadcast_shapes(*(x.shape[: x.ndim - n] for x, n in pairs))
        if not shape:
            return self._plain(*leaves)
        if sum(math.prod(x.shape[x.ndim - n :]) for x, n in pairs if x.ndim > n) <= _MOST_ARRAYS:
            try:
                program, results = self._program(pairs)
            except scalars.NotArithmeticError:
                return self._each(shape, pairs)
            needed = iter(scalars.used(program.jaxpr))
            indices = ((x, index) for x, n in pairs for index in np.ndindex(x.shape[x.ndim - n :]))
            entries = {k: x[..., *index] for k, (x, index) in enumerate(indices) if next(needed)}
            found = _in_one_loop(program, entries, shape)
            if found is not None:
                left = iter(found)
                return jax.tree.map(lambda s: _stacked([next(left) for _ in range(s.size)], s.shape), results)
        return self._each(shape, pairs)

    def _program(self, pairs: list[tuple[Array, int]]) -> tuple[ClosedJaxpr, Any]:
        before, _trace.numbers = _in_numbers(), True
        try:
            return scalars.flat(self._plain, *(jax.ShapeDtypeStruct(x.shape[x.ndim - n :], x.dtype) for x, n in pairs))
        finally:
            _trace.numbers = before

    def _each(self, shape: tuple[int, ...], pairs: list[tuple[Array, int]]) -> Any:
        """The function itself, of all members and stages."""
        full = [jnp.broadcast_to(x, (*shape, *x.shape[x.ndim - n :])) if x.ndim > n else x for x, n in pairs]
        axes = tuple(0 if x.ndim > n else None for x, n in pairs)
        return functools.reduce(lambda f, _: jax.vmap(f, axes), shape, self._plain)(*full)


def _in_one_loop(program: ClosedJaxpr, entries: dict[int, Array], shape: tuple[int, ...]) -> list[Array] | None:
    """The results of a program of numbers for arrays of them, by their places; None if the loop would not vectorise."""
    arrays = {k: jnp.broadcast_to(x, shape) for k, x in entries.items() if x.ndim}
    shared = {k: x for k, x in entries.items() if not x.ndim}
    outputs = program.out_avals
    count = max(len(arrays), len(shared), len(outputs))
    pointers = count * (count - 1) // 2 + count * len(entries)
    if not arrays or pointers > _MOST_PAIRS or len({x.dtype for x in (*entries.values(), *outputs)}) > 1:
        return None
    operands, numbers = list(arrays.values()), list(shared.values())
    zero = jnp.zeros((), operands[0].dtype)

    def computed(initial: Any, element: Any) -> Any:
        known = dict(zip(arrays, element, strict=False)) | dict(zip(shared, initial, strict=False))
        results = jaxpr_as_fun(program)(*(known.get(k, zero) for k in range(len(program.in_avals))))
        return (*results, *element[len(results) :])

    operands += operands[:1] * (count - len(operands))
    numbers += [zero] * (count - len(numbers))
    ones = (1,) * len(shape)
    return lax.reduce_window(tuple(operands), tuple(numbers), computed, ones, ones, "VALID")[: len(outputs)]


def _stacked(entries: list[Array], shape: tuple[int, ...]) -> Array:
    return jnp.stack(entries, axis=-1).reshape(*entries[0].shape, *shape) if shape else entries[0]


def _in_numbers() -> bool:
    """Whether the function that is being traced becomes arithmetic of numbers."""
    return getattr(_trace, "numbers", False)


def combination(*terms: tuple[Array, list[Array] | Array]) -> Array:
    """Σ s v over pairs of a factor and a vector (n,), as an array; in one kernel its components are `stored`."""
    if not inside():
        arrays = (s * (jnp.stack(v) if isinstance(v, list) else v) for s, v in terms)
        return functools.reduce(operator.add, arrays)
    pairs = [[s * x for x in v] for s, v in terms]
    return jnp.stack(stored([functools.reduce(operator.add, entries) for entries in zip(*pairs, strict=True)]))


@jax.jit
def _same(tree: Any) -> Any:
    return tree


def _whole(compiled: Callable[..., Any], *arguments: Any) -> Any:
    assert set_xla_metadata is not None
    with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
        return compiled(*arguments)
