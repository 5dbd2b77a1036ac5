"""Newton's method inside `lax.custom_root`: a fixed number of iterations, exact derivatives by the implicit function.

A fixed count (no `while_loop`) lets XLA fuse the iterations of a whole batch. Derivatives of any order do not pass
through the iterations: `custom_root` differentiates the equation at its root, forward or reverse. The exception is
forward over reverse through a `scan`: there JAX differentiates the solver itself and ignores its rule. So iterations
and guesses must carry derivatives too: a `stop_gradient` around either would make `jax.hessian` of a run wrong,
silently. `root(done=…)` and `chords` loop until they are done instead, for large steps that would compile slowly and
not fuse.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import three, unrolled

_USES = 3  # corrections with each matrix of `chords`; 2 or more
_Unknown = TypeVar("_Unknown")  # an array, or a tuple or list of its components


def root(
    residual: Callable[[_Unknown], _Unknown],
    correction: Callable[[_Unknown, _Unknown], _Unknown],
    guess: _Unknown,
    iterations: int,
    unroll: bool = True,
    done: Callable[[_Unknown, _Unknown], Array] | None = None,
) -> tuple[_Unknown, _Unknown]:
    """The root of `residual` near `guess`.

    Args:
        residual: x ↦ F(x), of the same form as x: a scalar (), a vector (d,), or its components in a tuple or a list,
            which XLA fuses best. It may close over traced values.
        correction: (x, F(x)) ↦ the step to subtract; for Newton F'(x)⁻¹F(x), by the caller's own matrix.
        guess: the first iterate.
        iterations: the number of corrections, a Python integer.
        unroll: True writes the corrections out one after the other, which lets XLA fuse them; False makes a loop, which
            compiles a long correction once.
        done: (x, correction) ↦ True if no further correction is needed. Then `iterations` is the largest number, and
            the loop is a `while_loop`, as long as the slowest member of a batch needs: for large steps, whose unrolled
            iterations would compile slowly and gain nothing.

    Returns:
        The last iterate x, and F(x), by which the caller judges it. Derivatives of x are exact at a root; F(x) carries
        none.
    """

    def solve(function: Callable[[_Unknown], _Unknown], x: _Unknown) -> tuple[_Unknown, _Unknown]:
        def improved(x: _Unknown) -> tuple[_Unknown, _Unknown]:
            step = correction(x, function(x))
            return jax.tree.map(jnp.subtract, x, step), step

        if done is not None:
            x = _until(done, improved, x, iterations)
        elif unroll:
            for _ in range(iterations):
                x, _ = improved(x)
        else:
            x = lax.fori_loop(0, iterations, lambda _, x: improved(x)[0], x)
        return x, function(x)

    return lax.custom_root(residual, guess, solve, _tangent_solve, has_aux=True)


def chords(
    residual: Callable[[_Unknown], _Unknown],
    factored: Callable[[_Unknown, _Unknown], unrolled.Factored],
    size: Callable[[_Unknown], Array],
    guess: _Unknown,
    iterations: int,
) -> tuple[_Unknown, tuple[_Unknown, Array]]:
    """The root of `residual` near `guess` by Newton's method with each matrix used three times (Shamanskii 1967).

    The order is 4. The loop ends as soon as one more correction would leave a residual below round-off, as the rate of
    the last two predicts, so an approximate F' does no harm. It is a `while_loop`, as long as the slowest member of a
    batch needs; a member that is done does not move any more.

    Args:
        residual: x ↦ F(x), as in `root`.
        factored: (x, F(x)) ↦ F'(x), factored.
        size: F ↦ its size, relative to the terms that F sums up: round-off is eps.
        guess: the first iterate.
        iterations: the largest number of matrices.

    Returns:
        The last iterate x; F(x) there; the determinant of the last matrix K, which has the sign of det F'(x), since the
        corrections shrink: |1 − K⁻¹F'| < 1. Derivatives of x are exact at a root; the others carry none.
    """

    def solve(function: Callable[[_Unknown], _Unknown], x: _Unknown) -> tuple[_Unknown, tuple[_Unknown, Array]]:
        zero = 0 * jax.tree.leaves(x)[0].ravel()[0]
        eps = float(jnp.finfo(zero.dtype).eps)

        def one(carry: tuple[_Unknown, Array, Array, Array]) -> tuple[_Unknown, Array, Array, Array]:
            x, k, *_ = carry
            F = function(x)
            K = factored(x, F)
            sizes = []
            for use in range(_USES):
                F = function(x) if use else F
                sizes.append(size(F))
                x = jax.tree.map(jnp.subtract, x, K.solve(F))
            before, last = sizes[-2:]
            return x, k + 1, (last <= eps) | (last * last <= eps / 8 * before), K.determinant

        start = (x, jnp.zeros((), jnp.int32), jnp.zeros((), bool), zero)
        x, _, _, determinant = lax.while_loop(lambda carry: (carry[1] < iterations) & ~carry[2], one, start)
        return x, (function(x), determinant)

    return lax.custom_root(residual, guess, solve, _tangent_solve, has_aux=True)


def _until(
    done: Callable[[_Unknown, _Unknown], Array],
    improved: Callable[[_Unknown], tuple[_Unknown, _Unknown]],
    x: _Unknown,
    most: int,
) -> _Unknown:
    def one(carry: tuple[_Unknown, Array, Array]) -> tuple[_Unknown, Array, Array]:
        x, k, _ = carry
        x, step = improved(x)
        return x, k + 1, done(x, step)

    start = (x, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    return lax.while_loop(lambda carry: (carry[1] < most) & ~carry[2], one, start)[0]


def _tangent_solve(linear: Callable[[Any], Any], y: Any) -> Any:
    """x with linear(x) = y. `custom_root` gives the derivative of the residual as a function, not as a matrix."""
    if isinstance(y, tuple | list):
        kind = type(y)
        x = _tangent_solve(lambda v: jnp.stack(linear(kind(three.components(v)))), jnp.stack(y))
        return kind(three.components(x))
    if y.ndim == 0:
        return y / linear(jnp.ones_like(y))
    if y.shape[0] == 3:
        columns = [linear(e) for e in jnp.eye(3, dtype=y.dtype)]
        return jnp.stack(three.solve([[c[i] for c in columns] for i in range(3)], y, divide=True))
    return jnp.linalg.solve(jax.vmap(linear, out_axes=1)(jnp.eye(y.shape[0], dtype=y.dtype)), y)
