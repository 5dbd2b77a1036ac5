"""Newton's method inside `lax.custom_root`: a fixed number of iterations, exact derivatives by the implicit function.

A fixed count (no `while_loop`) lets XLA fuse the iterations of a whole batch. First derivatives never pass through
them: `custom_root` differentiates the equation at its root, forward or reverse. Nor do higher ones, but forward over
reverse through a `scan` does: there JAX keeps the solver and loses its rule. So iterations and guesses must carry
derivatives too: a `stop_gradient` around either would make `jax.hessian` of a run wrong, silently. `root(done=…)` and
`chords` loop until they are done instead, for large steps that would compile long and not fuse.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import three, unrolled

_USES = 3  # of each matrix of `chords`; 2 or more
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
        residual: F(x), as x a scalar (), a vector (d,) or its components in a tuple or a list, which XLA fuses best. It
            may close over traced values.
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
    """The root of `residual` near `guess`, each matrix of Newton's method being used several times (Shamanskii 1967).

    Three times, so the order is 4. It ends as soon as one more use would leave a residual below round-off, going by how
    the last two shrank, so a matrix that is not quite F' does no harm. A `while_loop`, whose length the slowest member
    of a batch decides; a member that is done does not move any more.

    Args:
        residual: F(x), as of `root`.
        factored: (x, F(x)) ↦ F'(x), factored.
        size: F ↦ its size, in units in which a root is exact to 1.
        guess: where to start.
        iterations: how many matrices at most.

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
