"""How the package compiles functions of its own."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

from lieint_jax._checks import outermost

_Function = TypeVar("_Function", bound=Callable[..., Any])
_QUICKLY = {"xla_cpu_use_fusion_emitters": False}
_ONCE = {**_QUICKLY, "xla_backend_optimization_level": 0}
_refused: set[str] = set()  # options that this XLA does not have


def compiled(function: _Function, static_argnums: int | tuple[int, ...] = (), once: bool = False) -> _Function:
    """`jax.jit` of a function, with what makes XLA compile it sooner.

    On CPUs XLA's older emitters compile in half of the time, and loops over steps run as fast; an XLA that no longer
    has them compiles as ever. XLA takes such options for whole programs, and JAX derives no program with options:
    there are none inside of jit, grad and other transformations.

    Args:
        function, static_argnums: as in `jax.jit`.
        once: whether a call takes less time than compiling, as of a check: then without LLVM's optimizations too.
    """
    plain = jax.jit(function, static_argnums=static_argnums, inline=True)
    options = _ONCE if once else _QUICKLY
    quick = jax.jit(function, static_argnums=static_argnums, compiler_options=options)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
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
