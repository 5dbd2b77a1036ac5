"""How the derivative of a run in reverse mode is computed: an option of `integrate`, implemented in `adjoints`."""

from __future__ import annotations

import abc

from lieint_jax.runs._clock import Clock
from lieint_jax.types import State, Step, StepInfo


class Adjoint(abc.ABC):
    """A derivative of whole runs in reverse mode, for `integrate(…, adjoint=…)`."""

    @abc.abstractmethod
    def check(self, step: Step, clock: Clock) -> None:
        """Raise ValueError if this derivative does not exist for runs of the step at the times of the clock."""

    @abc.abstractmethod
    def run(self, step: Step, state: State, clock: Clock, num_saves: int, save_every: int) -> tuple[State, StepInfo]:
        """The states saved every `save_every` steps after the initial one, and the reports of the steps between."""


def checked_adjoint(adjoint: object) -> Adjoint:
    """`adjoint`; raises ValueError if it is not an adjoint."""
    if isinstance(adjoint, Adjoint):
        return adjoint
    raise ValueError(
        "adjoint must be None, for the derivative of the loop itself, li.adjoints.ReversibleAdjoint() or "
        f"li.adjoints.RecursiveCheckpointAdjoint(), got {adjoint!r}"
    )
