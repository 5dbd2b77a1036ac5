"""Newton's method inside `lax.custom_root`: a fixed number of iterations, exact derivatives by the implicit function.

A fixed count (no `while_loop`) lets XLA fuse the iterations of a whole batch. Derivatives of any order do not pass
through the iterations: `custom_root` differentiates the equation at its root, forward or reverse. The exception is
forward over reverse through a `scan`: there JAX differentiates the solver itself and ignores its rule. So iterations
and guesses must carry derivatives too: a `stop_gradient` around either would make `jax.hessian` of a run wrong,
silently. `root(done=…)` and `chords` loop until they are done instead, for large steps that would compile slowly and
not fuse.

**Which root.** An equation may have several, and iterations that do not converge steadily can end at any. A solve is
steady if its first correction was no longer than the guess and each later one at most half as long as the one before (a
quarter, for `chords`). Lengths below √eps are exempt, unknowns being of order 1. Newton's convergence theorem
guarantees this near a root, and an iteration that jumps over a fold violates it (Deuflhard, Newton Methods for
Nonlinear Problems, 2.1).
Of 180,000 random steps of the free body with 40 corrections, 167 found a root that is not on the branch from Δt = 0;
none of these solves was steady. A fixed number of up to four corrections is too few to stray and still reach round-off:
of 180,000 steps none did, so nothing is recorded there, which doubles the speed of the Cayley step.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import saved

_USES = 3  # corrections with each matrix of `chords`; 2 or more
_FEW = 4  # corrections of which every solve that comes to round-off is steady
_CHORD = 0.25  # the ratio of the lengths of two such corrections that the theorem for them grants
_ENOUGH = 1e-4  # units of rounding: a larger remainder would have the same sign in each step, and energy a slope
_MORE = 6  # corrections that cost as much as a new matrix of `repeated_chords` and the first correction by it
_STALLED = 2**16  # eps: a change below it that no longer falls is rounding
_Unknown = TypeVar("_Unknown")  # an array, or a tuple or list of its components
_Report = TypeVar("_Report")


def iterate_until_stalled(
    improve: Callable[[_Unknown], tuple[_Unknown, Array]], x: _Unknown, most: int, enough: float
) -> tuple[_Unknown, Array]:
    """Iterations until x no longer changes, at most `most`, and the last relative change.

    Args:
        improve: x ↦ the next x, and its relative change.
        x: the first iterate.
        most: the most iterations.
        enough: the change, in eps, at which they end; below 2¹⁶ eps they also end when it no longer falls.
    """
    dtype = jax.tree.leaves(x)[0].dtype
    eps = float(jnp.finfo(dtype).eps)

    def is_unfinished(carry: tuple[_Unknown, Array, Array, Array]) -> Array:
        _, change, before, n = carry
        return (n < most) & (change > enough * eps) & ((change > _STALLED * eps) | (change < before))

    def iterate(carry: tuple[_Unknown, Array, Array, Array]) -> tuple[_Unknown, Array, Array, Array]:
        x, before, _, n = carry
        x, change = improve(x)
        return x, change, before, n + 1

    far = jnp.full((), jnp.finfo(dtype).max, dtype)
    return lax.while_loop(is_unfinished, iterate, (x, far / 2, far, jnp.zeros((), int)))[:2]


def implicit_root(
    residual: Callable[[PyTree], PyTree],
    guess: _Unknown,
    solve: Callable[[Callable[[_Unknown], _Unknown], _Unknown], tuple[_Unknown, _Report]],
    tangent_solve: Callable[[Callable[[PyTree], PyTree], PyTree], PyTree],
    save: bool = True,
) -> tuple[_Unknown, _Report]:
    """`lax.custom_root` of a solver that gives a root and a report; reverse mode of a loop does not solve again.

    Args:
        residual: x ↦ F(x).
        guess: the first iterate.
        solve: (F, guess) ↦ the root, and what is to be known of the solution, without a derivative.
        tangent_solve: (F'(x), y) ↦ the solution of F'(x) v = y, with F'(x) given as a function.
        save: False lets reverse mode compute the root again.
    """

    def solve_and_save(function: Callable[[_Unknown], _Unknown], x: _Unknown) -> tuple[_Unknown, _Report]:
        x, report = solve(function, x)
        return saved(x) if save else x, report

    return lax.custom_root(residual, guess, solve_and_save, tangent_solve, has_aux=True)


def deferred_root(
    residual: Callable[[Array], Array],
    guess: Array,
    solve: Callable[[Callable[[Array], Array], Array], tuple[Array, Array]],
    tangent_solve: Callable[[Callable[[Array], Array], Array], Array],
) -> tuple[Array, Array]:
    """`implicit_root` for long equations: its derivative is traced only where it is needed.

    `lax.custom_root` traces F' and `tangent_solve` at once, a third of the time that the first step of a rod takes. The
    arguments are those of `implicit_root`, but `tangent_solve` may not close over traced values.
    """
    F, of_F = jax.closure_convert(residual, guess)
    find, of_find = jax.closure_convert(lambda x: solve(residual, x), guess)

    @jax.custom_jvp
    def root(x: Array, of_F: list[Array], of_find: list[Array]) -> tuple[Array, Array]:
        return find(x, *of_find)

    @root.defjvp
    def derivative(primals: PyTree, tangents: PyTree) -> PyTree:
        def differentiable(x: Array, of_F: list[Array], of_find: list[Array]) -> tuple[Array, Array]:
            return implicit_root(lambda x: F(x, *of_F), x, lambda _, x: find(x, *of_find), tangent_solve)

        return jax.jvp(differentiable, primals, tangents)

    return root(guess, of_F, of_find)


def root(
    residual: Callable[[_Unknown], _Unknown],
    correction: Callable[[_Unknown, _Unknown], _Unknown],
    guess: _Unknown,
    iterations: int,
    unroll: bool = True,
    done: Callable[[_Unknown, _Unknown], Array] | None = None,
    length: Callable[[_Unknown], Array] | None = None,
    first: Array | None = None,
) -> tuple[_Unknown, _Unknown, Array]:
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
        length: x ↦ the length of a correction; by default its largest component.
        first: the length that a steady solve may give its first correction; by default that of the guess.

    Returns:
        The last iterate x, F(x), by which the caller judges it, and whether the solve was steady. Derivatives of x are
        exact at a root; the others carry none.
    """

    size = length or _largest
    watched = done is not None or iterations > _FEW

    def solve(function: Callable[[_Unknown], _Unknown], x: _Unknown) -> tuple[_Unknown, tuple[_Unknown, Array]]:
        def improve(x: _Unknown, monitor: ContractionMonitor) -> tuple[_Unknown, ContractionMonitor, _Unknown]:
            step = correction(x, function(x))
            return jax.tree.map(jnp.subtract, x, step), monitor.update(size(step)) if watched else monitor, step

        monitor = ContractionMonitor.start(size(x) if first is None else first)
        if (is_done := done) is not None:

            def improve_and_judge(carry: PyTree) -> PyTree:
                x, monitor, k, _ = carry
                x, monitor, step = improve(x, monitor)
                return x, monitor, k + 1, is_done(x, step)

            start = (x, monitor, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
            x, monitor, *_ = lax.while_loop(lambda c: (c[2] < iterations) & ~c[3], improve_and_judge, start)
        elif unroll:
            for _ in range(iterations):
                x, monitor, _ = improve(x, monitor)
        else:
            x, monitor = lax.fori_loop(0, iterations, lambda _, carry: improve(*carry)[:2], (x, monitor))
        return x, (function(x), monitor.growth)

    loop = done is not None or not unroll  # unrolled corrections are cheaper than the code of XLA for a saved root
    x, (F, growth) = implicit_root(residual, guess, solve, _tangent_solve, save=loop)
    return x, F, _steady(growth)


class ContractionMonitor(NamedTuple):
    """The largest length allowed for the next correction, and the most by which a correction exceeded its limit."""

    limit: Array
    growth: Array

    @classmethod
    def start(cls, length: Array) -> ContractionMonitor:
        """The monitor before the first correction of a guess of that length."""
        return cls(length, jnp.zeros_like(length))

    def update(self, length: Array, ratio: float = 0.5) -> ContractionMonitor:
        """The monitor after a correction of that length: the next one may be `ratio` times as long."""
        return ContractionMonitor(ratio * length, jnp.maximum(self.growth, length - self.limit))


def _largest(x: PyTree) -> Array:
    """The largest component."""
    parts = [jnp.max(jnp.abs(lax.stop_gradient(leaf))) for leaf in jax.tree.leaves(x)]
    return functools.reduce(jnp.maximum, parts)


def _all_of(flags: PyTree) -> Array:
    """Whether all are True."""
    return functools.reduce(jnp.logical_and, [jnp.all(flag) for flag in jax.tree.leaves(flags)])


def _steady(growth: Array) -> Array:
    """Whether no correction was longer than allowed, from `ContractionMonitor.growth`."""
    return lax.stop_gradient(growth) <= math.sqrt(jnp.finfo(growth.dtype).eps)


def chords(
    residual: Callable[[_Unknown], _Unknown],
    factored: Callable[[_Unknown, _Unknown], la.Factored],
    size: Callable[[_Unknown], Array],
    length: Callable[[_Unknown], Array],
    units: _Unknown,
    guess: _Unknown,
    iterations: int,
) -> tuple[_Unknown, _Unknown, Array]:
    """The root of `residual` near `guess` by Newton's method with each matrix used three times (Shamanskii 1967).

    The order is 4. The loop ends as soon as one more correction would leave a residual below round-off, as the rate of
    the last two predicts, so an approximate F' does no harm. Next to a stiff or fast component the residual of another
    is below round-off too early, so the corrections of each must also have come to its own round-off, or have stalled.
    It is a `while_loop`, as long as the slowest member of a batch needs; a member that is done does not move any more.

    Args:
        residual: x ↦ F(x), as in `root`.
        factored: (x, F(x)) ↦ F'(x), factored.
        size: F ↦ its size, relative to the terms that F sums up: round-off is eps.
        length: of a correction of x, relative to x.
        units: of the components of x, of which the largest says how small a correction may be rounding.
        guess: the first iterate.
        iterations: the largest number of matrices.

    Returns:
        The last iterate x; F(x) there; and whether the solve was steady, each component came to its round-off, and all
        matrices had positive pivots, as F' has where Δt = 0. Derivatives of x are exact at a root.
    """

    def solve(function: Callable[[_Unknown], _Unknown], x: _Unknown) -> tuple[_Unknown, tuple[_Unknown, Array]]:
        eps = float(jnp.finfo(jax.tree.leaves(x)[0].dtype).eps)

        def settles(x: _Unknown, before: _Unknown, last: _Unknown, earlier: _Unknown) -> _Unknown:
            """Which components one more correction would not change, or are rounding: a new matrix has not helped."""
            rounding = _STALLED * eps * _largest(jax.tree.map(jnp.multiply, x, units))
            return jax.tree.map(
                lambda x, before, last, earlier, unit: (
                    (last * last <= eps * before * jnp.abs(x)) | ((8 * last > earlier) & (unit * last <= rounding))
                ),
                *(lax.stop_gradient(x), before, last, earlier, units),
            )

        def use_matrix(carry: PyTree) -> PyTree:
            x, monitor, k, earlier, settled, _ = carry
            F = function(x)
            K = factored(x, F)
            sizes, steps = [], []
            for use in range(_USES):
                F = function(x) if use else F
                sizes.append(size(F))
                step = K.solve(F)
                x = jax.tree.map(jnp.subtract, x, step)
                monitor = monitor.update(lax.stop_gradient(length(step)), _CHORD)
                steps.append(lax.stop_gradient(jax.tree.map(jnp.abs, step)))
            (before, last), (previous, newest) = sizes[-2:], steps[-2:]
            monitor = monitor._replace(growth=jnp.where(K.positive, monitor.growth, jnp.inf))
            settled = jax.tree.map(jnp.logical_or, settled, settles(x, previous, newest, earlier))
            done = (last <= eps) | (last * last <= eps / 8 * before)
            return x, monitor, k + 1, newest, settled, done & _all_of(settled)

        monitor, no = ContractionMonitor.start(lax.stop_gradient(length(x))), jnp.zeros((), bool)
        far = jax.tree.map(lambda x: jnp.full_like(x, jnp.finfo(x.dtype).max), lax.stop_gradient(x))
        start = (x, monitor, jnp.zeros((), jnp.int32), far, jax.tree.map(jnp.isnan, far), no)
        x, monitor, _, _, settled, _ = lax.while_loop(lambda c: (c[2] < iterations) & ~c[-1], use_matrix, start)
        return x, (function(x), jnp.where(_all_of(settled), monitor.growth, jnp.inf))

    traced_once = jax.jit(residual)  # its equations are many, and used five times
    x, (F, growth) = implicit_root(traced_once, guess, solve, _tangent_solve_by_elimination)
    return x, F, _steady(growth)


def _tangent_solve_by_elimination(linear: Callable[[PyTree], PyTree], y: PyTree) -> PyTree:
    """x with linear(x) = y, by the elimination of `chords`: pivoting, as of LU, depends on the units of the rows."""
    if isinstance(y, tuple | list):
        rows = [linear(type(y)(vectors.components(e))) for e in jnp.eye(len(y), dtype=y[0].dtype)]
        return la.factored(vectors.Matrix(rows).T).solve(y)
    if y.ndim == 0:
        return y / linear(jnp.ones_like(y))
    return la.factored(jax.vmap(linear, out_axes=1)(jnp.eye(len(y), dtype=y.dtype))).solve(y)


class _Chord(NamedTuple):
    """A state of `repeated_chords`: x, its last two corrections, the monitor, and the number of corrections.

    Three flags state whether more corrections are needed, whether by this matrix, and whether it is new. The conditions
    of the loops only read them: XLA may compile arithmetic differently in a condition and where it selects the members
    that go on.
    """

    x: Any
    change: Array
    before: Array
    monitor: ContractionMonitor
    n: Array
    unfinished: Array
    serves: Array
    is_new: Array

    @property
    def ratio(self) -> Array:
        return self.change / jnp.where(self.before > 0, self.before, 1)

    @property
    def missing(self) -> Array:
        """The length of all corrections to come, as these two predict it; at most that of the last."""
        return self.change * jnp.where(self.n < 2, 1, jnp.minimum(2 * self.ratio, 1))


def repeated_chords(
    residual: Callable[[_Unknown], _Unknown],
    factored: Callable[[_Unknown], la.Factored],
    length: Callable[[_Unknown], Array],
    x: _Unknown,
    first: Array,
    unit: Array,
    most: int,
) -> tuple[_Unknown, Array]:
    """The root of `residual` near x by Newton's method that uses a matrix as long as it serves.

    For many unknowns, where a matrix costs as much as several corrections. It is computed again when six more
    corrections would not do, by the ratio of the last two. A solve is steady if each correction was at most half as
    long as the last one by a new matrix: those by an old one may have helped little, and do not limit the next. The
    iteration ends when what is missing is 1e-4 units of rounding, or when a correction below 2¹⁶ units is more than
    half as long as the one before. This is rounding, by which x oscillates about the root, so half of it is applied:
    the whole would leave x more often on one side of the root than on the other, and the energy of a stiff rod would
    fall by 0.02 ulp a step.

    Args:
        residual: x ↦ F(x), as in `root`.
        factored: x ↦ F'(x), factored.
        length: of a correction.
        x: the first iterate.
        first: the length that a steady solve may give its first correction.
        unit: the length of a unit of rounding.
        most: the most corrections.

    Returns:
        The last iterate; and the length of what is missing there, infinite if the solve was not steady or a pivot was
        not positive.
    """

    def with_matrix(c: _Chord) -> _Chord:
        K = factored(c.x)

        def correct(c: _Chord) -> _Chord:
            step = K.solve(residual(c.x))
            change = lax.stop_gradient(length(step))
            monitor = c.monitor.update(change)
            monitor = monitor._replace(limit=jnp.where(c.is_new, monitor.limit, c.monitor.limit))
            found = c._replace(change=change, before=c.change, monitor=monitor, n=c.n + 1, is_new=~yes)
            small, ratio = change <= _STALLED * unit, found.ratio
            stalled = small & (ratio > 0.5)
            unfinished = (found.n < most) & (found.missing > _ENOUGH * unit) & ~stalled
            unfinished &= found.monitor.growth < jnp.inf
            serves = unfinished & (small | (change * ratio**_MORE <= _ENOUGH * unit))
            part = jnp.where(stalled, 0.5, 1).astype(change.dtype)
            x = jax.tree.map(lambda x, s: x - part * s, c.x, step)
            return found._replace(x=x, unfinished=unfinished, serves=serves)

        good = c.monitor._replace(growth=jnp.where(K.positive, c.monitor.growth, jnp.inf))
        return lax.while_loop(lambda c: c.serves, correct, c._replace(monitor=good, serves=yes, is_new=yes))

    far, yes = jnp.full_like(unit, jnp.finfo(unit.dtype).max), jnp.ones((), bool)
    start = _Chord(x, far, far, ContractionMonitor.start(first), jnp.zeros((), int), yes, yes, yes)
    end = lax.while_loop(lambda c: c.unfinished, with_matrix, start)
    return end.x, jnp.where(_steady(end.monitor.growth), end.missing, jnp.inf)


def quadratic(x: PyTree, step: PyTree) -> Array:
    """Whether the next correction, about the square of this one, would be round-off; unknowns are of the size 1."""
    return _largest(step) ** 2 <= jnp.finfo(jax.tree.leaves(x)[0].dtype).eps / 100 * _largest(x)


def _tangent_solve(linear: Callable[[PyTree], PyTree], y: PyTree) -> PyTree:
    """x with linear(x) = y. `custom_root` gives the derivative of the residual as a function, not as a matrix."""
    if isinstance(y, tuple | list):
        kind = type(y)
        x = _tangent_solve(lambda v: jnp.stack(linear(kind(vectors.components(v)))), jnp.stack(y))
        return kind(vectors.components(x))
    if y.ndim == 0:
        return y / linear(jnp.ones_like(y))
    if y.shape[0] == 3:
        columns = [linear(e) for e in jnp.eye(3, dtype=y.dtype)]
        return jnp.stack(vectors.Matrix(columns).T.solve(y, divide=True))
    return jnp.linalg.solve(jax.vmap(linear, out_axes=1)(jnp.eye(y.shape[0], dtype=y.dtype)), y)
