"""How the package compiles functions of its own."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeVar, cast

import jax

from lieint_jax._checks import outermost
from lieint_jax._xla._reads import rereading_jit

Tree = Any  # a tree of arrays
_Function = TypeVar("_Function", bound=Callable[..., Tree])
_QUICKLY = {"xla_cpu_use_fusion_emitters": False}
_ONCE = {**_QUICKLY, "xla_backend_optimization_level": 0}
_refused: set[str] = set()  # options that this XLA does not have


def jit(function: _Function, static_argnums: int | tuple[int, ...] = ()) -> _Function:
    """`jax.jit` with options of XLA that suit the loops of this package: the first call may take less time.

    For the outermost function, such as the gradient of a loss. On a CPU XLA's older emitters, up to jaxlib 0.10,
    compile what is not machine code in 0.6 to 1.1 of the time; values are the same to round-off, and gradients of a
    thousand bodies run 1.5 times as long. With a later jaxlib, on a GPU, and inside jit or grad, it is `jax.jit`.

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
    differentiate programs with options: inside jit, grad and other transformations there are none. A function of the
    arguments that reads other numbers than before is traced again: see `rereading_jit`.

    Args:
        function, static_argnums: as in `jax.jit`.
        once: True if a call is faster than its compilation, as that of a check: then LLVM's optimizations are off too.
    """
    options = _ONCE if once else _QUICKLY
    plain = rereading_jit(function, static_argnums, inline=True)
    variants: dict[tuple[str, ...], _Function] = {}

    @functools.wraps(function)
    def call(*arguments: Tree, **named: Tree) -> Tree:
        if not outermost():
            return plain(*arguments, **named)

        def attempt(names: Sequence[str]) -> Tree:
            chosen = {name: options[name] for name in names}
            program = variants.get(tuple(names))
            if program is None:
                program = rereading_jit(function, static_argnums, compiler_options=chosen or None)
                program = variants.setdefault(tuple(names), program)
            return program(*arguments, **named)

        return _with_known(options, attempt)

    return cast("_Function", call)


def _with_known(wanted: Collection[str], attempt: Callable[[Sequence[str]], Tree]) -> Tree:
    """What `attempt` returns, with those of the wanted options that this XLA has; none but on a CPU."""
    options = [name for name in wanted if name not in _refused] if jax.default_backend() == "cpu" else []
    try:
        return attempt(options)
    except jax.errors.JaxRuntimeError as error:
        unknown = {name for name in options if f"No such compile option: '{name}'" in str(error)}
        if not unknown:
            raise
        _refused.update(unknown)
        return _with_known(wanted, attempt)
