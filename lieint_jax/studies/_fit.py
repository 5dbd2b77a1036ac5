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
from jax.custom_batching import sequential_vmap
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from lieint_jax import checks
from lieint_jax.studies._bounds import confine, free, release
from lieint_jax.studies._members import over_members

RUNNING, FLAT, STILL, TARGET, STUCK, NOWHERE = range(6)
REASONS = (
    "the iterations were used up",
    "the gradient vanished",
    "the loss no longer fell",
    "the target was reached",
    "every shorter step failed or went up",
    "the first guess failed",
)
_GOOD = (FLAT, STILL, TARGET)
_LEAST_SQUARES = ("levenberg_marquardt", "gauss_newton")
_SHORTENINGS = 40  # in a row, before a fit gives up


class Starts(NamedTuple):
    """What many starts found, each leaf with a leading axis.

    Attributes:
        params: the estimates.
        loss: there.
        success: whether each stopped for a good reason.
        covariance: as of `Fit`, (starts, p, p), or None.
    """

    params: Any
    loss: np.ndarray
    success: np.ndarray
    covariance: np.ndarray | None


class Fit(NamedTuple):
    """What `fit` found. With many starts, the best of them; `starts` holds all.

    Attributes:
        params: the estimate, of the structure of the first guess.
        loss: there; of a least-squares fit half the sum of squares of the residuals.
        stopped: why it stopped, in words.
        success: whether it stopped for a good reason: a vanishing gradient, a loss that no longer falls, the target.
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
        failed = f", {self.failures} trials failed" if self.failures else ""
        return f"loss {self.loss:.6g} after {self.iterations} iterations: {self.stopped}{failed}"


class Carry(NamedTuple):
    """One start's state: where it is, the loss there, what the optimiser remembers, and how it is going."""

    x: Array
    loss: Array
    memory: Any
    code: Array
    bad: Array
    failures: Array
    made: Array


class _Method(NamedTuple):
    """An optimiser: its memory at a first guess, and one iteration."""

    first: Callable[[Array], tuple[Array, Any, Array]]  # x ↦ loss, memory, ok
    advance: Callable[[Carry], Carry]


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
            the flag of the solves behind it (`StepInfo.converged`): a trial without it has failed. A pair is always
            read so. Derivatives are taken forward (jacfwd) of residuals, in reverse of scalars.
        params: the first guess, a tree of arrays. With `starts`, each leaf has a leading axis of starts.
        optimizer: "levenberg_marquardt", "gauss_newton", "lbfgs" (optax, zoom line search), "adam", or any
            `optax.GradientTransformation`.
        bounds: a `Bound`, or a tree of them that matches the parameters as far as it goes.
        iterations: the most iterations.
        tolerance: stop when the gradient, scaled by the curvature or the loss, or ten falls of the loss in a row are
            below this, relative to the loss (Adam and the like go on up to `iterations` unless the loss is flat).
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
    from tqdm import tqdm  # where it is used: the package imports in a moment

    iterations = checks.count("iterations", iterations, 0)
    x0 = jax.vmap(lambda p: release(bounds, p))(params) if starts else release(bounds, params)
    if starts and not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(x0)):
        raise ValueError("some of the starts are not inside their bounds")
    example = jax.tree.map(lambda leaf: leaf[0], x0) if starts else x0
    flat, unravel = ravel_pytree(example)
    takes = (lambda p, data: loss(p)) if data is None else loss

    def method(data: Any) -> _Method:
        return _method(optimizer, lambda x: takes(confine(bounds, unravel(x)), data), tolerance)

    x = jax.vmap(lambda tree: ravel_pytree(tree)[0])(x0) if starts else flat

    def begin(x: Array, data: Any) -> Carry:
        value, memory, ok = method(data).first(x)
        count = jnp.zeros((), jnp.int32)
        return Carry(x, value, memory, jnp.where(ok, RUNNING, NOWHERE).astype(jnp.int32), count, 0 * count, 0 * count)

    def advance(carry: Carry, data: Any) -> Carry:
        after = method(data).advance(carry)
        if target is not None:
            reached = (after.code == RUNNING) & (after.loss <= target)
            after = after._replace(code=jnp.where(reached, TARGET, after.code))
        after = after._replace(made=carry.made + 1)
        return jax.tree.map(lambda new, old: jnp.where(carry.code == RUNNING, new, old), after, carry)

    def errors(carry: Carry) -> Array:
        return _spread(carry.memory.J, lambda x: confine(bounds, unravel(x)), carry.x)

    compiled = partial(over_members, mesh=mesh) if starts else jax.jit
    carry = compiled(begin)(x, data)
    advance = compiled(advance)
    if optimizer in _LEAST_SQUARES:
        carry = advance(carry, data)
        carry = carry._replace(made=0 * carry.made)
    history = [np.asarray(carry.loss)]
    with tqdm(total=iterations, unit="iteration", disable=None if progress else True, leave=False) as bar:
        for _ in range(iterations):
            if not np.any(np.asarray(carry.code) == RUNNING):
                break
            carry = advance(carry, data)
            history.append(np.asarray(carry.loss))
            bar.update()
            bar.set_postfix_str(f"loss {np.nanmin(history[-1]):.4g}")
    matrix = np.asarray(compiled(errors)(carry)) if optimizer in _LEAST_SQUARES else None
    return _result(carry, np.stack(history), lambda x: confine(bounds, unravel(x)), matrix, starts)


def _result(carry: Carry, history: np.ndarray, inside: Any, matrix: np.ndarray | None, starts: bool) -> Fit:
    found = None
    if starts:
        losses, codes = np.asarray(carry.loss), np.asarray(carry.code)
        best = int(np.argmin(np.where(codes == NOWHERE, np.inf, losses)))
        found = Starts(jax.vmap(inside)(carry.x), losses, np.isin(codes, _GOOD), matrix)
        carry, history = jax.tree.map(lambda leaf: leaf[best], carry), history[:, best]
        matrix = None if matrix is None else matrix[best]
    code, made = int(carry.code), int(carry.made)
    return Fit(
        inside(carry.x),
        float(carry.loss),
        REASONS[code],
        code in _GOOD,
        made,
        int(carry.failures),
        history[: made + 1],
        None if code == NOWHERE else matrix,
        found,
    )


def covariance(residuals: Callable[..., Any], params: Any) -> Array:
    """(JᵀJ)⁻¹ of residuals in units of their standard deviation, (p, p) in the order of `ravel_pytree(params)`."""
    x, unravel = ravel_pytree(params)
    return _spread(jax.jacfwd(lambda x: _residuals(residuals, unravel(x))[0])(x), unravel, x)


def _spread(J: Array, inside: Callable[[Array], Any], x: Array) -> Array:
    """D (JᵀJ)⁻¹ Dᵀ, J in the free parameters and D the derivative of the parameters in them."""
    D = jax.jacfwd(lambda x: ravel_pytree(inside(x))[0])(x)
    half = _solve_triangular(_triangle(J).T, D.T)  # R⁻ᵀDᵀ
    return half.T @ half


# LAPACK calls of one matrix at a time. XLA does those of a batch on the threads that run a CPU's devices, and waits for
# ever where each core is a device.


@sequential_vmap
def _svd(A: Array) -> tuple[Array, Array, Array]:
    return jnp.linalg.svd(A, full_matrices=False)


@sequential_vmap
def _triangle(A: Array) -> Array:
    return jnp.linalg.qr(A, mode="r")


@sequential_vmap
def _solve_triangular(L: Array, b: Array) -> Array:
    return jax.scipy.linalg.solve_triangular(L, b, lower=True)


def _value(outcome: Any) -> tuple[Any, Array]:
    """A value and its flag; a bare value has converged."""
    if isinstance(outcome, tuple) and len(outcome) == 2 and not hasattr(outcome, "_fields"):
        value, converged = outcome
        return value, jnp.all(jnp.asarray(converged))
    return outcome, jnp.ones((), bool)


def _residuals(function: Callable[..., Any], params: Any) -> tuple[Array, Array]:
    value, ok = _value(function(params))
    return ravel_pytree(value)[0], ok


def _method(optimizer: Any, loss: Callable[[Array], Any], tolerance: float) -> _Method:
    """The optimiser for a loss of free parameters."""
    if optimizer in _LEAST_SQUARES:
        return _least_squares(lambda x: _residuals(loss, x), optimizer == "gauss_newton", tolerance)
    import optax

    def scalar(x: Array) -> tuple[Array, Array]:
        value, ok = _value(loss(x))
        if jnp.shape(value):
            raise ValueError(
                f"the loss must be a scalar for this optimiser, got shape {jnp.shape(value)}; for residuals take "
                '"levenberg_marquardt"'
            )
        return value, ok

    if optimizer == "lbfgs":
        return _lbfgs(scalar, optax, tolerance)
    if optimizer == "adam":
        optimizer = optax.adam(1e-2)
    if not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise ValueError(
            'optimizer must be "levenberg_marquardt", "gauss_newton", "lbfgs", "adam" or an optax transformation, got '
            f"{optimizer!r}"
        )
    return _descent(scalar, optimizer, optax, tolerance)


class _Normal(NamedTuple):
    """What Gauss–Newton remembers: residuals and their Jacobian, the damping, and the length of a step."""

    r: Array
    J: Array
    damping: Array
    length: Array


def _least_squares(residuals: Callable[[Array], tuple[Array, Array]], undamped: bool, tolerance: float) -> _Method:
    """Gauss–Newton, damped as Marquardt has it: minimise |r + Jδ|² + λ|Dδ|², D² the diagonal of JᵀJ."""

    def look(x: Array) -> tuple[Array, Array, Array]:
        def twice(x: Array) -> tuple[Array, tuple[Array, Array]]:
            r, ok = residuals(x)
            return r, (r, ok)

        J, (r, ok) = jax.jacfwd(twice, has_aux=True)(x)
        return r, J, ok & jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))

    def first(x: Array) -> tuple[Array, _Normal, Array]:
        """Nothing yet: the first iteration goes nowhere and looks, so that the simulation is compiled once."""
        r, J, _ = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(look, x))
        one = jnp.ones((), r.dtype)
        return jnp.inf * one, _Normal(r, J, 0 * one if undamped else 1e-3 * one, one), jnp.ones((), bool)

    def advance(carry: Carry) -> Carry:
        r, J, damping, length = carry.memory
        D = jnp.sqrt(jnp.sum(J * J, axis=0))
        D = jnp.where(D > 0, D, 1)
        A = jnp.concatenate([J / D, jnp.sqrt(damping) * jnp.eye(D.size, dtype=D.dtype)])  # columns of length 1
        U, s, Vt = _svd(A)
        keep = s > jnp.finfo(s.dtype).eps * A.shape[0] * s[0]
        b = jnp.concatenate([r, jnp.zeros_like(D)])
        delta = -(Vt.T @ jnp.where(keep, (U.T @ b) / jnp.where(keep, s, 1), 0)) / D
        x = carry.x + length * delta
        new_r, new_J, ok = look(x)
        value = jnp.vdot(new_r, new_r) / 2
        better = ok & (value <= carry.loss)
        slope = jnp.max(jnp.abs((J / D).T @ r))  # the fall that is left, in the unit of |r|
        begun = jnp.isfinite(carry.loss)
        flat = begun & (slope <= tolerance * (jnp.sqrt(2 * carry.loss) + jnp.finfo(r.dtype).tiny))
        still = begun & better & (carry.loss - value <= tolerance * carry.loss)
        if undamped:
            length = jnp.where(better, jnp.minimum(1, 2 * length), length / 2)
        else:
            damping = jnp.where(better, jnp.maximum(damping / 5, 1e-12), 4 * damping)
        bad = jnp.where(better, 0, carry.bad + 1)
        tiny = jnp.max(jnp.abs(length * delta)) <= 4 * jnp.finfo(x.dtype).eps * (1 + jnp.max(jnp.abs(carry.x)))
        code = jnp.where(
            flat, FLAT, jnp.where(still | (begun & tiny & ok), STILL, jnp.where(bad > _SHORTENINGS, STUCK, RUNNING))
        )
        code = jnp.where(begun | ok, code, NOWHERE)
        kept = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (x, value, new_r, new_J), (carry.x, carry.loss, r, J)
        )
        return Carry(
            kept[0],
            kept[1],
            _Normal(kept[2], kept[3], damping, length),
            code.astype(jnp.int32),
            bad,
            carry.failures + ~ok,
            carry.made,
        )

    return _Method(first, advance)


class _Descent(NamedTuple):
    """What a gradient method remembers: the gradient, optax's own state, the length of a step, quiet iterations."""

    gradient: Array
    state: Any
    length: Array
    quiet: Array


def _looked(scalar: Callable[[Array], tuple[Array, Array]]) -> Callable[[Array], tuple[Array, Array, Array]]:
    """x ↦ loss, gradient and whether both are to be trusted."""

    def look(x: Array) -> tuple[Array, Array, Array]:
        (value, ok), gradient = jax.value_and_grad(scalar, has_aux=True)(x)
        return value, gradient, ok & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))

    return look


def _descent(scalar: Any, optimizer: Any, optax: Any, tolerance: float) -> _Method:
    """Any optax transformation. A failed trial is taken back, and the next steps are a quarter as long."""
    look = _looked(scalar)

    def first(x: Array) -> tuple[Array, _Descent, Array]:
        value, gradient, ok = look(x)
        return value, _Descent(gradient, optimizer.init(x), jnp.ones((), x.dtype), jnp.zeros((), jnp.int32)), ok

    def advance(carry: Carry) -> Carry:
        gradient, state, length, quiet = carry.memory
        update, after = optimizer.update(gradient, state, carry.x)
        x = optax.apply_updates(carry.x, length * update)
        value, new_gradient, ok = look(x)
        quiet = jnp.where(jnp.abs(carry.loss - value) <= tolerance * jnp.abs(carry.loss), quiet + 1, 0)
        bad = jnp.where(ok, 0, carry.bad + 1)
        code = jnp.where(
            ok & jnp.all(new_gradient == 0),
            FLAT,
            jnp.where(quiet >= 10, STILL, jnp.where(bad > _SHORTENINGS, STUCK, 0)),
        )
        length = jnp.where(ok, jnp.minimum(1, 1.1 * length), length / 4)
        memory = _Descent(new_gradient, after, length, jnp.where(ok, quiet, 0))
        kept = jax.tree.map(
            lambda new, old: jnp.where(ok, new, old),
            (x, value, memory),
            (carry.x, carry.loss, _Descent(gradient, state, length, quiet)),
        )
        memory = kept[2]._replace(length=length)
        return Carry(kept[0], kept[1], memory, code.astype(jnp.int32), bad, carry.failures + ~ok, carry.made)

    return _Method(first, advance)


def _lbfgs(scalar: Any, optax: Any, tolerance: float) -> _Method:
    """optax's L-BFGS with its zoom line search, which sees a high wall where a trial fails."""
    look = _looked(scalar)
    search = optax.scale_by_zoom_linesearch(max_linesearch_steps=20, initial_guess_strategy="one")
    optimizer = optax.lbfgs(linesearch=search)

    def first(x: Array) -> tuple[Array, _Descent, Array]:
        value, gradient, ok = look(x)
        return value, _Descent(gradient, optimizer.init(x), jnp.ones((), x.dtype), jnp.zeros((), jnp.int32)), ok

    def advance(carry: Carry) -> Carry:
        gradient, state, length, quiet = carry.memory
        wall = carry.loss + 1e3 * (1 + jnp.abs(carry.loss))

        @jax.custom_jvp
        def walled(x: Array) -> Array:
            value, _, ok = look(x)
            return jnp.where(ok, value, wall)

        @walled.defjvp
        def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
            value, slope, ok = look(primals[0])
            return jnp.where(ok, value, wall), jnp.vdot(jnp.where(ok, slope, 0), tangents[0])

        update, after = optimizer.update(gradient, state, carry.x, value=carry.loss, grad=gradient, value_fn=walled)
        x = optax.apply_updates(carry.x, update)
        value, new_gradient, ok = look(x)
        better = ok & (value <= carry.loss)
        fall = carry.loss - value
        quiet = jnp.where(better & (fall <= tolerance * jnp.abs(carry.loss)), quiet + 1, 0)
        bad = jnp.where(better, 0, carry.bad + 1)
        flat = jnp.max(jnp.abs(new_gradient)) <= tolerance * (1 + jnp.abs(value))
        code = jnp.where(better & flat, FLAT, jnp.where(quiet >= 3, STILL, jnp.where(bad > 2, STUCK, RUNNING)))
        fresh = optimizer.init(carry.x)  # after a failed search: steepest descent again
        kept = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (x, value, _Descent(new_gradient, after, length, quiet)),
            (carry.x, carry.loss, _Descent(gradient, fresh, length, quiet)),
        )
        return Carry(kept[0], kept[1], kept[2], code.astype(jnp.int32), bad, carry.failures + ~ok, carry.made)

    return _Method(first, advance)
