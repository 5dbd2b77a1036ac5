"""Runs whose reverse-mode derivative stores no intermediate states: a symmetric step is undone instead.

Backwards from the end, step(·, −Δt) rebuilds the state from which step(·, Δt) started, and the cotangents of one step
are pulled back there:

    z_n = Ψ₋(z_{n+1}),    (λ_n, θ̄, Δ̄) = (∂Ψ(z_n)/∂(z, θ, Δt))ᵀ λ_{n+1}

A composition is undone sub-step by sub-step. Only the saved states are stored, which the caller holds anyway. At each
of them the rebuilt state is compared with the saved one and replaced by it, so rounding errors do not add up from one
interval to the next.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._integrate import Progress, counted, march, step_at_node, uniform_clock
from lieint_jax._xla import compiled
from lieint_jax.adjoints._numbers import repeat
from lieint_jax.diagnostics.tangent import distance
from lieint_jax.schemes import Composition
from lieint_jax.types import State, Step, StepInfo, System, pytree, static
from lieint_jax.types.shapes import PyTree


@partial(compiled, static_argnums=4)
def undoable(step: Step, state: State, dt: Array, counts: ArrayLike, tolerance: float | None) -> tuple[State, StepInfo]:
    """`_states_and_reports`, differentiated by undoing steps, also with respect to arrays that the step closes over."""
    tolerance = math.sqrt(jnp.finfo(state.p.dtype).eps) if tolerance is None else float(tolerance)
    return _march(_substeps(step.prepare(state, dt), state, dt), state, dt, jnp.asarray(counts), tolerance)


def _states_and_reports(step: Step, state: State, dt: Array, counts: Array, tolerance: float) -> tuple[State, StepInfo]:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports of the steps between them."""
    advance_once = partial(step_at_node, step, uniform_clock(step, state, dt))

    def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, done = carry
        end = march(advance_once, done, count, Progress.begin(state), repeat=counted)
        return (end.state, done + count), (end.state, end.info)

    return lax.scan(interval, (state, jnp.zeros((), counts.dtype)), counts)[1]


_march: Callable[..., PyTree] = jax.custom_vjp(_states_and_reports, nondiff_argnums=(4,))


def _march_forward(step: Step, state: State, dt: Array, counts: Array, tolerance: float) -> PyTree:
    later, info = _states_and_reports(step, state, dt, counts, tolerance)
    return (later, info), (step, state, dt, counts, later)


def _march_back(tolerance: float, residuals: PyTree, cotangents: tuple[State, PyTree]) -> tuple[PyTree, ...]:
    step, state, dt, counts, later = residuals
    leaves, lam, h = _undone(step, state, dt, counts, later, cotangents[0], tolerance)
    return _cotangent(step, leaves), lam, h, np.zeros(np.shape(counts), jax.dtypes.float0)


@partial(compiled, static_argnums=6)
def _undone(
    step: Step, state: State, dt: Array, counts: Array, later: State, cotangent: State, tolerance: float
) -> tuple[PyTree, State, Array]:
    """The cotangents of the step's smooth leaves, of the state at the start and of dt, by undoing the steps."""
    smooth = _smooth(step)

    def stage_of_leaves(leaves: PyTree, z: State, dt: Array) -> State:
        return _stage(_with_real_leaves(step, leaves))(z, dt)[0]

    def undo(carry: PyTree, gamma: PyTree) -> PyTree:
        z, lam, (leaves, h) = carry
        z = stage_of_leaves(smooth, z, -gamma * dt)
        more, lam, slope = jax.vjp(stage_of_leaves, smooth, z, gamma * dt)[1](lam)
        return z, lam, (jax.tree.map(jnp.add, leaves, more), h + gamma * slope)

    def interval(carry: PyTree, saved: tuple[State, State, State, Array]) -> tuple[PyTree, Array]:
        lam, sums = carry
        start, end, seen, count = saved
        rebuilt, lam, sums = repeat(count, undo, (end, jax.tree.map(jnp.add, lam, seen), sums), _gammas(step)[::-1])
        return (lam, sums), distance(rebuilt, start, step.system.phase_space)

    starts = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest])[:-1], state, later)
    zero = jax.tree.map(jnp.zeros_like, (state, (smooth, dt)))
    found, errors = lax.scan(interval, zero, (starts, later, cotangent, jnp.asarray(counts)), reverse=True)
    none = _zero_with_warning(
        jnp.max(errors, initial=0), tolerance
    )  # added to every result, or XLA may remove the warning
    lam, (leaves, h) = jax.tree.map(lambda x: x + none.astype(x.dtype), found)
    return leaves, lam, h


_march.defvjp(_march_forward, _march_back)


def _stage(step: Step) -> PyTree:
    """The sub-step of a composition; any other step itself."""
    return step.step if isinstance(step, Composition) else step


def _gammas(step: Step) -> tuple[float, ...]:
    """The sizes of the sub-steps, over dt."""
    return step.gammas if isinstance(step, Composition) else (1.0,)


def _smooth(tree: PyTree) -> PyTree:
    """The leaves of a tree that are real numbers, None in place of the others."""
    return jax.tree.map(lambda x: jnp.asarray(x) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else None, tree)


def _with_real_leaves(tree: PyTree, smooth: PyTree) -> PyTree:
    """`tree` with its real leaves replaced by those of `smooth`."""
    return jax.tree.map(lambda x, new: x if new is None else new, tree, smooth)


def _cotangent(tree: PyTree, smooth: PyTree) -> PyTree:
    """The cotangents of `tree` from those of its real leaves; integers and booleans have none."""
    return jax.tree.map(lambda x, c: np.zeros(np.shape(x), jax.dtypes.float0) if c is None else c, tree, smooth)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _zero_with_warning(error: Array, tolerance: float) -> Array:
    """Zero, with a warning on the host if `error` is above `tolerance`; a batch makes one call."""

    def warn(error: np.ndarray) -> np.ndarray:
        error = np.asarray(error)
        bad = ~(error <= tolerance)
        if bad.any():
            warnings.warn(
                f"reversal lost digits: a rebuilt state is {np.max(error):.2g} from the saved one (tolerance "
                f"{tolerance:.2g}; {bad.sum()} of {bad.size}): the gradient has a relative error of about that size. "
                'Save more often (save_every), use a shorter run, or derivative="checkpoint"',
                RuntimeWarning,
                stacklevel=2,
            )
        return np.zeros_like(error)

    return jax.pure_callback(warn, jax.ShapeDtypeStruct((), error.dtype), error, vmap_method="expand_dims")


@_zero_with_warning.defjvp
def _(tolerance: float, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    none = _zero_with_warning(primals[0], tolerance)
    return none, jnp.zeros_like(none)


@pytree
class _Opened:
    """A step as a pure function: the arrays that its functions closed over are the leaves `closed`."""

    step: Step
    closed: tuple[Array, ...]
    function: Callable[..., tuple[State, StepInfo]] = static()

    @property
    def system(self) -> System:
        return self.step.system

    @property
    def own_time(self) -> bool:
        return self.step.own_time

    @property
    def prepares(self) -> bool:
        return self.step.prepares

    def __call__(self, state: State, dt: Array) -> tuple[State, StepInfo]:
        return self.function(self.step, state, dt, *self.closed)

    substep = __call__


def _substeps(step: Step, state: State, dt: Array) -> PyTree:
    if isinstance(step, Composition):
        return dataclasses.replace(step, step=_substeps(step.step, state, dt))
    function, closed = jax.closure_convert(lambda step, z, dt: step(z, dt), step, state, dt)
    return _Opened(step, tuple(closed), function)
