"""States at observation times, with derivatives of the whole run that leads there."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._xla import compiled
from lieint_jax.runs._adjoints.reversible import Derivative, checked
from lieint_jax.runs._adjoints.undo import undoable
from lieint_jax.runs._march.clock import (
    MOST_COUNTED,
    UniformClock,
    refuse_far_times,
    refuse_times,
    splits,
    uniform_clock,
)
from lieint_jax.runs._march.driver import Reached
from lieint_jax.runs._march.integrate import at_output_times
from lieint_jax.types import State, Step


def observe(
    step: Step,
    state: State,
    dt: ArrayLike,
    times: npt.ArrayLike,
    *,
    derivative: Derivative = "reversible",
    tolerance: float | None = None,
) -> Reached:
    """The states of `integrate(…, save_at=times)` at any observation times, with the derivatives of `reversible`.

    The steps of size dt form one trajectory. Each observation adds one shorter step from the last state before it, from
    which the trajectory does not continue. Derivatives with respect to the times exist as well.

    Args:
        step: a symmetric step; with `derivative="checkpoint"`, any step.
        state: the initial state.
        dt: step size, with the sign that leads to the times.
        times: shape (m,), in any order, on the clock of `state.t`; since the start if the state has no time.
        derivative: as in `reversible`; for "checkpoint", times, dt and the time of the state must be concrete.
        tolerance: as in `reversible`.

    Returns:
        The states, with a leading axis (m,), and for each the report of all steps since the previous observation.
        Traced times cannot raise an error: those on the wrong side of the start or 2³¹ − 1 steps from it, and all of
        them if dt = 0, have `converged=False`.

    Raises:
        ValueError: times are not finite, on the side of the start to which dt does not lead, or 2³¹ − 1 steps from it;
            dt = 0; and the errors of `reversible`.
    """
    step, state, h = checked(step, state, dt, derivative)
    tolerance = None if tolerance is None else _checks.tolerance("tolerance", tolerance)
    if (parts := splits(step)) > 1:
        h, dt = h / parts, dt / parts
    refuse_times(step, "times")
    t = _checks.real_array("times", times).astype(h.dtype)
    if t.ndim != 1:
        raise ValueError(f"times must have shape (m,), got {t.shape}; use jax.vmap for batches")
    t0: Any = np.zeros((), h.dtype) if state.t is None else state.t
    known = concrete(times, dt, t0)  # then no tracer is involved, inside jit or not
    xp: Any = np if known else jnp
    since = np.asarray(times, float) - np.asarray(t0, float) if known else t - t0
    if known and not np.all(since * float(np.asarray(dt)) >= 0):
        raise ValueError(
            f"times must lie on the side of the start, t = {t0}, that dt = {dt} leads to, got {np.asarray(times)}"
        )
    if known and not float(np.asarray(dt)):
        raise ValueError("dt must not be 0: no number of steps leads to other times")
    ratio = since / np.asarray(dt, float) if known else lax.stop_gradient(since / h)
    if known:
        refuse_far_times("times", np.max(ratio, initial=0), t0)
    # False for traced times on the wrong side of the start, or too far
    reached = xp.logical_and(ratio >= -1e-9, ratio < MOST_COUNTED)
    ratio, rounding = xp.where(reached, ratio, 0), 4 * float(jnp.finfo(h.dtype).eps)
    nearest = xp.round(ratio)
    at_node = xp.abs(ratio - nearest) <= rounding * (1 + xp.abs(ratio))
    whole = xp.where(at_node, nearest, xp.floor(ratio)).astype(np.int32)
    if derivative == "checkpoint":
        if not known:
            raise ValueError(
                'derivative="checkpoint" needs concrete times, dt and state.t, which determine the number of compiled '
                'steps: pass constants, or derivative="reversible"'
            )
        return _by_checkpoints(step, state, uniform_clock(step, state, h), t, int(np.max(whole, initial=0)) + 1)
    order = xp.argsort(whole)
    later = undoable(step, state, h, xp.diff(whole[order], prepend=0), tolerance)
    return _states_at(step, later, xp.argsort(order), _remaining_step(t - t0, h, jnp.asarray(whole, h.dtype)), reached)


@partial(compiled, static_argnums=4)
def _by_checkpoints(step: Step, state: State, clock: UniformClock, times: Array, num_steps: int) -> Reached:
    """The states and reports at times of any order, which so many steps pass."""
    order = jnp.argsort(times * jnp.sign(clock.dt))
    later = at_output_times(step, state, clock, times[order], num_steps)
    states, info = jax.tree.map(lambda x: x[jnp.argsort(order)], later)
    return (states if state.t is None else states._replace(t=times)), info


@jax.custom_jvp
def _remaining_step(t: Array, h: Array, whole: Array) -> Array:
    """t − h·whole, set to 0 where it is a rounding error.

    XLA computes it several times, with and without a fused multiply-add, which would give steps of both 0 and 1e-17.
    """
    rest = t - h * whole
    return jnp.where(jnp.abs(rest) <= 4 * jnp.finfo(t.dtype).eps * jnp.abs(t), 0, rest)


@_remaining_step.defjvp
def _(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Any]) -> tuple[Array, Array]:
    t, h, whole = primals
    return _remaining_step(t, h, whole), tangents[0] - whole * tangents[1]


@compiled
def _states_at(step: Step, later: Reached, back: Array, rest: Array, reached: Array) -> Reached:
    """The states one step of `rest` after those of `later`, in the order `back`, by the unprepared step."""
    found, info = jax.tree.map(lambda leaf: leaf[back], later)
    seen, last = jax.vmap(step)(found, rest)
    info = info.merge(last)
    return seen, info._replace(converged=info.converged & reached)
