"""Fits: an optimiser around a loss that is a simulation, and may fail.

A trial whose loss or gradient is not finite, or which says `converged=False`, is a failed one: it is counted, the step
that led there is taken back and shortened, and nothing of it enters the state of the optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from lieint_jax import _checks
from lieint_jax.ensemble._over_members import over_members
from lieint_jax.fitting._bounds import confine, free, release
from lieint_jax.fitting._descent import descent, lbfgs
from lieint_jax.fitting._least_squares import least_squares, slopes, spread
from lieint_jax.fitting._search import (
    GOOD,
    NOWHERE,
    REASONS,
    RUNNING,
    TARGET,
    Carry,
    Method,
    residuals_of,
    valued,
    where,
)

LEAST_SQUARES = ("levenberg_marquardt", "gauss_newton")
_EDGE = 1e-6  # of the speed that a parameter had at first: where it counts as being at its bound


class Starts(NamedTuple):
    """What many starts found, each leaf with a leading axis.

    Attributes:
        params: the estimates.
        loss: there.
        success: whether each stopped for a good reason.
        at_bound: as of `Fit`, of each.
        covariance: as of `Fit`, (starts, p, p), or None.
    """

    params: Any
    loss: np.ndarray
    success: np.ndarray
    at_bound: np.ndarray
    covariance: np.ndarray | None


class Fit(NamedTuple):
    """What `fit` found. With many starts, the best of them; `starts` holds all.

    Attributes:
        params: the estimate, of the structure of the first guess.
        loss: there; of a least-squares fit half the sum of squares of the residuals.
        stopped: why it stopped, in words.
        success: whether it stopped for a good reason: a vanishing gradient; a loss that no longer falls and a gradient
            that is small; the target.
        at_bound: whether a parameter has run to the edge of its bound, where no gradient and no covariance tells more.
        iterations: how many were made.
        failures: how many trials failed (no finite loss and gradient, or not converged).
        history: the loss after each iteration, shape (iterations + 1,), the first guess first.
        covariance: of the estimate, (p, p) in the order of `ravel_pytree(params)`: the inverse of the Gauss–Newton
            matrix. For residuals in units of their standard deviation. None if it is no least-squares fit.
        starts: with many starts, what was found from each, with a leading axis; else None.
    """

    params: Any
    loss: float
    stopped: str
    success: bool
    at_bound: bool
    iterations: int
    failures: int
    history: np.ndarray
    covariance: np.ndarray | None
    starts: Starts | None

    @property
    def standard_errors(self) -> Any:
        """Square roots of the variances, in the structure of the parameters."""
        if self.covariance is None:
            raise ValueError("there is a covariance of least-squares fits only: levenberg_marquardt, gauss_newton")
        return ravel_pytree(self.params)[1](jnp.sqrt(jnp.diagonal(jnp.asarray(self.covariance))))

    def __str__(self) -> str:
        edge = ", at a bound" if self.at_bound else ""
        failed = f", {self.failures} trials failed" if self.failures else ""
        return f"loss {self.loss:.6g} after {self.iterations} iterations: {self.stopped}{edge}{failed}"


def fit(
    loss: Callable[..., Any],
    params: Any,
    optimizer: Any = "levenberg_marquardt",
    *,
    bounds: Any = free,
    iterations: int = 100,
    tolerance: float = 1e-10,
    target: float | None = None,
    starts: bool = False,
    data: Any = None,
    mesh: Mesh | None = None,
    progress: bool = True,
) -> Fit:
    """Minimise a loss over parameters.

    Args:
        loss: parameters ↦ a scalar; for "levenberg_marquardt" and "gauss_newton" ↦ residuals, an array of any shape
            or a tree of them, whose sum of squares is minimised. Either may come as a pair (value, converged), with
            the truth values of the solves behind it, or their `StepInfo`: a trial that did not converge has failed.
            Derivatives are taken forward (jacfwd) of residuals, in reverse of scalars.
        params: the first guess, a tree of arrays. With `starts`, each leaf has a leading axis of starts.
        optimizer: "levenberg_marquardt", "gauss_newton", "lbfgs" (optax, zoom line search), "adam", or any
            `optax.GradientTransformation`.
        bounds: a `Bound`, or a tree of them that matches the parameters as far as it goes.
        iterations: the most iterations.
        tolerance: stop when the gradient vanishes to this: the largest cosine between the residuals and a column of
            their Jacobian, or a scalar's gradient against its largest so far. Or when the loss falls by less than this,
            relative, and the gradient is small: once in least squares, where that cosine is below √tolerance; three
            times in a row ("lbfgs") or ten times (others), where the gradient times x is below 1e-5 of the loss. Or
            when the step of Gauss–Newton is below this, relative to x.
        target: stop when the loss is at most this.
        starts: whether many starts are fitted at once, vmapped, each device taking a share of them.
        data: what else the loss takes: loss(params, data). With `starts`, each start has its own: a leading axis.
        mesh: devices for many starts, as of `ensemble.run`; None takes all.
        progress: show a progress bar on stderr, if that is a terminal.

    Returns:
        A `Fit`. A failed trial never enters it: if even the first guess fails it says so, with the guess as it was.

    Raises:
        ValueError: an unknown optimiser, a guess outside its bounds, a loss that is no scalar where one is needed.
    """
    iterations = _checks.count("iterations", iterations, 0)
    if starts:
        _check_starts(params, data)
    x0 = jax.vmap(lambda p: release(bounds, p))(params) if starts else release(bounds, params)
    if starts and not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(x0)):
        raise ValueError("some of the starts are not inside their bounds")
    flat, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], x0) if starts else x0)
    takes = (lambda p, data: loss(p)) if data is None else loss

    def inside(x: Array) -> Any:
        return confine(bounds, unravel(x))

    def method(data: Any) -> Method:
        return _method(optimizer, lambda x: takes(inside(x), data), tolerance)

    def begin(x: Array, data: Any) -> _Fitted:
        value, memory, ok = method(data).first(x)
        none = jnp.zeros((), jnp.int32)
        return _Fitted(Carry(x, value, memory, jnp.where(ok, none, NOWHERE), none, none), x, value, none)

    def advance(old: _Fitted, data: Any) -> _Fitted:
        after = method(data).advance(old.carry)
        if target is not None:
            reached = (after.code == RUNNING) & (after.loss <= target)
            after = after._replace(code=jnp.where(reached, TARGET, after.code))
        best, least = where(after.loss < old.least, (after.x, after.loss), (old.best, old.least))
        return where(old.carry.code == RUNNING, _Fitted(after, best, least, old.made + 1), old)

    compiled = partial(over_members, mesh=mesh) if starts else jax.jit
    x = jax.vmap(lambda tree: ravel_pytree(tree)[0])(x0) if starts else flat
    go = compiled(advance)
    fitted = compiled(begin)(x, data)
    if optimizer in LEAST_SQUARES:  # looks for the first time
        fitted = go(fitted, data)
        fitted = fitted._replace(made=0 * fitted.made)
    fitted, history = _iterate(lambda f: go(f, data), fitted, iterations, progress)
    matrix = None
    if optimizer in LEAST_SQUARES:
        matrix = np.asarray(compiled(lambda f: spread(f.carry.memory.J, inside, f.carry.x))(fitted))
    edge = np.asarray((jax.vmap if starts else lambda f: f)(partial(_at_edge, inside))(fitted.best, x))
    return _result(fitted, history, inside, edge, matrix, starts)


def _check_starts(params: Any, data: Any) -> None:
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves((params, data))}
    if len(counts) != 1 or () in counts:
        raise ValueError(
            "with starts=True every leaf of params and data carries a leading axis of as many starts, got shapes "
            f"{[np.shape(leaf) for leaf in jax.tree.leaves((params, data))]}"
        )


class _Fitted(NamedTuple):
    """A search, the best place that it has seen, the loss there, and the iterations made."""

    carry: Carry
    best: Array
    least: Array
    made: Array


def _iterate(go: Any, fitted: _Fitted, iterations: int, progress: bool) -> tuple[_Fitted, np.ndarray]:
    """Iterations until all searches have ended, and the losses after each, the first guess first."""
    from tqdm import tqdm  # where it is used: the package imports in a moment

    history = [np.asarray(fitted.carry.loss)]
    with tqdm(total=iterations, unit="iteration", disable=None if progress else True, leave=False) as bar:
        for _ in range(iterations):
            if not np.any(np.asarray(fitted.carry.code) == RUNNING):
                break
            fitted = go(fitted)
            history.append(np.asarray(fitted.carry.loss))
            bar.update()
            bar.set_postfix_str(f"loss {np.nanmin(history[-1]):.4g}")
    return fitted, np.stack(history)


def _at_edge(inside: Callable[[Array], Any], x: Array, start: Array) -> Array:
    """Whether a parameter hardly moves with x any more."""

    def speed(x: Array) -> Array:
        return jnp.linalg.norm(slopes(inside, x), axis=0)

    return jnp.any(speed(x) <= _EDGE * speed(start))


def _result(
    fitted: _Fitted, history: np.ndarray, inside: Any, edge: np.ndarray, matrix: np.ndarray | None, starts: bool
) -> Fit:
    found = None
    if starts:
        losses, codes = np.asarray(fitted.least), np.asarray(fitted.carry.code)
        best = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
        found = Starts(jax.vmap(inside)(fitted.best), losses, np.isin(codes, GOOD), edge, matrix)
        fitted, history = jax.tree.map(lambda leaf: leaf[best], fitted), history[:, best]
        edge, matrix = edge[best], None if matrix is None else matrix[best]
    code, made = int(fitted.carry.code), int(fitted.made)
    return Fit(
        inside(fitted.best),
        float(fitted.least),
        REASONS[code],
        code in GOOD,
        bool(edge),
        made,
        int(fitted.carry.failures),
        history[: made + 1],
        None if code == NOWHERE else matrix,
        found,
    )


def covariance(residuals: Callable[..., Any], params: Any) -> Array:
    """(JᵀJ)⁻¹ of residuals in units of their standard deviation, (p, p) in the order of `ravel_pytree(params)`."""
    x, unravel = ravel_pytree(params)
    return spread(jax.jacfwd(lambda x: residuals_of(residuals, unravel(x))[0])(x), unravel, x)


def _method(optimizer: Any, loss: Callable[[Array], Any], tolerance: float) -> Method:
    """The optimiser for a loss of free parameters."""
    if optimizer in LEAST_SQUARES:
        return least_squares(lambda x: residuals_of(loss, x), optimizer == "gauss_newton", tolerance)

    def scalar(x: Array) -> tuple[Array, Array]:
        value, ok = valued(loss(x))
        if jnp.shape(value):
            raise ValueError(
                f"the loss must be a scalar for this optimiser, got shape {jnp.shape(value)}; for residuals take "
                '"levenberg_marquardt"'
            )
        return value, ok

    if optimizer == "lbfgs":
        return lbfgs(scalar, tolerance)
    if optimizer == "adam":
        import optax

        optimizer = optax.adam(1e-2)
    if not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise ValueError(
            'optimizer must be "levenberg_marquardt", "gauss_newton", "lbfgs", "adam" or an optax transformation, got '
            f"{optimizer!r}"
        )
    return descent(scalar, optimizer, tolerance)
