"""Newton's method inside `lax.custom_root`: a fixed number of iterations, exact derivatives by the implicit function.

A fixed count (no `while_loop`) lets XLA fuse the iterations of a whole batch, and no derivative ever passes through
them: `custom_root` differentiates the equation at its root, forward or reverse, nested as you like.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax import small


def root(
    residual: Callable[[Array], Array],
    correction: Callable[[Array, Array], Array],
    guess: Array,
    iterations: int,
    unroll: bool = True,
    done: Callable[[Array, Array], Array] | None = None,
) -> tuple[Array, Array]:
    """The root of `residual` near `guess`.

    Args:
        residual: F(x), same shape as x: a scalar () or a vector (d,). It may close over traced values.
        correction: (x, F(x)) ↦ the step to subtract; Newton's is F'(x)⁻¹F(x), with a matrix the caller knows.
        guess: where to start.
        iterations: how many corrections, a Python integer.
        unroll: whether to write the corrections out one after the other, which lets XLA fuse them, or to loop, which
            compiles once what is long.
        done: (x, correction) ↦ whether no further one is needed. Then `iterations` is a budget, and the loop is a
            `while_loop`, whose length the slowest member of a batch decides: for large steps, whose unrolled iterations
            would take long to compile and gain nothing.

    Returns:
        The last iterate x and F(x) there, for the caller to judge. Derivatives of x are exact at a root; F(x) carries
        none.
    """

    def solve(function: Callable[[Array], Array], x: Array) -> tuple[Array, Array]:
        def improved(x: Array) -> tuple[Array, Array]:
            step = correction(x, function(x))
            return x - step, step

        if done is not None:
            x = _until(done, improved, x, iterations)
        elif unroll:
            for _ in range(iterations):
                x, _ = improved(x)
        else:
            x = lax.fori_loop(0, iterations, lambda _, x: improved(x)[0], x)
        return x, function(x)

    return lax.custom_root(residual, guess, solve, _tangent_solve, has_aux=True)


def _until(
    done: Callable[[Array, Array], Array], improved: Callable[[Array], tuple[Array, Array]], x: Array, most: int
) -> Array:
    def one(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, k, _ = carry
        x, step = improved(x)
        return x, k + 1, done(x, step)

    start = (x, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    return lax.while_loop(lambda carry: (carry[1] < most) & ~carry[2], one, start)[0]


def _tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
    """x with linear(x) = y. `custom_root` gives the derivative of the residual as a function, not as a matrix."""
    if y.ndim == 0:
        return y / linear(jnp.ones_like(y))
    if y.shape[0] == 3:
        columns = [linear(e) for e in jnp.eye(3, dtype=y.dtype)]
        return jnp.stack(small.solve([[c[i] for c in columns] for i in range(3)], y, divide=True))
    return jnp.linalg.solve(jax.vmap(linear, out_axes=1)(jnp.eye(y.shape[0], dtype=y.dtype)), y)
