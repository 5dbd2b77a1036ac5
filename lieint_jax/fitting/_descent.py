"""Descent along gradients: any transformation of optax, and its L-BFGS with a line search.

They move in all real x, which `Box.inside` maps into the box of coordinates. The stopping test uses the gradient with
respect to the coordinates, since that with respect to x vanishes at every side of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.fitting._box import Box
from lieint_jax.fitting._search import FLAT, RUNNING, SHORTENINGS, STILL, STUCK, Carry, Method, where

if TYPE_CHECKING:
    from optax import GradientTransformation

Scalar = Callable[[Array], tuple[Array, Array]]
_QUIET = {"lbfgs": 3, "other": 10}  # iterations in a row without a notable fall of the loss that end a search
_LEVEL = 1e-5  # |gradient · y| over the loss, below which such an end is a success
_SEARCHES = 3  # failed line searches in a row that end a search
NEWTON = 200  # the most coordinates for which Newton's step is computed at the end of a search


class _Memory(NamedTuple):
    """The state of a descent.

    Attributes:
        gradient: with respect to x, at the current point.
        largest: the largest `_slopes` so far, (2,).
        size: the largest absolute values of the coordinates so far, (p,).
        state: optax's own state.
        unit: for `descent` the fraction of a step that is used; for `lbfgs` the unit of the loss.
        quiet: the number of consecutive iterations without a significant decrease of the loss.
    """

    gradient: Array
    largest: Array
    size: Array
    state: PyTree
    unit: Array
    quiet: Array


def _evaluation(scalar: Scalar, box: Box) -> Callable[[Array], tuple[Array, Array, Array]]:
    """x ↦ loss, gradient, and whether both are finite and the solves behind them converged; `scalar` is of box(x)."""

    def look(x: Array) -> tuple[Array, Array, Array]:
        (value, ok), gradient = jax.value_and_grad(scalar, has_aux=True)(box.inside(x))
        gradient = gradient * box.slope(x)
        return value, gradient, ok & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))

    return look


def _slope(box: Box, x: Array, gradient: Array) -> Array:
    """The gradient with respect to the coordinates, projected into the box."""
    return box.projected(box.inside(x), gradient / box.slope(x))


def _largest(slope: Array) -> Array:
    return jnp.max(jnp.abs(slope))


def _slopes(box: Box, x: Array, gradient: Array, size: Array) -> Array:
    """Two measures of the gradient that vanish at a minimum in the box, (2,): the second in the unit of the loss.

    The first alone would be that of the coordinate with the smallest unit.
    """
    by_coordinates = gradient / box.slope(x)
    changes = box.changes(box.inside(x), by_coordinates, size)
    return jnp.stack([_largest(_slope(box, x, gradient)), _largest(changes)])


def _with_largest(memory: _Memory, box: Box, x: Array) -> _Memory:
    """The memory at x, with the largest coordinates and slopes so far."""
    size = jnp.maximum(memory.size, jnp.abs(box.inside(x)))
    largest = jnp.maximum(memory.largest, _slopes(box, x, memory.gradient, size))
    return memory._replace(size=size, largest=largest)


def _start(
    look: Callable[[Array], tuple[Array, Array, Array]], box: Box, optimizer: GradientTransformation
) -> Callable[[Array], PyTree]:
    """x ↦ loss, memory and whether the first guess succeeded."""

    def first(x: Array) -> tuple[Array, _Memory, Array]:
        value, gradient, ok = look(x)
        size, one, none = jnp.abs(box.inside(x)), jnp.ones((), x.dtype), jnp.zeros((), jnp.int32)
        return value, _Memory(gradient, _slopes(box, x, gradient, size), size, optimizer.init(x), one, none), ok

    return first


def _stop_code(box: Box, x: Array, loss: Array, memory: _Memory, ended: Array, tolerance: float) -> Array:
    """RUNNING, or the code of why the search stops.

    The gradient has vanished when its `_slopes` are small compared with the largest ones so far. If a search has
    `ended` otherwise, it is a success if a step as long as the coordinates, or to a side, would hardly change the loss.
    """
    small = jnp.maximum(tolerance, 8 * jnp.finfo(x.dtype).eps)
    slope = _slope(box, x, memory.gradient)
    level = _largest(slope * jnp.maximum(jnp.abs(box.inside(x)), 1)) <= _LEVEL * jnp.abs(loss)
    code = jnp.where(ended, jnp.where(level, STILL, STUCK), RUNNING)
    flat = jnp.all(_slopes(box, x, memory.gradient, memory.size) <= small * memory.largest)
    return jnp.where(flat, FLAT, code).astype(jnp.int32)


def descent(scalar: Scalar, box: Box, optimizer: GradientTransformation, tolerance: float) -> Method:
    """Descent by any optax transformation. A failed trial is rejected, and the next steps are a quarter as long."""
    import optax

    look = _evaluation(scalar, box)

    def iterate(carry: Carry) -> Carry:
        gradient, _, _, state, share, quiet = carry.memory
        update, after = optimizer.update(gradient, state, carry.x)
        x: PyTree = optax.apply_updates(carry.x, share * update)
        value, slope, ok = look(x)
        quiet = jnp.where(jnp.abs(carry.loss - value) <= tolerance * jnp.abs(carry.loss), quiet + 1, 0)
        bad = jnp.where(ok, 0, carry.bad + 1)
        ahead = carry.memory._replace(gradient=slope, state=after, quiet=quiet)
        memory = where(ok, _with_largest(ahead, box, x), carry.memory)
        memory = memory._replace(unit=jnp.where(ok, jnp.minimum(1, 1.1 * share), share / 4))
        x, value = where(ok, (x, value), (carry.x, carry.loss))
        ended = (memory.quiet >= _QUIET["other"]) | (bad > SHORTENINGS)
        return Carry(x, value, memory, _stop_code(box, x, value, memory, ended, tolerance), bad, carry.failures + ~ok)

    return Method(_start(look, box, optimizer), iterate)


def _loss_with_wall(
    look: Callable[[Array], tuple[Array, Array, Array]], unit: Array, wall: Array
) -> Callable[[Array], Array]:
    """x ↦ loss/unit, or `wall` where the trial fails; value and derivative by one call of `look`."""

    @jax.custom_jvp
    def loss_or_wall(x: Array) -> Array:
        value, _, ok = look(x)
        return jnp.where(ok, value / unit, wall)

    @loss_or_wall.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        value, slope, ok = look(primals[0])
        return jnp.where(ok, value / unit, wall), jnp.vdot(jnp.where(ok, slope / unit, 0), tangents[0])

    return loss_or_wall


def lbfgs(scalar: Scalar, box: Box, tolerance: float) -> Method:
    """optax's L-BFGS with its zoom line search, for which the loss of a failed trial is a high constant, a wall.

    The loss is measured in units of the largest component of the first gradient, since the line search has absolute
    tolerances.
    """
    import optax

    look = _evaluation(scalar, box)
    search = optax.scale_by_zoom_linesearch(max_linesearch_steps=20, initial_guess_strategy="one")
    optimizer = optax.lbfgs(linesearch=search)

    def first(x: Array) -> tuple[Array, _Memory, Array]:
        value, memory, ok = _start(look, box, optimizer)(x)
        steepest = _largest(memory.gradient)
        return value, memory._replace(unit=jnp.where(steepest > 0, steepest, 1)), ok

    def iterate(carry: Carry) -> Carry:
        gradient, _, _, state, unit, quiet = carry.memory
        now = carry.loss / unit
        wall = now + 1e3 * (1 + jnp.abs(now))
        scaled, loss_or_wall = gradient / unit, _loss_with_wall(look, unit, wall)
        update, after = optimizer.update(scaled, state, carry.x, value=now, grad=scaled, value_fn=loss_or_wall)
        x: PyTree = optax.apply_updates(carry.x, update)
        value, slope = (unit * optax.tree.get(after, name) for name in ("value", "grad"))  # at x, by the line search
        ok = value < unit * wall
        better = ok & (value <= carry.loss)
        quiet = jnp.where(better & (carry.loss - value <= tolerance * jnp.abs(carry.loss)), quiet + 1, 0)
        bad = jnp.where(better, 0, carry.bad + 1)
        ahead = carry.memory._replace(gradient=slope, state=after, quiet=quiet)
        again = carry.memory._replace(state=optimizer.init(carry.x))  # restart, after a failed line search
        memory = where(better, _with_largest(ahead, box, x), again)
        x, value = where(better, (x, value), (carry.x, carry.loss))
        ended = (quiet >= _QUIET["lbfgs"]) | (bad >= _SEARCHES)
        return Carry(x, value, memory, _stop_code(box, x, value, memory, ended, tolerance), bad, carry.failures + ~ok)

    return Method(first, iterate)


def newton_step(
    loss: Callable[[Array], Array], box: Box, y: Array, held: Array, largest: Array, tolerance: float
) -> tuple[Array, Array]:
    """Newton's step of a loss in the box, with some coordinates `held`, and its excess for each coordinate, (p,).

    The excess is the step over what is negligible: the square root of the tolerance, since the loss is quadratic, of
    the coordinate, or the tolerance itself of the `largest` coordinate so far. Along directions of which rounding
    errors hide the second derivative, the step is what it is at least.
    The second derivatives are exact, or by central differences of the gradient through `ReversibleAdjoint`, which
    supports reverse mode only.
    """
    gradient, eps = jax.grad(loss), jnp.finfo(y.dtype).eps
    directions = jnp.eye(y.size, dtype=y.dtype)
    try:
        H = lax.map(lambda v: jax.jvp(gradient, (y,), (v,))[1], directions)
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        h = jnp.cbrt(eps) * jnp.where(largest > 0, largest, 1)
        H = lax.map(lambda v: (gradient(y + h * v) - gradient(y - h * v)) / (2 * (h @ v)), directions)
    free = ~held & jnp.any(H != 0, axis=0)
    H = jnp.where(free[:, None] & free, (H + H.T) / 2, 0)
    diagonal, rows = jnp.abs(jnp.diagonal(H)), jnp.max(jnp.abs(H), axis=1)
    unit = 1 / jnp.sqrt(jnp.where(free, jnp.maximum(diagonal, eps * rows), 1))
    values, V = jnp.linalg.eigh(unit[:, None] * H * unit)
    floor = y.size * eps * jnp.max(jnp.abs(values))
    step = -unit * (V @ (V.T @ jnp.where(free, unit * gradient(y), 0) / jnp.maximum(jnp.abs(values), floor)))
    small = jnp.maximum(tolerance, 8 * eps)
    negligible = jnp.maximum(jnp.sqrt(small) * jnp.abs(y), small * largest)
    step = jnp.where(free, step, 0)
    return box.shortened(y, step), jnp.abs(step) / jnp.where(negligible > 0, negligible, 1)
