"""Derivatives of whole runs in reverse mode as options of `integrate`."""

from __future__ import annotations

import dataclasses

import numpy as np

from lieint_jax import _checks
from lieint_jax._deprecated import warn_of_removal
from lieint_jax.adjoints._arguments import check_symmetric
from lieint_jax.adjoints._checkpoint import checkpointed
from lieint_jax.adjoints._undo import undoable
from lieint_jax.runs import Adjoint, Clock, GridClock
from lieint_jax.types import State, Step, StepInfo


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

    def check(self, step: Step, clock: Clock) -> None:
        """Raise ValueError if the step is not symmetric, or if the steps have different sizes."""
        check_symmetric(step)
        if isinstance(clock, GridClock):
            raise ValueError(
                "ReversibleAdjoint is for steps of one size: give dt and num_steps in place of times, or "
                "adjoint=li.adjoints.RecursiveCheckpointAdjoint()"
            )

    def run(self, step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> tuple[State, StepInfo]:
        """See `Adjoint`."""
        assert not isinstance(clock, GridClock)
        return undoable(step, state, clock.dt, np.full(num_saves, save_every, np.int32), self.tolerance)


@dataclasses.dataclass(frozen=True)
class RecursiveCheckpointAdjoint(Adjoint):
    """What `integrate` does without an adjoint: the backward pass computes the steps between about 2√N states again.

    Attributes:
        levels: of no effect; until 0.5.

    Source: blocks of equal length; Griewank & Walther 2000 (revolve) has more levels, for less memory.
    """

    levels: int | None = None

    def __post_init__(self) -> None:
        if self.levels is not None:
            _checks.count("levels", self.levels, 1)
            warn_of_removal("RecursiveCheckpointAdjoint: levels, which has no effect now,")

    def check(self, step: Step, clock: Clock) -> None:
        """Every step has this derivative."""

    def run(self, step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> tuple[State, StepInfo]:
        """See `Adjoint`."""
        return checkpointed(step, state, clock, (save_every,) * num_saves)
