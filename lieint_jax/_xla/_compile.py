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


def jit(function: _Function, static_argnums: int | tuple[int, ...] = ()) -> _Function:
    """`jax.jit` with options of XLA that suit the loops of this package: the first call takes half of the time.

    Meant for the outermost function, such as the gradient of a loss that runs `integrate`. On a CPU XLA's older
    emitters, which jaxlib has up to 0.10, compile gradients in about 0.6 of the time. Values are the same to round-off,
    and later calls are as fast, but gradients of a thousand bodies need 1.5 times the time. With a later jaxlib, on a
    GPU, and inside jit, grad and other transformations, it is `jax.jit`.

    Args:
        function: a function of arrays.
        static_argnums: the positions of arguments that are compiled in, as in `jax.jit`.

    Returns:
        The compiled function, of the same arguments.

    Example:
        >>> import jax, lieint_jax as li
        >>> def energy_after(dt):
        ...     body = li.systems.rigid_body([1.0, 2.0, 3.0])
        ...     state = body.state(angular_velocity=[0.2, 0.0, 1.0])
        ...     run = li.integrate(li.schemes.so3_midpoint(body), state, dt, 10, save_every=10)
        ...     return body.energy(jax.tree.map(lambda x: x[-1], run.state))
        >>> gradient = li.jit(jax.grad(energy_after))
        >>> bool(abs(gradient(0.1)) < 1e-5)  # energy is conserved for any dt
        True
    """
    return compiled(function, static_argnums)


def compiled(function: _Function, static_argnums: int | tuple[int, ...] = (), once: bool = False) -> _Function:
    """`jax.jit` of a function, with options that make compilation faster.

    On CPUs XLA's older emitters compile in half of the time, and loops over steps run as fast; an XLA without them, as
    in jaxlib beyond 0.10, compiles as usual. XLA accepts such options for whole programs only, and JAX does not
    differentiate programs with options: inside jit, grad and other transformations there are none.

    Args:
        function, static_argnums: as in `jax.jit`.
        once: True if a call is faster than its compilation, as that of a check: then LLVM's optimizations are off too.
    """
    wanted = _ONCE if once else _QUICKLY
    plain = jax.jit(function, static_argnums=static_argnums, inline=True)

    @functools.cache
    def quick(*names: str) -> _Function:
        options = {name: wanted[name] for name in names}
        return cast("_Function", jax.jit(function, static_argnums=static_argnums, compiler_options=options))

    @functools.wraps(function)
    def call(*arguments: Tree, **named: Tree) -> Tree:
        options = [name for name in wanted if name not in _refused]
        if not options or jax.default_backend() != "cpu" or not outermost():
            return plain(*arguments, **named)
        try:
            return quick(*options)(*arguments, **named)
        except jax.errors.JaxRuntimeError as error:
            unknown = {name for name in options if f"No such compile option: '{name}'" in str(error)}
            if not unknown:
                raise
            _refused.update(unknown)
            return call(*arguments, **named)

    return cast("_Function", call)
