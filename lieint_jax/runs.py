"""What an ensemble is to do, and what it keeps of each save interval: shared by runs in memory and on disk."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from lieint_jax import members
from lieint_jax.members import Layout, Range, Reduction
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
    """What is to be integrated. `given` is dt as the caller has it, `dt` an array of the states' dtype."""

    step: Step
    states: State
    given: float
    dt: Any
    interval: int
    num_saves: int
    step_axis: int | None
    reduction: Reduction | None

    @property
    def num_steps(self) -> int:
        """Number of steps in all."""
        return self.interval * self.num_saves

    @property
    def times(self) -> np.ndarray:
        """Times of all entries."""
        return self.given * self.interval * np.arange(self.num_saves + 1, dtype=self.dt.dtype)

    @property
    def members(self) -> int:
        """Number of members."""
        return self.states.p.shape[0]

    def rows(self, across: int) -> int:
        """How many saves are kept together, for chunks of `across` members."""
        row = max(sum(leaf[0].nbytes for leaf in self.states) + 9, 24)
        enough = min(_CHUNK_BYTES // (across * row), _MEMORY // (self.members * row))
        return int(max(1, min(enough, _CHUNK_WORK // (self.members * self.interval), self.num_saves + 1)))


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
        "mean": np.array([np.sum(row) for row in np.asarray(change.total)]) / (job.members * job.interval),
        "residual": info.residual.max(axis=1),
        "unconverged": (~np.asarray(info.converged)).sum(axis=1),
    }  # pyright: ignore[reportReturnType]
