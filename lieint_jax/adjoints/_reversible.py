"""Trajectories with a derivative in reverse mode, and the error of undoing their steps."""

from __future__ import annotations

from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._xla import compiled
from lieint_jax.adjoints._arguments import Derivative, check_derivative, checked
from lieint_jax.adjoints._options import RecursiveCheckpointAdjoint, ReversibleAdjoint
from lieint_jax.diagnostics.tangent import distance
from lieint_jax.runs import integrate, intervals, steps
from lieint_jax.types import State, Step, Trajectory


def reversible(
    step: Step,
    state: State,
    dt: ArrayLike,
    num_steps: int,
    *,
    save_every: int | None = None,
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
    return distance(steps(prepared, end, -h, num_steps)[0], state, step.system.phase_space)
