"""How the package compiles functions of its own."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

from lieint_jax._checks import outermost

Tree = Any  # a tree of arrays
_Function = TypeVar("_Function", bound=Callable[..., Tree])
_QUICKLY = {"xla_cpu_use_fusion_emitters": False}
_ONCE = {**_QUICKLY, "xla_backend_optimization_level": 0}
_refused: set[str] = set()  # options that this XLA does not have


def compiled(function: _Function, static_argnums: int | tuple[int, ...] = (), once: bool = False) -> _Function:
    """`jax.jit` of a function, with options that make compilation faster.

    On CPUs XLA's older emitters compile in half of the time, and loops over steps run as fast; an XLA without them
    compiles as usual. XLA accepts such options for whole programs only, and JAX does not differentiate programs with
    options: inside jit, grad and other transformations there are none.

    Args:
        function, static_argnums: as in `jax.jit`.
        once: True if a call is faster than its compilation, as that of a check: then LLVM's optimizations are off too.
    """
    plain = jax.jit(function, static_argnums=static_argnums, inline=True)
    options = _ONCE if once else _QUICKLY
    quick = jax.jit(function, static_argnums=static_argnums, compiler_options=options)

    @functools.wraps(function)
    def call(*arguments: Tree) -> Tree:
        if not _refused.isdisjoint(options) or jax.default_backend() != "cpu" or not outermost():
            return plain(*arguments)
        try:
            return quick(*arguments)
        except jax.errors.JaxRuntimeError as error:
            unknown = {name for name in options if f"No such compile option: '{name}'" in str(error)}
            if not unknown:
                raise
            _refused.update(unknown)
            return plain(*arguments)

    return cast("_Function", call)
