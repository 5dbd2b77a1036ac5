"""Descent along gradients: any transformation of optax, and its L-BFGS with a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.studies._search import FLAT, RUNNING, SHORTENINGS, STILL, STUCK, Carry, Method, where

Scalar = Callable[[Array], tuple[Array, Array]]
_QUIET = {"lbfgs": 3, "other": 10}  # iterations in a row without a fall to speak of, before the end
_SEARCHES = 3  # line searches in a row that may fail


class _Memory(NamedTuple):
    """The gradient, optax's own state, the share of a step that is taken, quiet iterations in a row."""

    gradient: Array
    state: Any
    length: Array
    quiet: Array


def _looked(scalar: Scalar) -> Callable[[Array], tuple[Array, Array, Array]]:
    """x ↦ loss, gradient and whether both are to be trusted."""

    def look(x: Array) -> tuple[Array, Array, Array]:
        (value, ok), gradient = jax.value_and_grad(scalar, has_aux=True)(x)
        return value, gradient, ok & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))

    return look


def _start(look: Callable[[Array], tuple[Array, Array, Array]], optimizer: Any) -> Callable[[Array], Any]:
    def first(x: Array) -> tuple[Array, _Memory, Array]:
        value, gradient, ok = look(x)
        return value, _Memory(gradient, optimizer.init(x), jnp.ones((), x.dtype), jnp.zeros((), jnp.int32)), ok

    return first


def descent(scalar: Scalar, optimizer: Any, tolerance: float) -> Method:
    """Any optax transformation. A failed trial is taken back, and the next steps are a quarter as long."""
    import optax

    look = _looked(scalar)

    def advance(carry: Carry) -> Carry:
        gradient, state, length, quiet = carry.memory
        update, after = optimizer.update(gradient, state, carry.x)
        x: Any = optax.apply_updates(carry.x, length * update)
        value, slope, ok = look(x)
        quiet = jnp.where(jnp.abs(carry.loss - value) <= tolerance * jnp.abs(carry.loss), quiet + 1, 0)
        bad = jnp.where(ok, 0, carry.bad + 1)
        ended = jnp.where(quiet >= _QUIET["other"], STILL, jnp.where(bad > SHORTENINGS, STUCK, RUNNING))
        code = jnp.where(ok & jnp.all(slope == 0), FLAT, ended)
        memory = where(ok, _Memory(slope, after, length, quiet), carry.memory)
        memory = memory._replace(length=jnp.where(ok, jnp.minimum(1, 1.1 * length), length / 4))
        x, value = where(ok, (x, value), (carry.x, carry.loss))
        return Carry(x, value, memory, code.astype(jnp.int32), bad, carry.failures + ~ok)

    return Method(_start(look, optimizer), advance)


def lbfgs(scalar: Scalar, tolerance: float) -> Method:
    """optax's L-BFGS with its zoom line search, which sees a high wall where a trial fails."""
    import optax

    look = _looked(scalar)
    search = optax.scale_by_zoom_linesearch(max_linesearch_steps=20, initial_guess_strategy="one")
    optimizer = optax.lbfgs(linesearch=search)

    def advance(carry: Carry) -> Carry:
        wall = carry.loss + 1e3 * (1 + jnp.abs(carry.loss))

        @jax.custom_jvp
        def walled(x: Array) -> Array:
            return jnp.where(look(x)[2], look(x)[0], wall)

        @walled.defjvp
        def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
            value, slope, ok = look(primals[0])
            return jnp.where(ok, value, wall), jnp.vdot(jnp.where(ok, slope, 0), tangents[0])

        gradient, state, length, quiet = carry.memory
        update, after = optimizer.update(gradient, state, carry.x, value=carry.loss, grad=gradient, value_fn=walled)
        x = optax.apply_updates(carry.x, update)
        value, slope = (optax.tree.get(after, name) for name in ("value", "grad"))  # of x, as the search saw it
        ok = value < wall
        better = ok & (value <= carry.loss)
        quiet = jnp.where(better & (carry.loss - value <= tolerance * jnp.abs(carry.loss)), quiet + 1, 0)
        bad = jnp.where(better, 0, carry.bad + 1)
        flat = jnp.max(jnp.abs(slope)) <= tolerance * (1 + jnp.abs(value))
        ended = jnp.where(quiet >= _QUIET["lbfgs"], STILL, jnp.where(bad >= _SEARCHES, STUCK, RUNNING))
        code = jnp.where(better & flat, FLAT, ended)
        again = _Memory(gradient, optimizer.init(carry.x), length, quiet)  # along the gradient, after a failed search
        memory = where(better, _Memory(slope, after, length, quiet), again)
        x, value = where(better, (x, value), (carry.x, carry.loss))
        return Carry(x, value, memory, code.astype(jnp.int32), bad, carry.failures + ~ok)

    return Method(_start(look, optimizer), advance)
