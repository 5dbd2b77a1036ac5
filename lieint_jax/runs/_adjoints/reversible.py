"""Derivatives of whole runs in reverse mode as options of `integrate`, and `reversible`, which is shorter."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._xla import compiled
from lieint_jax.runs._adjoints.undo import undoable
from lieint_jax.runs._march.clock import Clock, GridClock, intervals
from lieint_jax.runs._march.driver import Reached, prepared, saved_states, steps
from lieint_jax.runs._march.integrate import Adjoint, integrate
from lieint_jax.types import State, Step, Trajectory, checked_step, promoted, start_time
from lieint_jax.types.tangent import distance, swinging

Derivative = Literal["reversible", "checkpoint"]


def check_derivative(derivative: str) -> None:
    """Raise ValueError for an unknown derivative."""
    if derivative not in get_args(Derivative):
        raise ValueError(f"derivative must be one of {', '.join(get_args(Derivative))}, got {derivative!r}")


def check_symmetric(step: Step) -> None:
    """Raise ValueError if steps cannot be undone."""
    if not step.symmetric:
        raise ValueError(
            f'{step.name} is not symmetric, so its steps cannot be undone by −dt: give derivative="checkpoint" '
            "(adjoint=li.adjoints.RecursiveCheckpointAdjoint() to li.integrate), or use a symmetric scheme"
        )


def checked(step: Step, state: State, dt: ArrayLike, derivative: str) -> tuple[Step, State, Array]:
    """Check the arguments; return step, state and dt in their common dtype."""
    check_derivative(derivative)
    checked_step(step)
    if derivative == "reversible":
        check_symmetric(step)
    step, state, dtype = promoted(step, state)
    step.check(state, dt)
    _checks.time_resolution(start_time(step, state), dt, 0)
    return step, state, jnp.asarray(_checks.step_size(dt), dtype)


@dataclasses.dataclass(frozen=True)
class ReversibleAdjoint(Adjoint):
    """Gradients of long runs that store the saved states only: `integrate(…, adjoint=ReversibleAdjoint())`.

    The backward pass rebuilds states by steps of −dt from one saved state to the one before, so save_every should be
    large. The derivative is that of the discrete flow, in 3.5 to 5 times the time of a run, for any number of
    parameters. It requires a symmetric step and steps of one size.

    Attributes:
        tolerance: the distance of a rebuilt state from the saved one, in q and in p over max|p|, above which a warning
            is issued; by default √eps. See `round_trip_error`.

    Source: Zhuang et al. 2021, ICLR (for a leapfrog); for symmetric methods: this package.
    """

    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            object.__setattr__(self, "tolerance", _checks.tolerance("tolerance", self.tolerance))

    def check(self, step: Step, clock: Clock) -> None:
        """Raise ValueError if the step is not symmetric, or if the steps have different sizes."""
        check_symmetric(step)
        if isinstance(clock, GridClock):
            raise ValueError(
                "ReversibleAdjoint is for steps of one size: give dt and num_steps in place of times, or "
                "adjoint=li.adjoints.RecursiveCheckpointAdjoint()"
            )

    def run(self, step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> Reached:
        """See `Adjoint`."""
        assert not isinstance(clock, GridClock)
        return undoable(step, state, clock.dt, np.full(num_saves, save_every, np.int32), self.tolerance)


@partial(compiled, static_argnums=(3, 4))
def _saved_states(step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> Reached:
    return saved_states(prepared(step, state, clock), state, clock, num_saves, save_every)


@dataclasses.dataclass(frozen=True)
class RecursiveCheckpointAdjoint(Adjoint):
    """What `integrate` does without an adjoint: the backward pass computes the steps between about 2√N states again.

    Source: blocks of equal length; Griewank & Walther 2000 (revolve) has more levels, for less memory.
    """

    def check(self, step: Step, clock: Clock) -> None:
        """Every step has this derivative."""

    def run(self, step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> Reached:
        """See `Adjoint`."""
        return _saved_states(step, state, clock, num_saves, save_every)


def reversible(
    step: Step,
    state: State,
    dt: ArrayLike,
    num_steps: int,
    save_every: int | None = None,
    *,
    derivative: Derivative = "reversible",
    tolerance: float | None = None,
) -> Trajectory:
    """A run as by `integrate`, whose gradients need no more memory than the saved states.

    It is `integrate(…, adjoint=ReversibleAdjoint(tolerance))`, or `adjoint=RecursiveCheckpointAdjoint()`, with another
    default for save_every.

    Gradients flow to the leaves of `step`, the initial state, dt, and the arrays that the step's functions close over.
    Hessian-vector products, forward over reverse, need no more memory: `jax.jvp(jax.grad(loss), …)`. For forward mode
    alone use `integrate`.

    Args:
        step: a symmetric step; with `derivative="checkpoint"`, any step.
        state: the initial state of one body; vmap for many.
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states; None saves the first and the last only.
        derivative: "reversible" rebuilds states by steps of −dt. "checkpoint" stores about 2√N of N states.
        tolerance: the distance of a rebuilt state from the saved one, in q and in p over max|p|, above which a warning
            is issued; by default √eps. See `round_trip_error`.

    Returns:
        A `Trajectory`, equal to that of `integrate` up to round-off.

    Raises:
        ValueError: the step is not symmetric; and the errors of `integrate`.

    Warns:
        RuntimeWarning: when the gradient is computed and reversal has lost more digits than `tolerance` allows.

    Source: Zhuang et al. 2021, ICLR (for a leapfrog); for symmetric methods and checkpoints: this package.
    """
    check_derivative(derivative)
    interval, _ = intervals(num_steps, save_every)
    adjoint = RecursiveCheckpointAdjoint() if derivative == "checkpoint" else ReversibleAdjoint(tolerance)
    return integrate(step, state, dt, num_steps, save_every=interval, adjoint=adjoint)


def round_trip_error(step: Step, state: State, dt: ArrayLike, num_steps: int) -> Array:
    """The distance between the initial state and its image after `num_steps` steps of dt and as many of −dt.

    It is the error of the states that `reversible` rebuilds, in q, and in p over max|p|. On a regular motion it is a
    few round-offs per step; on others it grows like the distance of neighboring trajectories, over a time t on a
    chaotic motion of Lyapunov exponent λ like e^(λt). The gradient's relative error is about this error times the
    second derivative of the flow.
    """
    step, state, h = checked(step, state, dt, "reversible")
    return _there_and_back(step, state, h, _checks.count("num_steps", num_steps, 0))


@compiled
def _there_and_back(step: Step, state: State, h: Array, num_steps: ArrayLike) -> Array:
    prepared = step.prepare(state, h)
    end, _ = steps(prepared, state, h, num_steps)
    back, _ = steps(prepared, end, -h, num_steps)
    return distance(back, state, step.system.phase_space, scale=swinging(step.system, state))
