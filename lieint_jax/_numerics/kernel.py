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
import jax.numpy as jnp
from jax import Array

try:
    from jax.experimental.xla_metadata import set_xla_metadata
except ImportError:  # an older JAX
    set_xla_metadata = None

SWITCH = "LIEINT_ONE_KERNEL"  # environment variable; 0 turns this off
_FOREIGN = ("custom_call", "dot", "convolution", "fft", "cholesky", "triangular_solve", "sort")  # library calls
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
    return _whole(_same, tree) if inside() else tree


def stage(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`; in one kernel its results are computed once and kept, as by `stored`, but without a copy."""
    compiled = jax.jit(function)
    return lambda *arguments: _whole(compiled, *arguments) if inside() else function(*arguments)


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
