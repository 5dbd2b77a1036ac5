"""The result of a fit: estimate, covariance, whether it is a success, and remedies if it is not."""

from __future__ import annotations

import warnings
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.fitting._search import BEYOND, GOOD, HIDDEN, NOWHERE, REASONS, RUNNING, STUCK

Params = TypeVar("Params")  # a tree of arrays
_Numbers = PyTree  # arrays of JAX at the end of a search, of numpy in its report
_RARE = 4.75  # standard deviations of a normal distribution that one of a million values is above
_MOST_ROWS, _MOST_COLUMNS = 20, 6  # of the starts and parameters that a table shows
_NO_COVARIANCE = "only least-squares fits have a covariance: levenberg_marquardt, gauss_newton, scipy"
_TRY = {
    RUNNING: "raise `iterations`, or fit from several guesses with starts=True",
    STUCK: "look for noise or jumps in the loss and for failing solves, or fit from several guesses with starts=True",
    NOWHERE: "start where loss and gradient are finite and the solves converge",
    BEYOND: "divide the residuals by their standard deviation",
    HIDDEN: "give residuals of levenberg_marquardt more equal weights, or fit these parameters with the others held",
}


class MultiStartResult(NamedTuple, Generic[Params]):
    """The results of all starts of a fit, `fit.starts`, in the order of the guesses. Its `repr` is a table, best first.

    Attributes:
        params: the estimates; each leaf has a leading axis of starts.
        loss: the losses there, (starts,).
        success: whether each is a success, as in `Fit`, (starts,).
        at_bound: whether each has a parameter at its bound, as in `Fit`, (starts,).
        covariance: covariances as in `Fit`, (starts, p, p), or None if the fit is not by least squares.
        iterations: the numbers of iterations, (starts,).
        failures: the numbers of failed trials, (starts,).
        stopped: why each search stopped, in words.
        messages: the problem of each and remedies, as in `Fit.message`, without the error of the steps, which is
            measured for the best start alone.
    """

    params: Params
    loss: np.ndarray
    success: np.ndarray
    at_bound: np.ndarray
    covariance: np.ndarray | None
    iterations: np.ndarray
    failures: np.ndarray
    stopped: tuple[str, ...]
    messages: tuple[str, ...]

    @property
    def standard_errors(self) -> Params:
        """Square roots of the variances, in the structure of `params`; NaN without success."""
        if self.covariance is None:
            raise ValueError(_NO_COVARIANCE)
        errors = jnp.sqrt(jnp.diagonal(jnp.asarray(self.covariance), axis1=-2, axis2=-1))
        return jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], self.params))[1])(errors)

    def __repr__(self) -> str:
        order = np.argsort(np.where(np.isnan(self.loss), np.inf, self.loss), kind="stable")
        values = np.asarray(jax.vmap(lambda y: ravel_pytree(y)[0])(self.params))[:, :_MOST_COLUMNS]
        names = number_names(jax.tree.map(lambda leaf: leaf[0], self.params))[:_MOST_COLUMNS]
        columns = self.loss, self.success, self.iterations
        shown = list(zip(order, *(column[order] for column in columns), strict=True))[:_MOST_ROWS]
        rows = [
            [k, f"{loss:.6g}", "yes" if success else "no", made, *(f"{x:.6g}" for x in values[k])]
            for k, loss, success, made in shown
        ]
        cells = [[str(cell) for cell in row] for row in (["start", "loss", "success", "iterations", *names], *rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        edges = [", at a bound" if self.at_bound[k] else "" for k in order[:_MOST_ROWS]]
        ends = ["stopped", *(f"{self.stopped[k]}{edge}" for k, edge in zip(order, edges, strict=False))]
        lines = ["  ".join([*map(str.rjust, row, widths), end]) for row, end in zip(cells, ends, strict=True)]
        left = len(order) - len(rows)
        return "\n".join([*lines, *[f"… and {left} more"] * (left > 0)])


class Fit(NamedTuple, Generic[Params]):
    """The result of `fit`. With many starts, the best of them; `starts` holds all.

    Attributes:
        params: the estimate, a tree like the first guess.
        loss: the loss at the estimate; for least squares, half the sum of squares of the residuals.
        stopped: why the search stopped, in words.
        success: whether the estimate is a minimum within the bounds or reached the target, and, for `standardized`
            residuals, has a plausible χ².
        at_bound: whether a parameter is at its bound.
        iterations: the number of iterations.
        failures: the number of trials that failed (loss or gradient not finite, or not converged).
        history: the loss after each iteration, shape (iterations + 1,), the first guess first.
        covariance: the covariance of the estimate, (p, p) in the order of `ravel_pytree(params)`: the inverse of the
            Gauss–Newton matrix, for residuals in units of their standard deviation. A parameter at its bound has NaN,
            and is treated as known in that of the others. NaN without success, or of a variance
            that its precision cannot hold, as 1e-50 in float32; None if the fit is not by least squares.
        starts: with many starts, the result of each as a `MultiStartResult`, which prints as a table; otherwise None.
        message: the problem and remedies; empty after a success with no parameter at its bound and, for standardized
            residuals, with steps of negligible error.
        degrees_of_freedom: the number of residuals less that of the parameters that they determine and that are at no
            bound; None if the fit is not by least squares.
    """

    params: Params
    loss: float
    stopped: str
    success: bool
    at_bound: bool
    iterations: int
    failures: int
    history: np.ndarray
    covariance: np.ndarray | None
    starts: MultiStartResult[Params] | None
    message: str = ""
    degrees_of_freedom: int | None = None

    @property
    def chi_square(self) -> float:
        """Twice the loss: χ² of residuals in units of their standard deviation."""
        if self.degrees_of_freedom is None:
            raise ValueError("only least-squares fits have a χ²: levenberg_marquardt, gauss_newton, scipy")
        return 2 * self.loss

    @property
    def standard_errors(self) -> Params:
        """Square roots of the variances, in the structure of the parameters."""
        if self.covariance is None:
            raise ValueError(_NO_COVARIANCE)
        return ravel_pytree(self.params)[1](jnp.sqrt(jnp.diagonal(jnp.asarray(self.covariance))))

    @property
    def outcome(self) -> str:
        """Loss, number of iterations and why the search stopped, in one line."""
        edge = ", at a bound" if self.at_bound else ""
        failed = f", {self.failures} trials failed" if self.failures else ""
        return f"loss {self.loss:.6g} after {self.iterations} iterations: {self.stopped}{edge}{failed}"

    def __str__(self) -> str:
        """The outcome, a line for each parameter, with its standard error if it has one, and the message."""
        values = ravel_pytree(self.params)[0]
        spreads = ["" for _ in values]
        if self.covariance is not None:
            spreads = [f" ± {float(x):.2g}" for x in ravel_pytree(self.standard_errors)[0]]
        names = number_names(self.params)
        lines = [f"  {n} = {float(x):.8g}{s}" for n, x, s in zip(names, values, spreads, strict=True)]
        return "\n".join([self.outcome, *lines, *filter(None, [self.message])])


class End(NamedTuple):
    """Where searches have ended; with many starts, each leaf has a leading axis.

    Attributes:
        at_side: which coordinates are at a side of their box, (p,).
        loss: the least losses.
        code: why the searches stopped, indices of `REASONS`.
        made: the numbers of iterations.
        failures: the numbers of failed trials.
        covariance: of the parameters, or None.
        degrees: degrees of freedom, or None.
        far: which coordinates a step of Newton or Gauss–Newton, which the loss hides, still moves, (p,).
    """

    at_side: _Numbers
    loss: _Numbers
    code: _Numbers
    made: _Numbers
    failures: _Numbers
    covariance: _Numbers | None
    degrees: _Numbers
    far: _Numbers


def outcome(
    params: PyTree, names: list[str], end: End, history: np.ndarray, starts: bool, standardized: bool, cause: str
) -> Fit:
    """The `Fit` of a search; with `starts`, that of the search with the least loss.

    Args:
        params: the estimates; with `starts`, each leaf has a leading axis.
        names: the parameter to which each coordinate belongs.
        end: where the searches have ended.
        history: the losses after each iteration, (iterations + 1,) or (iterations + 1, starts).
        starts: whether there are many.
        standardized: whether χ² must be plausible.
        cause: why the first guess failed; "" if it did not.
    """
    plausible = _plausible(end) if standardized else np.ones(np.shape(end.code), bool)
    success = np.isin(end.code, GOOD) & plausible
    if end.covariance is not None:
        end = end._replace(covariance=np.where(success[..., None, None], end.covariance, np.nan))
    every = None
    if starts:
        messages = [
            _message(jax.tree.map(lambda leaf, k=k: leaf[k], end), names, bool(good))
            for k, good in enumerate(plausible)
        ]
        every = MultiStartResult(
            params,
            end.loss,
            success,
            end.at_side.any(axis=-1),
            end.covariance,
            end.made,
            end.failures,
            tuple(REASONS[k] for k in end.code),
            tuple(messages),
        )
        best = int(np.argmin(np.where(np.isfinite(end.loss), end.loss, np.inf)))
        params, end, success, plausible = jax.tree.map(lambda leaf: leaf[best], (params, end, success, plausible))
        history = history[:, best]
    code, made = int(end.code), int(end.made)
    message = _message(end, names, bool(plausible), cause)
    if not success and end.covariance is not None:
        reason = "the fit is no success" if code in GOOD else f"the fit did not converge ({REASONS[code]})"
        warnings.warn(f"{reason}: it has no standard errors; {message}", RuntimeWarning, stacklevel=3)
    return Fit(
        params,
        float(end.loss),
        REASONS[code],
        bool(success),
        bool(end.at_side.any()),
        made,
        int(end.failures),
        history[: made + 1],
        None if code in (NOWHERE, BEYOND) else end.covariance,
        every,
        message,
        None if end.degrees is None else int(end.degrees),
    )


def _plausible(end: End) -> np.ndarray:
    """Whether χ² is below its quantile of 1 − 1e-6, by Wilson & Hilferty 1931, Proc. Natl. Acad. Sci. 17, 684."""
    degrees = np.maximum(end.degrees, 1)
    width = 2 / (9 * degrees)
    return (2 * end.loss <= degrees * (1 - width + _RARE * np.sqrt(width)) ** 3) | (end.degrees < 1)


def _message(end: End, names: list[str], plausible: bool, cause: str = "") -> str:
    """The problem of a search, and remedies."""
    code, good = int(end.code), int(end.code) in GOOD
    if code == HIDDEN:
        moved = dict.fromkeys(name for name, far in zip(names, end.far, strict=True) if far)
        cause = f"the next step still moves {', '.join(moved)}"
    parts = [] if good else [f"{REASONS[code]}: {f'{cause}; ' if cause else ''}{_TRY[code]}"]
    if good and not plausible:
        parts.append(
            f"χ² = {2 * end.loss:.4g} is implausible for {end.degrees} degrees of freedom: fit from several guesses "
            "with starts=True; if none ends lower, the model is wrong or the standard deviation of the residuals too "
            f"small by a factor of {np.sqrt(2 * end.loss / end.degrees):.2g}"
        )
    at_side = dict.fromkeys(name for name, held in zip(names, end.at_side, strict=True) if held)
    if at_side:
        remedy = "it has no standard error" if good and plausible else "widen the bound, or begin elsewhere"
        parts.append(f"{', '.join(at_side)} at a bound: {remedy}")
    return "; ".join(parts)


def number_names(params: PyTree) -> list[str]:
    """For each number of a tree its name, with the index in its leaf."""
    return [
        _name(path, f"[{', '.join(map(str, index))}]" if index else "")
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
        for index in np.ndindex(np.shape(leaf))
    ]


def parameter_names(y: PyTree) -> list[str]:
    """For each number of a tree the name of its leaf."""
    return [_name(path) for path, leaf in jax.tree_util.tree_leaves_with_path(y) for _ in range(leaf.size)]


def _name(path: tuple[object, ...], place: str = "") -> str:
    return f"{jax.tree_util.keystr(path, simple=True, separator='.')}{place}" or "parameter"
