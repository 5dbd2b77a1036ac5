"""Functions that XLA's CPU backend compiles as one kernel.

XLA cuts a program into kernels, one for each fusion, and between them goes through a scheduler; and what it fuses into
several uses it computes once for each. In a loop over short steps that is half of the time. Two attributes of a call,
which XLA documents nowhere, keep it from being inlined and emit it whole. Where they mean nothing, on other devices or
in another XLA, results are the same, only slower.
"""

from __future__ import annotations

import functools
import operator
import os
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jax_core
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax._numerics import scalars

try:
    from jax.experimental.xla_metadata import set_xla_metadata
except ImportError:  # an older JAX
    set_xla_metadata = None

SWITCH = "LIEINT_ONE_KERNEL"  # environment variable; 0 turns this off
_FOREIGN = ("custom_call", "dot", "convolution", "fft", "cholesky", "triangular_solve", "sort")  # library calls
_MOST_PAIRS = 128  # of pointers that LLVM compares at run time, so that it may vectorise a loop
_LONG = 16_000  # operations of a function that would compile slowly
_trace = threading.local()


def wanted() -> bool:
    """Whether there are such kernels here: on a CPU, unless switched off."""
    return set_xla_metadata is not None and jax.default_backend() == "cpu" and os.environ.get(SWITCH) != "0"


def one_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays or trees of them, compiled as one kernel where that is `wanted`.

    For arithmetic and loops. Calls of LAPACK and the like inside it fail to compile.
    """

    def inside_one(*arguments: Any) -> Any:
        before, _trace.inside = inside(), True
        try:
            return function(*arguments)
        finally:
            _trace.inside = before

    compiled = jax.jit(inside_one)
    return lambda *arguments: _whole(compiled, *arguments) if wanted() else function(*arguments)


def suits(function: Callable[..., Any], *arguments: Any) -> bool:
    """Whether a function may be part of a kernel: it is no longer than a kernel can be, and calls no library."""
    program = jax.jit(function).lower(*arguments).as_text()
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

    XLA's CPU backend writes a loop for each result of a fusion, and each loads all that it needs: so a vector field
    spends its time on loads. It writes one loop for several results only where an operation has them, and the one that
    takes any function is a windowed reduction. Ours has windows of one element, such that nothing is reduced: the
    computation gets the element, and in place of the initial value whatever is shared by all members.

    Where that cannot vectorise, `function` is called as it is, with what is together or a `stage` in it.
    """

    def of(*arguments: Any) -> Any:
        if not inside() or _in_numbers():
            return function(*arguments)
        leaves, tree = jax.tree.flatten(arguments)
        over_members = _OverMembers(function, tree, tuple(x.ndim for x in map(jnp.asarray, leaves)))
        return _differentiable(over_members)(*leaves)

    return of


def _differentiable(function: _OverMembers) -> Callable[..., Any]:
    """The function with derivatives of what it stands for: a windowed reduction has none."""
    call = jax.custom_jvp(function.called)
    call.defjvp(lambda primals, tangents: jax.jvp(function.plain, primals, tangents))
    return call


class _OverMembers:
    """A function of leaves that may have axes in front, of members and of stages, all of the same sizes or 1."""

    def __init__(self, function: Callable[..., Any], tree: Any, ndims: tuple[int, ...]):
        self.function, self.tree, self.ndims = function, tree, ndims
        self.called = jax.custom_batching.custom_vmap(self._at_once)
        self.called.def_vmap(self._batched)

    def plain(self, *leaves: Array) -> Any:
        return self.function(*jax.tree.unflatten(self.tree, leaves))

    def _batched(self, size: int, batched: Any, *leaves: Array) -> tuple[Any, Any]:
        in_front = max(x.ndim - n - has for x, n, has in zip(leaves, self.ndims, batched, strict=True))

        def wide(x: Array, n: int, has: bool) -> Array:
            missing = in_front - (x.ndim - n - has)
            return x.reshape(size, *[1] * missing, *x.shape[1:]) if has else x

        result = self.called(*map(wide, leaves, self.ndims, batched))
        return result, jax.tree.map(lambda _: True, result)

    def _at_once(self, *leaves: Array) -> Any:
        shape = jnp.broadcast_shapes(*(x.shape[: x.ndim - n] for x, n in zip(leaves, self.ndims, strict=True)))
        if not shape:
            return self.plain(*leaves)
        try:
            program, shapes = self._program(leaves)
        except scalars.Unknown:
            return self._one_by_one(shape, leaves)
        needed = iter(scalars.used(program.jaxpr))
        entries = [
            x[(..., *index)] if next(needed) else None
            for x, n in zip(leaves, self.ndims, strict=True)
            for index in np.ndindex(x.shape[x.ndim - n :])
        ]
        results = _in_one_loop(program, entries, shape)
        if results is None:
            return self._one_by_one(shape, leaves)
        left = iter(results)
        return jax.tree.map(lambda s: _stacked([next(left) for _ in range(s.size)], s.shape), shapes)

    def _program(self, leaves: tuple[Array, ...]) -> tuple[Any, Any]:
        own = [jax.ShapeDtypeStruct(x.shape[x.ndim - n :], x.dtype) for x, n in zip(leaves, self.ndims, strict=True)]
        before, _trace.numbers = _in_numbers(), True
        try:
            return scalars.flat(self.plain, *own)
        finally:
            _trace.numbers = before

    def _one_by_one(self, shape: tuple[int, ...], leaves: tuple[Array, ...]) -> Any:
        """The function itself, of all members and stages."""
        call = self.plain
        full = [
            jnp.broadcast_to(x, (*shape, *x.shape[x.ndim - n :])) if x.ndim > n else x
            for x, n in zip(leaves, self.ndims, strict=True)
        ]
        axes = tuple(0 if x.ndim > n else None for x, n in zip(leaves, self.ndims, strict=True))
        for _ in shape:
            call = jax.vmap(call, axes)
        return call(*full)


def _in_one_loop(program: Any, entries: list[Array | None], shape: tuple[int, ...]) -> list[Array] | None:
    """The results of a program of numbers for arrays of them; None if the loop would not vectorise."""
    apart = [n for n, x in enumerate(entries) if x is not None and x.ndim]
    shared = [n for n, x in enumerate(entries) if x is not None and not x.ndim]
    outputs = program.out_avals
    dtypes = {entries[n].dtype for n in apart + shared} | {x.dtype for x in outputs}
    count = max(len(apart), len(shared), len(outputs))
    pairs = count * (count - 1) // 2 + count * (len(apart) + len(shared))
    if len(dtypes) > 1 or pairs > _MOST_PAIRS:
        return None
    function = jax_core.jaxpr_as_fun(program)
    arrays = [jnp.broadcast_to(entries[n], shape) for n in apart]
    numbers = [entries[n] for n in shared]
    zero = jnp.zeros((), arrays[0].dtype)

    def computed(initial: Any, element: Any) -> Any:
        values = dict(zip(apart, element, strict=False)) | dict(zip(shared, initial, strict=False))
        results = function(*(values.get(n, zero) for n in range(len(entries))))
        return (*results, *element[len(results) :])

    operands = tuple(arrays + arrays[:1] * (count - len(arrays)))
    initial = tuple(numbers + [zero] * (count - len(numbers)))
    ones = (1,) * len(shape)
    return lax.reduce_window(operands, initial, computed, ones, ones, "VALID")[: len(outputs)]


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
