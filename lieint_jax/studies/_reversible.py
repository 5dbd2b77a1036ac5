"""Trajectories whose reverse-mode derivative costs no memory: a symmetric step is undone, not remembered.

Backwards from the end, step(·, −Δt) rebuilds the state that step(·, Δt) came from, and the cotangents of one step are
pulled back there:

    z_n = Ψ₋(z_{n+1}),    (λ_n, θ̄, Δ̄) = (∂Ψ(z_n)/∂(z, θ, Δt))ᵀ λ_{n+1}

A composition is undone sub-step by sub-step. Only the saved states are kept, which the caller holds anyway. At each of
them the rebuilt state is compared with the saved one and put aside, so the errors of rounding do not add up from one
interval to the next.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import checks
from lieint_jax.diagnostics.order import distance
from lieint_jax.integrate import from_start, intervals, promoted, steps
from lieint_jax.schemes.compose import Composition
from lieint_jax.studies._components import repeat
from lieint_jax.types import State, Step, StepInfo, Trajectory, concrete, pytree, static

Derivative = Literal["reversible", "checkpoint"]
_LEVELS = 3  # of nested checkpoints: some 3 N^(1/3) states of N are kept


def reversible(
    step: Step,
    state: State,
    dt: ArrayLike,
    num_steps: int,
    save_every: int | None = None,
    derivative: Derivative = "reversible",
    tolerance: float | None = None,
) -> Trajectory:
    """As `integrate`, with a reverse-mode derivative that keeps the saved states and nothing else.

    The leaves of `step`, the initial state and dt get gradients, and so does what its functions close over. Products
    with a Hessian, forward over reverse, keep no more: `jax.jvp(jax.grad(loss), …)`. Forward mode alone is not offered
    here: use `integrate`.

    Args:
        step: a symmetric step; with `derivative="checkpoint"` any.
        state: the initial state of one body; vmap for many.
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states; None keeps the first and the last only.
        derivative: "reversible" rebuilds states by steps of −dt. "checkpoint" keeps some 3 N^(1/3) states and takes
            about three more runs forward.
        tolerance: how far a rebuilt state may be from the saved one, in q and in p over max|p|, before the gradient
            draws a warning; by default √eps. See `round_trip_error`.

    Returns:
        A `Trajectory`, the same as that of `integrate` but for the last bits.

    Raises:
        ValueError: a step that is not symmetric, or as `integrate`.

    Warns:
        RuntimeWarning: when the gradient is computed and reversal has lost more digits than `tolerance` allows.

    Source: Zhuang et al. 2021, ICLR (for a leapfrog); for symmetric methods and checkpoints: this package.
    """
    interval, num_saves = intervals(num_steps, save_every)
    step, state, h = _ready(step, state, dt, derivative)
    prepared = step.prepare(state, h)
    if derivative == "checkpoint":
        later = _checkpointed(prepared, state, h, [interval] * num_saves)
    else:
        later = _undoable(prepared, state, h, np.full(num_saves, interval, np.int32), tolerance)
    return from_start(state, later, h * interval)


def observe(
    step: Step,
    state: State,
    dt: ArrayLike,
    times: ArrayLike,
    derivative: Derivative = "reversible",
    tolerance: float | None = None,
) -> tuple[State, StepInfo]:
    """The states at observation times, whatever they are: the nearest whole number of steps, then one shorter step.

    The steps of size dt are one trajectory, the shorter ones (at most dt/2, forwards or back) leave it and do not
    return. Derivatives as of `reversible`, with respect to the times too.

    Args:
        step: a symmetric step, as a scheme makes it; with `derivative="checkpoint"` any.
        state: the state at time 0.
        dt: step size, of the sign of the times.
        times: shape (m,), in any order.
        derivative: as of `reversible`; for "checkpoint" times and dt must be concrete.
        tolerance: as of `reversible`.

    Returns:
        The states, with a leading axis (m,), and of each the report of all steps since the observation before it. What
        is traced cannot raise: times on the other side of 0, and all with dt = 0, have `converged=False`.

    Raises:
        ValueError: times on the other side of 0 than dt leads to, or not finite; dt = 0; the rest as `reversible`.
    """
    step, state, h = _ready(step, state, dt, derivative)
    t = checks.real_array("times", times).astype(h.dtype)
    if t.ndim != 1:
        raise ValueError(f"times must have shape (m,), got {t.shape}; use jax.vmap for batches")
    known = concrete(times, dt)  # then nothing is traced, inside jit or not
    xp: Any = np if known else jnp
    if known and not np.all(np.asarray(times, float) * float(np.asarray(dt)) >= 0):
        raise ValueError(f"times must lie on the side of 0 that dt = {dt} leads to, got {np.asarray(times)}")
    if known and not float(np.asarray(dt)):
        raise ValueError("dt must not be 0: no number of steps leads to other times")
    ratio = np.asarray(times, float) / np.asarray(dt, float) if known else lax.stop_gradient(t / h)
    reached = xp.isfinite(ratio) & (ratio >= -1e-9)  # traced times on the wrong side of 0 are not
    whole = xp.round(xp.where(reached, ratio, 0)).astype(np.int32)
    order = xp.argsort(whole)
    counts = xp.diff(whole[order], prepend=0)
    prepared = step.prepare(state, h)
    if derivative == "checkpoint":
        if not known:
            raise ValueError('derivative="checkpoint" needs concrete times and dt: the number of steps is compiled in')
        later, info = _checkpointed(prepared, state, h, counts.tolist())
    else:
        later, info = _undoable(prepared, state, h, counts, tolerance)
    back = xp.argsort(order)
    later, info = jax.tree.map(lambda leaf: leaf[back], (later, info))
    seen, last = jax.vmap(step)(later, t - h * whole)  # `step` as it was given: prepared for no step size
    info = info.worse(last)
    return seen, info._replace(converged=info.converged & reached)


def round_trip_error(step: Step, state: State, dt: ArrayLike, num_steps: int) -> Array:
    """How far `num_steps` steps of −dt end from where `num_steps` steps of dt began: what `reversible` loses.

    In q, and in p over max|p|. It is some round-offs per step where motions stay together, and grows like their
    distance where they do not: over a time t on a chaotic motion of Lyapunov exponent λ, like e^(λt). The gradient's
    relative error is of that size times what the motion bends over such a distance.
    """
    step, state, h = _ready(step, state, dt, "reversible")
    prepared = step.prepare(state, h)
    num_steps = checks.count("num_steps", num_steps, 0)
    end = steps(prepared, state, h, num_steps)[0]
    return distance(steps(prepared, end, -h, num_steps)[0], state)


def _ready(step: Step, state: State, dt: ArrayLike, derivative: str) -> tuple[Step, State, Array]:
    """The arguments checked, and dt as an array of the state's dtype."""
    if derivative not in get_args(Derivative):
        raise ValueError(f"derivative must be one of {', '.join(get_args(Derivative))}, got {derivative!r}")
    if not isinstance(step, Step):
        raise ValueError(f"step must be a Step, such as schemes.so3_midpoint(...) makes, got {type(step).__name__}")
    if derivative == "reversible" and not step.symmetric:
        raise ValueError(
            f'{step.name} is not symmetric, so its steps cannot be undone by −dt: give derivative="checkpoint", or '
            "take a symmetric scheme"
        )
    state, dtype = promoted(step, state)
    step.check(state, dt)
    return step, state, jnp.asarray(checks.step_size(dt), dtype)


@pytree
class _Opened:
    """A step whose functions close over nothing: what they closed over is `closed`."""

    step: Step
    closed: tuple[Array, ...]
    function: Callable[..., tuple[State, StepInfo]] = static()

    def __call__(self, state: State, dt: Array) -> tuple[State, StepInfo]:
        return self.function(self.step, state, dt, *self.closed)


def _opened(step: Step, state: State, dt: Array) -> Any:
    if isinstance(step, Composition):
        return dataclasses.replace(step, step=_opened(step.step, state, dt))
    function, closed = jax.closure_convert(lambda step, z, dt: step(z, dt), step, state, dt)
    return _Opened(step, tuple(closed), function)


def _undoable(step: Step, state: State, dt: Array, counts: Any, tolerance: float | None) -> tuple[State, StepInfo]:
    """`_marched`, differentiated by undoing its steps; in what the functions of the step close over, too."""
    tolerance = math.sqrt(jnp.finfo(state.p.dtype).eps) if tolerance is None else float(tolerance)
    return _march(_opened(step, state, dt), state, dt, counts, tolerance)


def _marched(step: Any, state: State, dt: Array, counts: Any, tolerance: float) -> tuple[State, StepInfo]:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports in between."""

    def interval(state: State, count: Array) -> tuple[State, tuple[State, StepInfo]]:
        state, info = steps(step, state, dt, count)
        return state, (state, info)

    return lax.scan(interval, state, jnp.asarray(counts))[1]


_march: Any = jax.custom_vjp(_marched, nondiff_argnums=(4,))


def _march_forward(step: Any, state: State, dt: Array, counts: Any, tolerance: float) -> Any:
    later, info = _marched(step, state, dt, counts, tolerance)
    return (later, info), (step, state, dt, counts, later)


def _march_back(tolerance: float, kept: Any, cotangents: tuple[State, Any]) -> tuple[Any, ...]:
    step, state, dt, counts, later = kept
    smooth = _smooth(step)

    def go(leaves: Any, z: State, dt: Array) -> State:
        return _stage(_filled(step, leaves))(z, dt)[0]

    def undo(carry: Any, gamma: Any) -> Any:
        z, lam, (leaves, h) = carry
        z = go(smooth, z, -gamma * dt)
        more, lam, slope = jax.vjp(go, smooth, z, gamma * dt)[1](lam)
        return z, lam, (jax.tree.map(jnp.add, leaves, more), h + gamma * slope)

    def interval(carry: Any, saved: tuple[State, State, State, Array]) -> tuple[Any, Array]:
        lam, sums = carry
        start, end, seen, count = saved
        rebuilt, lam, sums = repeat(count, undo, (end, jax.tree.map(jnp.add, lam, seen), sums), _gammas(step)[::-1])
        return (lam, sums), distance(rebuilt, start)

    starts = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest])[:-1], state, later)
    zero = jax.tree.map(jnp.zeros_like, (state, (smooth, dt)))
    found, errors = lax.scan(interval, zero, (starts, later, cotangents[0], jnp.asarray(counts)), reverse=True)
    none = _watched(jnp.max(errors, initial=0), tolerance)  # part of each result, for whichever is used
    lam, (leaves, h) = jax.tree.map(lambda x: x + none.astype(x.dtype), found)
    return _cotangent(step, leaves), lam, h, np.zeros(np.shape(counts), jax.dtypes.float0)


_march.defvjp(_march_forward, _march_back)


def _stage(step: Any) -> Any:
    """The step that a composition repeats; any other itself."""
    return step.step if isinstance(step, Composition) else step


def _gammas(step: Any) -> tuple[float, ...]:
    """The sub-steps of a step of 1."""
    return step.gammas if isinstance(step, Composition) else (1.0,)


def _smooth(tree: Any) -> Any:
    """The leaves of a tree that are real numbers, None in place of the others."""
    return jax.tree.map(lambda x: jnp.asarray(x) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else None, tree)


def _filled(tree: Any, smooth: Any) -> Any:
    """A tree with other real leaves."""
    return jax.tree.map(lambda x, new: x if new is None else new, tree, smooth)


def _cotangent(tree: Any, smooth: Any) -> Any:
    """Cotangents of a tree from those of its real leaves; whole numbers and truth values have none."""
    return jax.tree.map(lambda x, c: np.zeros(np.shape(x), jax.dtypes.float0) if c is None else c, tree, smooth)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _watched(error: Array, tolerance: float) -> Array:
    """Zero, and a warning on the host if `error` is above `tolerance`: one call, however many bodies."""

    def warn(error: np.ndarray) -> np.ndarray:
        error = np.asarray(error)
        bad = ~(error <= tolerance)
        if bad.any():
            warnings.warn(
                f"reversal lost digits: a rebuilt state is {np.max(error):.2g} from the saved one (tolerance "
                f"{tolerance:.2g}; {bad.sum()} of {bad.size}): the gradient is good to some such part only. Save more "
                'often (save_every), take a shorter run, or derivative="checkpoint"',
                RuntimeWarning,
                stacklevel=2,
            )
        return np.zeros_like(error)

    return jax.pure_callback(warn, jax.ShapeDtypeStruct((), error.dtype), error, vmap_method="expand_dims")


@_watched.defjvp
def _(tolerance: float, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    none = _watched(primals[0], tolerance)
    return none, jnp.zeros_like(none)


def _checkpointed(step: Step, state: State, dt: Array, counts: list[int]) -> tuple[State, StepInfo]:
    """As `_march`, by scans whose derivative keeps the states at nested checkpoints only.

    One loop is compiled, as long as the longest interval and a little more; what is too much is taken and thrown away.
    """

    def interval(state: State, count: Array) -> tuple[State, tuple[State, StepInfo]]:
        def one(carry: tuple[Array, State, StepInfo], _: None) -> tuple[tuple[Array, State, StepInfo], None]:
            k, state, so_far = carry
            after, info = step(state, dt)
            taken = jax.tree.map(
                lambda new, old: jnp.where(k < count, new, old), (after, so_far.worse(info)), carry[1:]
            )
            return (k + 1, *taken), None

        start = (jnp.zeros((), jnp.int32), state, StepInfo.fresh(state.p))
        _, state, info = _nested(one, start, max(counts, default=0), _LEVELS)
        return state, (state, info)

    return lax.scan(jax.checkpoint(interval), state, jnp.asarray(counts, jnp.int32))[1]


def _nested(one: Callable[..., Any], carry: Any, length: int, levels: int) -> Any:
    """At least `length` times `one`, in about length^(1/levels) blocks of blocks …, each a checkpoint."""
    if levels == 1:
        return lax.scan(jax.checkpoint(one), carry, None, length=length)[0]
    blocks = math.ceil(length ** (1 / levels))
    block = math.ceil(length / blocks) if blocks else 0

    def inner(carry: Any, _: None) -> tuple[Any, None]:
        return _nested(one, carry, block, levels - 1), None

    return lax.scan(jax.checkpoint(inner), carry, None, length=blocks)[0]
