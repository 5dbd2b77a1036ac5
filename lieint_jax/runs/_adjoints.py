"""How a run is differentiated in reverse mode. Without intermediate states, a symmetric step is undone instead.

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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks, native
from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import compiled, rereading_jit, with_common_axes
from lieint_jax.core import State, Step
from lieint_jax.core.tangent import distance
from lieint_jax.runs._clock import Clock, GridClock, UniformClock, is_inside, uniform_clock
from lieint_jax.runs._driver import Reached, at_start, counted, reported
from lieint_jax.schemes import Composition


@dataclasses.dataclass(frozen=True)
class ReversibleAdjoint:
    """Gradients of long runs that store the saved states only: `integrate(…, adjoint=ReversibleAdjoint())`.

    The backward pass rebuilds states by steps of −dt from one saved state to the one before, so save few: give a large
    save_every, or save_at. The derivative is that of the discrete flow, in 3.5 to 5 times the time of a run, for any
    number of parameters. It requires a symmetric step and steps of one size.

    Gradients flow to the leaves of the step, the initial state, dt, the times of save_at, and the arrays that the
    step's functions close over. Hessian-vector products, forward over reverse, store no more: `jax.jvp` of
    `jax.grad(loss)`. There is no forward mode alone and no reverse over reverse: integrate without an adjoint.

    When the gradient is computed and reversal has lost more digits than the tolerance allows, a RuntimeWarning is
    issued.

    Attributes:
        tolerance: the distance of a rebuilt state from the saved one, in q and in p over max|p|, above which the
            warning is issued; by default √eps. `diagnostics.round_trip_error` measures it in advance.

    Source: Zhuang et al. 2021, ICLR (for a leapfrog); for symmetric methods: this package.
    """

    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            object.__setattr__(self, "tolerance", _checks.tolerance("tolerance", self.tolerance))


@dataclasses.dataclass(frozen=True)
class RecursiveCheckpointAdjoint:
    """Gradients of any run, of any step: the default of `integrate`, by the name that diffrax has for it.

    The backward pass computes the steps between about 2√N stored states of N again.

    Source: blocks of equal length; Griewank & Walther 2000 (revolve) has more levels, for less memory.
    """


Adjoint = ReversibleAdjoint | RecursiveCheckpointAdjoint


def check_undoable(step: Step, clock: Clock) -> None:
    """Raise ValueError if steps cannot be undone: they are not symmetric, or of different sizes."""
    if not step.symmetric:
        raise ValueError(
            f"{step.name} is not symmetric, so its steps cannot be undone by −dt: give "
            "adjoint=li.RecursiveCheckpointAdjoint(), or use a symmetric scheme"
        )
    if isinstance(clock, GridClock):
        raise ValueError(
            "ReversibleAdjoint is for steps of one size: give dt and num_steps in place of times, or "
            "adjoint=li.RecursiveCheckpointAdjoint()"
        )


@partial(compiled, static_argnums=5)
def undoable_at(
    step: Step, state: State, clock: Clock, save_at: Array, num_steps: ArrayLike, tolerance: float | None
) -> Reached:
    """The states at output times in any order, and the reports of the steps since the output before, in time.

    They are differentiated by undoing steps, and each output by the shorter step that leads there from a node.
    """
    assert isinstance(clock, UniformClock)  # by `check_undoable`
    assert clock.t0 is not None  # by `refuse_times`
    inside = is_inside(save_at, clock, num_steps)
    node = jnp.where(inside, clock.node(jnp.where(inside, save_at, clock.time(0)), num_steps), 0)
    order = jnp.argsort(node)
    later = undoable(step, state, clock.dt, jnp.diff(node[order], prepend=0), tolerance)
    nodes, info = jax.tree.map(lambda x: x[jnp.argsort(order)], later)
    rest = _remaining_step(save_at - clock.t0, clock.dt, node.astype(clock.dt.dtype))
    end, last = jax.vmap(step)(nodes, jnp.where(inside, rest, 0))
    info = info.merge(last)
    return end._replace(t=None), info._replace(converged=info.converged & inside)


@jax.custom_jvp
def _remaining_step(t: Array, h: Array, whole: Array) -> Array:
    """t − h·whole, set to 0 where it is a rounding error.

    XLA computes it several times, with and without a fused multiply-add, which would give steps of both 0 and 1e-17.
    """
    rest = t - h * whole
    return jnp.where(jnp.abs(rest) <= 4 * jnp.finfo(t.dtype).eps * jnp.abs(t), 0, rest)


@_remaining_step.defjvp
def _(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, PyTree]) -> tuple[Array, Array]:
    t, h, whole = primals
    return _remaining_step(t, h, whole), tangents[0] - whole * tangents[1]


@partial(compiled, static_argnums=4)
def undoable(step: Step, state: State, dt: Array, counts: ArrayLike, tolerance: float | None) -> Reached:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports of the steps between them.

    They are differentiated by undoing steps, also with respect to arrays that the step closes over.
    """
    tolerance = math.sqrt(jnp.finfo(state.p.dtype).eps) if tolerance is None else tolerance
    clock, ready, space = uniform_clock(step, state, dt), step.prepare(state, dt), step.system.phase_space
    whole = stage = native.hoisted(lambda z, h: ready(z, h), state, dt)
    gammas = (1.0,)
    if isinstance(ready, Composition):
        stage, gammas = native.hoisted(lambda z, h: ready.step(z, h), state, dt), ready.gammas

    def distance_in(a: State, b: State, largest: Array) -> Array:
        return distance(a, b, space, scale=b._replace(p=largest))

    apart = native.hoisted(distance_in, state, state, state.p)
    run, arrays = _Undoable(whole[0], stage[0], apart[0], gammas, tolerance), (whole[1], stage[1], apart[1])
    given = with_common_axes((arrays, state, dt, clock))
    later, info = _run(run, *given, counts)
    if later.t is not None and state.t is not None and not step.own_time:
        # times that members of a batch share have a derivative of their own: JAX 0.12 refuses it from a custom_vjp
        slope = (state.t - lax.stop_gradient(state.t)) + jnp.cumsum(counts) * (dt - lax.stop_gradient(dt))
        later = later._replace(t=lax.stop_gradient(later.t) + slope)
    return later, info


class _Undoable(NamedTuple):
    """A run whose steps can be undone. The functions have the arrays that they close over as first arguments.

    Attributes:
        step: (z, Δt) ↦ the state one step later, and its report.
        stage: the same for a sub-step of a composition; for any other step it is `step`.
        apart: the distance of two states, in units of given momenta.
        gammas: the sizes of the sub-steps, over Δt.
        tolerance: the distance of a rebuilt state from the saved one above which a warning is issued.
    """

    step: Callable[..., Reached]
    stage: Callable[..., Reached]
    apart: Callable[..., Array]
    gammas: tuple[float, ...]
    tolerance: float

    def states(self, arrays: PyTree, state: State, dt: Array, clock: Clock, counts: Array) -> Reached:
        """See `undoable`."""
        step_once = reported(partial(self.step, arrays[0]), clock)

        def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], Reached]:
            state, done = carry
            reached = counted(step_once, done, count, at_start(state))
            return (reached[0], done + count), reached

        counts = jnp.asarray(counts)
        return lax.scan(interval, (state, jnp.zeros((), counts.dtype)), counts)[1]

    def forward(self, *given: PyTree) -> tuple[Reached, PyTree]:
        """The states, and what `pull_back` needs."""
        later, info = self.states(*given)
        return (later, info), (*given, later)

    def pull_back(self, residuals: PyTree, cotangents: tuple[State, PyTree]) -> tuple[PyTree, ...]:
        """The cotangents of the arguments of `states`; that of dt, which its clock has too, is the one of dt."""
        arrays, state, dt, clock, counts, later = residuals
        lam, (sums, h) = _backward(self, arrays, state, dt, jnp.asarray(counts), later, cotangents[0])
        nothing = jax.tree.map(_no_cotangent, (arrays, clock, counts))
        sums = [_no_cotangent(x) if c is None else c for x, c in zip(arrays[1], sums, strict=True)]
        return (nothing[0][0], sums, nothing[0][2]), lam, h, *nothing[1:]  # those of a step are those of its stages

    def backward(
        self, arrays: PyTree, state: State, dt: Array, counts: Array, later: State, cotangents: State
    ) -> tuple[State, PyTree]:
        """The cotangents of the state, and of the real arrays of a stage and of dt."""
        real = jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, jnp.floating) else None, list(arrays[1]))
        consts = list(arrays[1]), real, dt

        def undo(n: Array, carry: PyTree, _: None, arrays: PyTree, real: PyTree, dt: Array) -> tuple[PyTree, None]:
            return self._undo(arrays, real, dt, n, carry), None

        def interval(carry: PyTree, saved: tuple[State, State, State, Array]) -> tuple[PyTree, Array]:
            lam, sums = carry
            start, end, seen, count = saved
            lam = jax.tree.map(jnp.add, lam, seen)
            substeps = count * len(self.gammas)
            largest = jnp.maximum(jnp.abs(start.p), jnp.abs(end.p))
            carry = end, lam, sums, largest
            rebuilt, lam, sums, largest = native.march(undo, carry, None, consts, rows=1, every=substeps)[0]
            return (lam, sums), self.apart(arrays[2], rebuilt, start, largest)

        starts = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest])[:-1], state, later)
        zero, starts = with_common_axes((jax.tree.map(jnp.zeros_like, (state, (real, dt))), starts))
        found, errors = lax.scan(interval, zero, (starts, later, cotangents, counts), reverse=True)
        # added to every result, or XLA may remove the warning
        none = _zero_with_warning(jnp.max(errors, initial=0), self.tolerance)
        return jax.tree.map(lambda x: x + none.astype(x.dtype), found)

    def _undo(self, arrays: PyTree, real: PyTree, dt: Array, n: Array, carry: PyTree) -> PyTree:
        """Undo sub-step n from the end, and pull its cotangents back.

        The largest momenta on the way are carried along: a slew from rest to rest has none at its ends.
        """
        z, lam, (sums, slope), largest = carry
        gammas = jnp.asarray(self.gammas[::-1], dt.dtype)
        gamma = gammas[n % gammas.size] if gammas.size > 1 else 1.0

        def stage(real: PyTree, z: State, h: Array) -> State:
            given = [x if r is None else r for x, r in zip(arrays, real, strict=True)]
            return self.stage(given, z, h)[0]

        z = stage(real, z, -gamma * dt)
        more, lam, more_slope = jax.vjp(stage, real, z, gamma * dt)[1](lam)
        largest = jnp.maximum(largest, jnp.abs(lax.stop_gradient(z.p)))
        return z, lam, (jax.tree.map(jnp.add, sums, more), slope + gamma * more_slope), largest


def _no_cotangent(x: Array) -> Array | np.ndarray:
    """The cotangent of a number on which nothing depends."""
    return jnp.zeros_like(x) if jnp.issubdtype(x.dtype, jnp.floating) else np.zeros(np.shape(x), jax.dtypes.float0)


_backward = rereading_jit(_Undoable.backward, static_argnums=0)  # a gradient outside of jit compiles it once
_run: Callable[..., PyTree] = jax.custom_vjp(_Undoable.states, nondiff_argnums=(0,))
_run.defvjp(_Undoable.forward, _Undoable.pull_back)


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
                "Save more often (save_every), use a shorter run, or adjoint=li.RecursiveCheckpointAdjoint()",
                RuntimeWarning,
                stacklevel=2,
            )
        return np.zeros_like(error)

    return jax.pure_callback(warn, jax.ShapeDtypeStruct((), error.dtype), error, vmap_method="expand_dims")


@_zero_with_warning.defjvp
def _(tolerance: float, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    none = _zero_with_warning(primals[0], tolerance)
    return none, jnp.zeros_like(none)
