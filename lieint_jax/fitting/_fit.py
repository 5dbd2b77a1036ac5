"""Fits: an optimiser around a loss that is a simulation, and may fail.

A trial has failed if its loss or gradient is not finite or its `converged` is False. Failed trials are counted; the
step that led to one is taken back and shortened, and the optimiser's state is not updated by it.
"""

from __future__ import annotations

import dataclasses
import warnings
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
from lieint_jax.fitting._least_squares import jacobian, least_squares, slopes, spread
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
_EDGE = 1e-6  # |∂p/∂x| over its first value, below which a parameter p counts as at its bound


class Starts(NamedTuple):
    """The results of all starts, each leaf with a leading axis of starts.

    Attributes:
        params: the estimates.
        loss: the losses there.
        success: whether each stopped for a good reason, as in `Fit`.
        at_bound: whether each has a parameter at the edge of its bound, as in `Fit`.
        covariance: covariances as in `Fit`, (starts, p, p), or None.
    """

    params: Any
    loss: np.ndarray
    success: np.ndarray
    at_bound: np.ndarray
    covariance: np.ndarray | None


class Fit(NamedTuple):
    """The result of `fit`. With many starts, the best of them; `starts` holds all.

    Attributes:
        params: the estimate, a tree like the first guess.
        loss: the loss at the estimate; for least squares, half the sum of squares of the residuals.
        stopped: why the search stopped, in words.
        success: whether it stopped for a good reason: a vanishing gradient; a loss that no longer falls and a gradient
            that is small; the target.
        at_bound: whether a parameter has run to the edge of its bound, where gradient and covariance mean nothing.
        iterations: the number of iterations.
        failures: the number of trials that failed (loss or gradient not finite, or not converged).
        history: the loss after each iteration, shape (iterations + 1,), the first guess first.
        covariance: of the estimate, (p, p) in the order of `ravel_pytree(params)`: the inverse of the Gauss–Newton
            matrix, for residuals in units of their standard deviation. NaN if the search stopped for no good reason;
            None if the fit is not by least squares.
        starts: with many starts, the result of each, with a leading axis; else None.
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
            raise ValueError("only least-squares fits have a covariance: levenberg_marquardt, gauss_newton")
        return ravel_pytree(self.params)[1](jnp.sqrt(jnp.diagonal(jnp.asarray(self.covariance))))

    @property
    def outcome(self) -> str:
        """Loss, number of iterations and why the search stopped, in a line."""
        edge = ", at a bound" if self.at_bound else ""
        failed = f", {self.failures} trials failed" if self.failures else ""
        return f"loss {self.loss:.6g} after {self.iterations} iterations: {self.stopped}{edge}{failed}"

    def __str__(self) -> str:
        errors = self.standard_errors if self.covariance is not None else None
        return "\n".join([self.outcome, *_lines(self.params, errors)])


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
            or a tree of them, whose sum of squares is minimised. Either may be returned as a pair (value, converged),
            where `converged` holds the flags or the `StepInfo` of the solves; a trial that did not converge has failed.
            Residuals are differentiated in forward mode (in reverse mode through `studies.observe` and `reversible`),
            scalars in reverse mode.
        params: the first guess, a tree of arrays. With `starts`, each leaf has a leading axis of starts.
        optimizer: "levenberg_marquardt", "gauss_newton", "lbfgs" (optax, zoom line search), "adam", or any
            `optax.GradientTransformation`.
        bounds: a `Bound`, or a tree of them that is a prefix of the tree of parameters.
        iterations: the largest number of iterations.
        tolerance: stop when the gradient is below this: in least squares the largest cosine between the residuals and
            a column of their Jacobian, else the gradient over its largest so far. Or when the relative fall of the loss
            is below this and the gradient is small: once in least squares, where that cosine is below √tolerance; three
            times in a row ("lbfgs") or ten times (others), where the gradient times x is below 1e-5 of the loss. Or
            when the step of Gauss–Newton, relative to x, is below this.
        target: stop when the loss is at most this.
        starts: whether many starts are fitted at once, vmapped and split over the devices.
        data: a second argument of the loss: loss(params, data). With `starts`, every leaf has a leading axis of starts.
        mesh: devices for many starts, as in `ensemble.run`; None takes all.
        progress: show a progress bar on stderr, if that is a terminal.

    Returns:
        A `Fit`. Failed trials do not enter it; if the first guess itself fails, `stopped` says so and `params` is it.

    Raises:
        ValueError: an unknown optimiser, a guess outside its bounds, a loss that is no scalar where one is needed.
    """
    iterations = _checks.count("iterations", iterations, 0)
    x, unravel = _free_vector(bounds, params, data, starts)
    problem = _Problem(loss, bounds, unravel, optimizer, tolerance, target)
    compiled = partial(over_members, mesh=mesh) if starts else jax.jit
    advance = compiled(problem.advance)
    search = compiled(problem.begin)(x, data)
    if optimizer in LEAST_SQUARES:  # whose first iteration only evaluates x
        search = advance(search, data)
        search = search._replace(made=0 * search.made)
    search, history = _iterate(lambda s: advance(s, data), search, iterations, progress)
    matrix = np.asarray(compiled(problem.covariance)(search)) if optimizer in LEAST_SQUARES else None
    at_edge = jax.jit(jax.vmap(problem.at_edge)) if starts else problem.at_edge
    return _result(search, history, problem.params, np.asarray(at_edge(search.best, x)), matrix, starts)


def _free_vector(bounds: Any, params: Any, data: Any, starts: bool) -> tuple[Array, Callable[[Array], Any]]:
    """The first guess as a vector of free parameters, (p,) or (starts, p), and the map back to a tree of them."""
    if not starts:
        return ravel_pytree(release(bounds, params))
    _check_starts(params, data)
    x = jax.jit(jax.vmap(lambda p: release(bounds, p)))(params)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(x)):
        raise ValueError("some of the starts are not inside their bounds")
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], x))
    return jax.vmap(lambda tree: ravel_pytree(tree)[0])(x), unravel


def _check_starts(params: Any, data: Any) -> None:
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves((params, data))}
    if len(counts) != 1 or () in counts:
        raise ValueError(
            "with starts=True every leaf of params and data carries a leading axis of as many starts, got shapes "
            f"{[np.shape(leaf) for leaf in jax.tree.leaves((params, data))]}"
        )


class _Search(NamedTuple):
    """A search: its carry, its best point, the loss there, and the number of iterations."""

    carry: Carry
    best: Array
    least: Array
    made: Array


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    """A loss as a function of free parameters x, a vector, and the optimiser that minimises it from one start."""

    loss: Callable[..., Any]
    bounds: Any
    unravel: Callable[[Array], Any]
    optimizer: Any
    tolerance: float
    target: float | None

    def params(self, x: Array) -> Any:
        """The parameters, within their bounds, of the free x."""
        return confine(self.bounds, self.unravel(x))

    def method(self, data: Any) -> Method:
        """The optimiser for this loss of x."""
        more = () if data is None else (data,)
        return _method(self.optimizer, lambda x: self.loss(self.params(x), *more), self.tolerance)

    def begin(self, x: Array, data: Any) -> _Search:
        """The search at its first guess."""
        value, memory, ok = self.method(data).first(x)
        none = jnp.zeros((), jnp.int32)
        return _Search(Carry(x, value, memory, jnp.where(ok, none, NOWHERE), none, none), x, value, none)

    def advance(self, old: _Search, data: Any) -> _Search:
        """The search after one more iteration; a search that has stopped stays as it is."""
        after = self.method(data).advance(old.carry)
        if self.target is not None:
            reached = (after.code == RUNNING) & (after.loss <= self.target)
            after = after._replace(code=jnp.where(reached, TARGET, after.code))
        best, least = where(after.loss < old.least, (after.x, after.loss), (old.best, old.least))
        return where(old.carry.code == RUNNING, _Search(after, best, least, old.made + 1), old)

    def covariance(self, search: _Search) -> Array:
        """The covariance of the parameters where a least-squares search has stopped."""
        return spread(search.carry.memory.J, self.params, search.carry.x)

    def at_edge(self, x: Array, start: Array) -> Array:
        """True if a parameter hardly depends on x any more, compared with the start: it is at its bound."""

        def speed(x: Array) -> Array:
            return jnp.linalg.norm(slopes(self.params, x), axis=0)

        return jnp.any(speed(x) <= _EDGE * speed(start))


def _lines(params: Any, errors: Any) -> list[str]:
    """A line for each parameter: its name in the tree, its value, and its standard error if there is one."""
    named = jax.tree_util.tree_leaves_with_path(params)
    spreads = jax.tree.leaves(errors) if errors is not None else [None] * len(named)
    lines = []
    for (path, leaf), error in zip(named, spreads, strict=True):
        for index in np.ndindex(np.shape(leaf)):
            place = f"[{', '.join(map(str, index))}]" if index else ""
            spread = "" if error is None else f" ± {float(np.asarray(error)[index]):.2g}"
            name = f"{jax.tree_util.keystr(path, simple=True, separator='.')}{place}" or "parameter"
            lines.append(f"  {name} = {float(np.asarray(leaf)[index]):.8g}{spread}")
    return lines


def _iterate(
    advance: Callable[[_Search], _Search], search: _Search, iterations: int, progress: bool
) -> tuple[_Search, np.ndarray]:
    """Iterate until all searches have stopped; also the losses after each iteration, the first guess first."""
    from tqdm import tqdm  # where it is used: the package imports in a moment

    history = [np.asarray(search.carry.loss)]
    with tqdm(total=iterations, unit="iteration", disable=None if progress else True, leave=False) as bar:
        for _ in range(iterations):
            if not np.any(np.asarray(search.carry.code) == RUNNING):
                break
            search = advance(search)
            history.append(np.asarray(search.carry.loss))
            bar.update()
            bar.set_postfix_str(f"loss {np.nanmin(history[-1]):.4g}")
    return search, np.stack(history)


def _result(
    search: _Search,
    history: np.ndarray,
    to_params: Callable[[Array], Any],
    edge: np.ndarray,
    matrix: np.ndarray | None,
    starts: bool,
) -> Fit:
    """The `Fit` of a search; with `starts`, that of the search with the least loss."""
    every = None
    if starts:
        losses, codes = np.asarray(search.least), np.asarray(search.carry.code)
        best = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
        good = np.isin(codes, GOOD)
        if matrix is not None:
            matrix = np.where(good[:, None, None], matrix, np.nan)
        every = Starts(jax.jit(jax.vmap(to_params))(search.best), losses, good, edge, matrix)
        search, history = jax.tree.map(lambda leaf: leaf[best], search), history[:, best]
        edge, matrix = edge[best], None if matrix is None else matrix[best]
    code, made = int(search.carry.code), int(search.made)
    if code not in GOOD and matrix is not None:
        matrix = np.full_like(matrix, np.nan)
        warnings.warn(
            f"the fit did not converge ({REASONS[code]}): it has no standard errors", RuntimeWarning, stacklevel=3
        )
    return Fit(
        to_params(search.best),
        float(search.least),
        REASONS[code],
        code in GOOD,
        bool(edge),
        made,
        int(search.carry.failures),
        history[: made + 1],
        None if code == NOWHERE else matrix,
        every,
    )


def covariance(residuals: Callable[..., Any], params: Any) -> Array:
    """(JᵀJ)⁻¹ of residuals in units of their standard deviation, (p, p) in the order of `ravel_pytree(params)`."""
    x, unravel = ravel_pytree(params)
    return spread(jacobian(lambda x: (residuals_of(residuals, unravel(x))[0], None), x)[0], unravel, x)


def _method(optimizer: Any, loss: Callable[[Array], Any], tolerance: float) -> Method:
    """The optimiser called `optimizer` for a loss of free parameters."""
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
