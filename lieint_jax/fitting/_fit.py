"""Fits: an optimizer around a loss that is a simulation, and may fail.

A trial has failed if its loss or gradient is not finite or its `converged` is False. Failed trials are counted; the
step that led to one is rejected and shortened, without an update of the optimizer's state.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Hashable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, TypeVar, Unpack, cast, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import remembered
from lieint_jax.fitting import _bounds
from lieint_jax.fitting._box import Box
from lieint_jax.fitting._descent import NEWTON, descent, lbfgs, newton_step
from lieint_jax.fitting._least_squares import jacobian, least_squares, spread
from lieint_jax.fitting._outcome import End, Fit, Params, number_names, outcome, parameter_names
from lieint_jax.fitting._scipy import Look, is_stuck
from lieint_jax.fitting._scipy import least_squares as by_scipy
from lieint_jax.fitting._search import (
    BEYOND,
    FLAT,
    GOOD,
    HIDDEN,
    NOWHERE,
    REASONS,
    RUNNING,
    SETTLED,
    SHORTENINGS,
    STILL,
    STUCK,
    TARGET,
    Carry,
    Method,
    check_real,
    residuals_of,
    value_and_flag,
    where,
)
from lieint_jax.fitting._step_error import complaint, shift, with_halved_steps
from lieint_jax.runs import over_members

if TYPE_CHECKING:
    from optax import GradientTransformation

LEAST_SQUARES = ("levenberg_marquardt", "gauss_newton", "scipy")
_MOST_KEPT = 16  # compiled fits
_Key = TypeVar("_Key", bound=Hashable)
_Flat = tuple[Any, tuple[Hashable, ...]]  # the structure and the leaves of a tree


class _Options(TypedDict, total=False):
    """The arguments of `fit` on which the type of its result does not depend."""

    bounds: PyTree
    iterations: int
    tolerance: float
    target: float | None
    standardized: bool
    starts: bool
    data: PyTree
    mesh: Mesh | None
    progress: bool


@overload
def fit(
    loss: Callable[..., PyTree],
    params: ArrayLike,
    optimizer: str | GradientTransformation = ...,
    **options: Unpack[_Options],
) -> Fit[Array]: ...
@overload
def fit(
    loss: Callable[..., PyTree],
    params: dict[_Key, ArrayLike],
    optimizer: str | GradientTransformation = ...,
    **options: Unpack[_Options],
) -> Fit[dict[_Key, Array]]: ...
@overload
def fit(
    loss: Callable[..., PyTree],
    params: Params,
    optimizer: str | GradientTransformation = ...,
    **options: Unpack[_Options],
) -> Fit[Params]: ...
def fit(
    loss: Callable[..., PyTree],
    params: PyTree,
    optimizer: str | GradientTransformation = "levenberg_marquardt",
    *,
    bounds: PyTree = _bounds.free,
    iterations: int = 100,
    tolerance: float = 1e-10,
    target: float | None = None,
    standardized: bool = False,
    starts: bool = False,
    data: PyTree = None,
    mesh: Mesh | None = None,
    progress: bool = True,
) -> Fit:
    """Fit parameters: minimize a loss, or the sum of squares of residuals, within bounds.

    A fit of the same loss, with arrays of the same shapes, is compiled once; again if the loss reads other numbers from
    outside than before. Numbers that change often are faster as `data`.

    Args:
        loss: parameters ↦ a scalar; for least squares ("levenberg_marquardt", "gauss_newton", "scipy") ↦ residuals, an
            array of any shape or a tree of them, whose sum of squares is minimized. Either may be returned as a pair
            (value, converged), where `converged` holds the flags or the `StepInfo` of the solves; a trial that did not
            converge has failed.
            Residuals are differentiated in forward mode (in reverse mode through `li.ReversibleAdjoint`), scalars in
            reverse mode.
        params: the first guess, a tree of arrays. With `starts`, each leaf has a leading axis of starts.
        optimizer: "levenberg_marquardt", "gauss_newton", "scipy" (`scipy.optimize.least_squares`, for one start),
            "lbfgs" (optax, zoom line search), "adam", or any `optax.GradientTransformation`.
        bounds: a `Bound`, or a tree of them that is a prefix of the tree of parameters. No trial leaves them.
        iterations: the largest number of iterations.
        tolerance: a relative tolerance, of at least 8 units of round-off. Least squares stops when the Gauss–Newton
            step within the bounds would lower the loss by less than this fraction, or is shorter than this fraction of
            the parameters; or when the loss no longer falls and the gradient has vanished. Other methods stop when the
            gradient is below this fraction of its largest value so far; or when the relative decrease of the loss is
            below it three times in a row ("lbfgs") or ten times (others), which is a success if the gradient times the
            parameters, or times their distance from a bound, is below 1e-5 of the loss.
            All these may hide parameters to which the loss is not sensitive. So for a success the next step must be
            small for each parameter (tensors: each coordinate) that is not at a bound: below the square root of the
            tolerance times the parameter, or below the tolerance times its largest value so far. For least squares it
            is the part of the Gauss–Newton step that lowers the loss by less than the tolerance, and may also be below
            the square root times the sum of what the residuals, one by one, contribute to it: at a minimum these
            cancel. For other methods it is Newton's step, for up to 200 parameters. The search goes on with these
            steps until they are small, or no longer become smaller, which is no success.
        target: stop when the loss is at most this.
        standardized: whether residuals are in units of their standard deviation, so that twice the loss should be χ²
            distributed. If it exceeds the quantile of 1 − 1e-6, the fit is not a success. The residuals are computed
            once more, at the estimate, with half the step size of each `li.integrate` and `li.event` in the loss.
        starts: whether many starts are fitted together, vmapped and split over the devices.
        data: a second argument of the loss: loss(params, data). With `starts`, every leaf has a leading axis of starts.
        mesh: devices for many starts, as in `li.run`; None uses all.
        progress: show a progress bar on stderr, if that is a terminal.

    Returns:
        A `Fit`. Failed trials do not contribute to it; if the first guess itself fails, `params` is that guess. A fit
        without success has a `message` with remedies.

    Warns:
        RuntimeWarning: a least-squares fit without success.
        UserWarning: for standardized residuals, the error of the steps moves a parameter by more than a fifth of its
            standard error.

    Raises:
        ValueError: the optimizer is unknown, there are no parameters or no residuals, either are not real numbers, the
            guess is not inside its bounds, or the loss is not a scalar where the optimizer needs one.
    """
    iterations = _checks.count("iterations", iterations, 0)
    tolerance = _checks.tolerance("tolerance", tolerance)
    y, tree = _vector(bounds, params, data, starts)
    problem = _Problem(loss, _flat(bounds), _flat(tree), optimizer, tolerance, target)
    if optimizer == "scipy" and starts:
        raise ValueError('optimizer="scipy" fits one start: use "levenberg_marquardt" with starts=True')
    if standardized and not problem.has_residuals:
        raise ValueError(f"standardized=True needs residuals: use one of the optimizers {', '.join(LEAST_SQUARES)}")
    programs = _programs(problem, starts, mesh)
    search = programs.begin(y, data)
    if problem.has_residuals:  # their first iteration only evaluates y
        search = programs.iterate(search, data)
        search = search._replace(made=0 * search.made)
    if optimizer == "scipy":
        search, history = _by_scipy(problem, programs, search, data, iterations)
    else:
        search, history = _iterate(lambda s: programs.iterate(s, data), search, iterations, progress)
    if problem.has_residuals:
        far = search.carry.memory.excess > 1
    else:
        search, history, far = _newton(problem, programs, search, y, data, history, iterations)
    at_side, matrix, rank = programs.finish(search, y)
    degrees = None if rank is None else search.carry.memory.r.shape[-1] - rank
    end = End(at_side, search.least, search.carry.code, search.made, search.carry.failures, matrix, degrees, far)
    end = jax.tree.map(np.asarray, end)
    estimates = programs.params(search.best)
    names = parameter_names(tree)
    cause = ""
    if np.all(end.code == NOWHERE):
        first = jax.tree.map(lambda leaf: leaf[0] if starts else leaf, (estimates, data))
        cause = _cause(loss, "residuals" if problem.has_residuals else "the loss", *first)
    found = outcome(estimates, names, end, history, starts, standardized, cause)
    if not (standardized and found.stopped in [REASONS[k] for k in GOOD]):
        return found
    if starts:
        k = int(np.nanargmin(end.loss))
        search, end, data = jax.tree.map(lambda leaf: leaf[k], (search, end, data))
    wrong = problem.step_error(programs.halved, search, end, data)
    if wrong:
        warnings.warn(wrong, UserWarning, stacklevel=2)
    return found._replace(message="; ".join(filter(None, [found.message, wrong])))


def _cause(loss: Callable[..., PyTree], result: str, params: PyTree, data: PyTree) -> str:
    """Why a loss fails: the first number of the data or its `result` that is not finite, a solve, or a derivative."""
    value, converged = jax.jit(lambda *given: value_and_flag(loss(*given)))(params, *(() if data is None else (data,)))
    for name, tree in (("data", data), (result, value)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            if not jnp.issubdtype(jnp.result_type(leaf), jnp.inexact):
                continue
            bad = np.argwhere(~np.isfinite(leaf))
            if len(bad):
                index = tuple(bad[0].tolist())
                return f"{name}{jax.tree_util.keystr(path)}{list(index) or ''} is {np.asarray(leaf)[index]}"
    return "a derivative is not finite" if converged else "its solves do not converge"


def _vector(bounds: PyTree, params: PyTree, data: PyTree, starts: bool) -> tuple[Array, PyTree]:
    """The coordinates of the first guess, (p,) or (starts, p), and the tree of their shapes for one start."""
    if not sum(np.size(leaf) for leaf in jax.tree.leaves(params)):
        raise ValueError(f"params holds no numbers: give a tree with at least one parameter to fit, got {params!r}")
    check_real("params", params, jnp.integer, jnp.bool_)
    if not starts:
        tree = _bounds.coordinates(bounds, params)
        return ravel_pytree(tree)[0], jax.eval_shape(lambda: tree)
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves((params, data))}
    if len(counts) != 1 or () in counts:
        raise ValueError(
            "with starts=True every leaf of params and data must have the same leading axis of starts, got shapes "
            f"{[np.shape(leaf) for leaf in jax.tree.leaves((params, data))]}"
        )
    y = jax.jit(jax.vmap(lambda p: _bounds.coordinates(bounds, p)))(params)
    if not _bounds.is_inside(bounds, y):
        raise ValueError("some of the starts are not inside their bounds")
    one = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[0], y))
    return jax.vmap(lambda tree: ravel_pytree(tree)[0])(y), one


class _Search(NamedTuple):
    """A search: its carry, its best point, the loss there, and the number of iterations."""

    carry: Carry
    best: Array
    least: Array
    made: Array


@dataclasses.dataclass(frozen=True)
class _Problem:
    """A loss as a function of a vector x, and the optimizer that minimizes it from one start.

    For residuals x holds the coordinates y of the bounds, for other losses all real numbers that `Box.inside` maps to
    them. Equal problems have the same programs; so trees are (structure, leaves), which can be compared.
    """

    loss: Callable[..., PyTree]
    flat_bounds: _Flat
    flat_tree: _Flat
    optimizer: str | GradientTransformation
    tolerance: float
    target: float | None

    @cached_property
    def bounds(self) -> PyTree:
        return jax.tree.unflatten(*self.flat_bounds)

    @cached_property
    def tree(self) -> PyTree:
        """The shapes of the tree of coordinates."""
        return jax.tree.unflatten(*self.flat_tree)

    @cached_property
    def box(self) -> Box:
        return _bounds.box(self.bounds, self.tree)

    @cached_property
    def unravel(self) -> Callable[[Array], PyTree]:
        """The map of a vector to a tree of coordinates."""
        return ravel_pytree(jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), self.tree))[1]

    @property
    def has_residuals(self) -> bool:
        return isinstance(self.optimizer, str) and self.optimizer in LEAST_SQUARES

    def coordinates(self, x: Array) -> Array:
        """The coordinates y of x."""
        return x if self.has_residuals else self.box.inside(x)

    def params(self, x: Array) -> PyTree:
        """The parameters of x."""
        return self._of_coordinates(self.coordinates(x))

    def _of_coordinates(self, y: Array) -> PyTree:
        return _bounds.parameters(self.bounds, self.unravel(y))

    def method(self, data: PyTree) -> Method:
        """The optimizer for this loss."""
        more = () if data is None else (data,)
        loss = lambda y: self.loss(self._of_coordinates(y), *more)  # noqa: E731
        return _method(self.optimizer, loss, self.box, self.tolerance)

    def begin(self, y: Array, data: PyTree) -> _Search:
        """The search at its first guess."""
        x = y if self.has_residuals else self.box.free(y)
        value, memory, ok = self.method(data).first(x)
        none = jnp.zeros((), jnp.int32)
        return _Search(Carry(x, value, memory, jnp.where(ok, none, NOWHERE), none, none), x, value, none)

    def iterate(self, old: _Search, data: PyTree) -> _Search:
        """The search after one more iteration; a search that has stopped does not change."""
        after = self.method(data).iterate(old.carry)
        if self.target is not None:
            reached = (after.code == RUNNING) & (after.loss <= self.target)
            after = after._replace(code=jnp.where(reached, TARGET, after.code))
        best, least = where(after.loss <= old.least, (after.x, after.loss), (old.best, old.least))
        return where(old.carry.code == RUNNING, _Search(after, best, least, old.made + 1), old)

    def newton(self, search: _Search, start: Array, data: PyTree) -> tuple[Array, Array]:
        """Newton's step of a scalar loss from the best point, and its excess, as in `newton_step`."""
        more = () if data is None else (data,)
        y = self.coordinates(search.best)
        return newton_step(
            lambda y: value_and_flag(self.loss(self._of_coordinates(y), *more))[0],
            self.box,
            y,
            self.box.at_side(y, start),
            search.carry.memory.size,
            self.tolerance,
        )

    def finish(self, search: _Search, start: Array) -> tuple[Array, Array | None, Array | None]:
        """Which coordinates are at a side of the box; for residuals the covariance of the parameters and J's rank."""
        at_side = self.box.at_side(self.coordinates(search.best), start)
        if not self.has_residuals:
            return at_side, None, None
        return at_side, *spread(search.carry.memory.J, self._parameters_by(search.carry.x), at_side)

    def _parameters_by(self, y: Array) -> Array:
        """The Jacobian of the parameters by the coordinates."""
        return jax.jacfwd(lambda y: ravel_pytree(self._of_coordinates(y))[0])(y)

    def halved(self, x: Array, data: PyTree) -> tuple[Array, Array, float] | None:
        """See `with_halved_steps`."""
        more = () if data is None else (data,)
        return with_halved_steps(lambda p: self.loss(p, *more), self.params(x))

    def step_error(self, halved: Callable[..., Any], search: _Search, end: End, data: PyTree) -> str:
        """What the error of the simulation's steps does to the estimate of residuals, and remedies; "" if little."""
        x, r, J = search.carry.x, search.carry.memory.r, search.carry.memory.J
        found = halved(x, data)
        if found is None or not found[1]:
            return ""
        finer, _, factor = found
        moved = shift(*map(np.asarray, (J, self._parameters_by(x), end.at_side, factor * (finer - r))))
        params = self.params(x)
        return complaint(number_names(params), np.asarray(ravel_pytree(params)[0]), moved, np.asarray(end.covariance))


def _flat(tree: PyTree) -> _Flat:
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple(leaves)


class _Programs(NamedTuple):
    """The compiled methods of a problem; `params` for all starts."""

    begin: Callable[..., _Search]
    iterate: Callable[..., _Search]
    newton: Callable[..., tuple[Array, Array]]
    finish: Callable[..., tuple[Array, Array | None, Array | None]]
    params: Callable[[Array], PyTree]
    halved: Callable[..., tuple[Array, Array, float] | None]


@remembered(_MOST_KEPT)
def _programs(problem: _Problem, starts: bool, mesh: Mesh | None) -> _Programs:
    """The programs of a problem, those of an earlier and equal one where there are any."""
    compiled = partial(over_members, mesh=mesh) if starts else jax.jit
    params = jax.jit(jax.vmap(problem.params)) if starts else problem.params
    begin, iterate, newton, finish = map(compiled, (problem.begin, problem.iterate, problem.newton, problem.finish))
    return _Programs(begin, iterate, newton, finish, params, jax.jit(problem.halved))


def _iterate(
    iterate: Callable[[_Search], _Search], search: _Search, iterations: int, progress: bool
) -> tuple[_Search, np.ndarray]:
    """Iterate until all searches have stopped; returns also the losses, of the first guess and of each iteration."""
    from tqdm import tqdm  # where it is used: the package imports in a moment

    history = [np.asarray(search.carry.loss)]
    with tqdm(total=iterations, unit="iteration", disable=None if progress else True, leave=False) as bar:
        for _ in range(iterations):
            if not np.any(np.asarray(search.carry.code) == RUNNING):
                break
            search = iterate(search)
            history.append(np.asarray(search.carry.loss))
            bar.update()
            bar.set_postfix_str(f"loss {np.nanmin(history[-1]):.4g}")
    return search, np.stack(history)


def _newton(
    problem: _Problem,
    programs: _Programs,
    search: _Search,
    start: Array,
    data: PyTree,
    history: np.ndarray,
    iterations: int,
) -> tuple[_Search, np.ndarray, np.ndarray]:
    """A search of a scalar loss after Newton's steps from its good end, until they are negligible for every coordinate.

    They go on while the loss falls, or the steps become shorter where it does not tell. Returned are the search, its
    losses, and which coordinates the next step would still move.
    """
    small = max(problem.tolerance, 8 * float(jnp.finfo(start.dtype).eps))
    judged = np.isin(search.carry.code, (FLAT, STILL, SETTLED))
    if not judged.any() or start.shape[-1] > NEWTON:
        return search, history, np.zeros(start.shape, bool)
    before = np.full(judged.shape, np.inf)  # the excess of the last step, inf where the loss fell by it
    while True:
        step, excess = programs.newton(search, start, data)
        far, worst = judged[..., None] & (np.asarray(excess) > 1), np.max(excess, axis=-1)
        moves = far.any(axis=-1) & (worst < before) & (np.asarray(search.made) < iterations)
        if not moves.any():
            break
        y, least = problem.coordinates(search.best), np.asarray(search.least)
        made, before = search.made + moves, np.where(moves, worst, before)
        for k in range(SHORTENINGS):
            trial = programs.begin(y + step / 2**k, data)
            taken = moves & (np.asarray(trial.carry.code) == RUNNING) & (trial.least <= least + small * np.abs(least))
            before = np.where(taken & (trial.least < least - small * np.abs(least)), np.inf, before)
            search = search._replace(
                best=jnp.where(taken[..., None], trial.best, search.best),
                least=jnp.where(taken, jnp.minimum(trial.least, least), search.least),
            )
            moves = moves & ~taken
            if not moves.any():
                break
        search = search._replace(made=made)
        history = np.concatenate([history, np.asarray(search.least)[None]])
    code = jnp.where(far.any(axis=-1), HIDDEN, search.carry.code)
    return search._replace(carry=search.carry._replace(code=code)), history, far


def _by_scipy(
    problem: _Problem, programs: _Programs, search: _Search, data: PyTree, iterations: int
) -> tuple[_Search, np.ndarray]:
    """The search, of which the first guess is evaluated, after that of scipy; and the losses of its trials."""
    if int(search.carry.code) in (NOWHERE, BEYOND):
        return search, np.asarray([search.carry.loss])

    def evaluated(x: np.ndarray) -> _Search:
        return programs.iterate(programs.begin(jnp.asarray(x, search.carry.x.dtype), data), data)

    def look(x: np.ndarray) -> Look:
        at = evaluated(x).carry
        return Look(np.asarray(at.memory.r, float), np.asarray(at.memory.J, float), bool(np.isfinite(at.loss)))

    found = by_scipy(look, np.asarray(search.carry.x), problem.box, problem.tolerance, iterations)
    end = evaluated(found.x)
    memory, code = end.carry.memory, found.code
    here = Look(np.asarray(memory.r, float), np.asarray(memory.J, float), True)
    if code != RUNNING and is_stuck(found, here, float(memory.newton), problem.box):
        code = STUCK
    code = TARGET if problem.target is not None and float(end.least) <= problem.target else code
    made = len(found.history) - 1
    carry = end.carry._replace(failures=np.int32(len(found.failed)))
    end = end._replace(carry=carry, made=np.int32(made))  # pyright: ignore
    if code in (FLAT, STILL, SETTLED) and np.any(memory.excess > 1):
        end = end._replace(carry=carry._replace(code=np.int32(RUNNING)))
        end, more = _iterate(lambda s: programs.iterate(s, data), end, iterations - made, False)
        return end, np.concatenate([found.history, more[1:]])
    return end._replace(carry=carry._replace(code=np.int32(code))), found.history  # pyright: ignore


def covariance(residuals: Callable[..., PyTree], params: PyTree) -> Array:
    """The covariance of parameters, (JᵀJ)⁻¹ with J the Jacobian of the residuals.

    Args:
        residuals: parameters ↦ residuals in units of their standard deviation, as in `fit`.
        params: the parameters, a tree of arrays.

    Returns:
        (p, p), in the order of `ravel_pytree(params)`.
    """
    x, unravel = ravel_pytree(params)
    J = jacobian(lambda x: (residuals_of(residuals, unravel(x))[0], None), x)[0]
    return spread(J, jnp.eye(x.size, dtype=x.dtype), jnp.zeros(x.shape, bool))[0]


def _method(
    optimizer: str | GradientTransformation, loss: Callable[[Array], PyTree], box: Box, tolerance: float
) -> Method:
    """The optimizer called `optimizer` for a loss of coordinates in a box."""
    if isinstance(optimizer, str) and optimizer in LEAST_SQUARES:
        return least_squares(lambda y: residuals_of(loss, y), box, optimizer == "gauss_newton", tolerance)

    def scalar(y: Array) -> tuple[Array, Array]:
        value, ok = value_and_flag(loss(y))
        if jnp.shape(value):
            raise ValueError(
                f"the loss must be a scalar for this optimizer, got shape {jnp.shape(value)}; for residuals choose "
                '"levenberg_marquardt"'
            )
        check_real("the loss", value)
        return value, ok

    match optimizer:
        case "lbfgs":
            return lbfgs(scalar, box, tolerance)
        case "adam":
            import optax

            return descent(scalar, box, optax.adam(1e-2), tolerance)
        case object(init=_, update=_):
            return descent(scalar, box, cast("GradientTransformation", optimizer), tolerance)
    raise ValueError(
        'optimizer must be "levenberg_marquardt", "gauss_newton", "scipy", "lbfgs", "adam" or an optax transformation, '
        f"got {optimizer!r}"
    )
