"""What an ensemble is to do, and what it keeps of each save interval: shared by runs in memory and on disk."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from lieint_jax import members
from lieint_jax.loop import Carry, Range, Reduction
from lieint_jax.members import Layout
from lieint_jax.types import State, Step, StepInfo

_CHUNK_BYTES, _MEMORY = 2**22, 2**28  # of an array on disk; of what is kept together of all members
_CHUNK_WORK = 2e8  # body-steps that are kept together, if they are saved that often


class Summary(NamedTuple):
    """What `reduce` keeps. Time is the axis of all but the last two; entry 0 is the start.

    Attributes:
        t: times, shape (n+1,).
        least, greatest, mean: of the change of the reduced quantity since the start, over all members and over the
            steps since the entry before.
        residual: the largest, over the same.
        unconverged: of how many members a step did not converge, over the same.
        state: the states at the end, (members, …).
        failed: the first step that did not converge of each member, or −1.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    mean: np.ndarray
    residual: np.ndarray
    unconverged: np.ndarray
    state: State
    failed: np.ndarray


class Job(NamedTuple):
    """What is to be integrated. `dt_given` is dt as the caller has it, `dt` an array of the states' dtype."""

    step: Step
    states: State
    dt_given: float
    dt: Any
    save_every: int
    num_saves: int
    step_axis: int | None
    reduction: Reduction | None

    @property
    def num_steps(self) -> int:
        """Number of steps in all."""
        return self.save_every * self.num_saves

    @property
    def times(self) -> np.ndarray:
        """Times of all entries."""
        return self.dt_given * self.save_every * np.arange(self.num_saves + 1, dtype=self.dt.dtype)

    @property
    def members(self) -> int:
        """Number of members."""
        return self.states.p.shape[0]

    def rows(self, across: int) -> int:
        """How many saves are kept together, for chunks of `across` members."""
        row = max(sum(leaf[0].nbytes for leaf in self.states) + 9, 24)
        enough = min(_CHUNK_BYTES // (across * row), _MEMORY // (self.members * row))
        return int(max(1, min(enough, _CHUNK_WORK // (self.members * self.save_every), self.num_saves + 1)))


class Sink(Protocol):
    """Where a run puts what it saves: in memory (`ensemble`) or on disk (`archive`)."""

    @property
    def patient(self) -> bool:
        """Whether an interrupt waits until the run has `stopped` well."""
        ...

    @property
    def rows(self) -> int:
        """The most saves of one call of the compiled loop: its buffer."""
        ...

    @property
    def room(self) -> int:
        """The most saves that may come next."""
        ...

    def resumed(self) -> tuple[list[Carry], int] | None:
        """The carry and the steps taken of the run that is there, or None."""

    def begin(self, carry: list[Carry]) -> None:
        """Take the entry of the start; not called if the run was resumed."""

    def add(self, saved: Any, number: int) -> None:
        """Take `number` saved rows."""

    def offer(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        """After each call of the loop, what a run could go on from, and whether it is to stop: keep it, or not."""

    def stopped(self, done: int) -> bool:
        """Whether the run may stop here."""
        ...

    def farewell(self, done: int, num_steps: int) -> str:
        """What to tell whoever interrupted the run."""
        ...

    def end(self, carry: list[Carry]) -> Any:
        """The result, when all steps are taken."""


def first_rows(saved: list[Any], number: int) -> list[Any]:
    """Of what the compiled loop saved, piece by piece, the first `number` rows, on the host."""
    return jax.tree.map(lambda x: np.array(np.asarray(x)[:number]), saved)


def rows(layout: Layout, saved: list[Any], number: int) -> Any:
    """The same of all members together."""
    return members.fetch(layout, first_rows(saved, number), 1)


def first_entry(job: Job) -> dict[str, np.ndarray]:
    """The entry of the start in the series of reductions."""
    zero = np.zeros(1, job.dt.dtype)
    return dict.fromkeys(("least", "greatest", "mean", "residual"), zero) | {"unconverged": np.zeros(1, np.int64)}


def reduced(rows: tuple[StepInfo, Range], job: Job) -> dict[str, np.ndarray]:
    """Rows (saves, members) to series (saves,); sums in the order of the members, whatever held them."""
    info, change = rows
    return {
        "least": change.least.min(axis=1),
        "greatest": change.greatest.max(axis=1),
        "mean": np.array([np.sum(row) for row in np.asarray(change.total)]) / (job.members * job.save_every),
        "residual": info.residual.max(axis=1),
        "unconverged": (~np.asarray(info.converged)).sum(axis=1),
    }  # pyright: ignore[reportReturnType]
