"""Trajectories with a derivative in reverse mode, and how much undoing their steps loses."""

from __future__ import annotations

import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.adjoints._arguments import Derivative, checked
from lieint_jax.adjoints._checkpoint import checkpointed
from lieint_jax.adjoints._undo import undoable
from lieint_jax.diagnostics.order import distance
from lieint_jax.integrate import from_start, intervals, steps
from lieint_jax.types import State, Step, Trajectory


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
    step, state, h = checked(step, state, dt, derivative)
    prepared = step.prepare(state, h)
    if derivative == "checkpoint":
        later = checkpointed(prepared, state, h, [interval] * num_saves)
    else:
        later = undoable(prepared, state, h, np.full(num_saves, interval, np.int32), tolerance)
    return from_start(state, later, h * interval)


def round_trip_error(step: Step, state: State, dt: ArrayLike, num_steps: int) -> Array:
    """How far `num_steps` steps of −dt end from where `num_steps` steps of dt began: what `reversible` loses.

    In q, and in p over max|p|. It is some round-offs per step where motions stay together, and grows like their
    distance where they do not: over a time t on a chaotic motion of Lyapunov exponent λ, like e^(λt). The gradient's
    relative error is of that size times what the motion bends over such a distance.
    """
    step, state, h = checked(step, state, dt, "reversible")
    prepared = step.prepare(state, h)
    num_steps = _checks.count("num_steps", num_steps, 0)
    end = steps(prepared, state, h, num_steps)[0]
    return distance(steps(prepared, end, -h, num_steps)[0], state)
