"""What a run returns: a trajectory, or the summary of a reduced quantity; with and without the member axis."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from lieint_jax.core import State, Trajectory
from lieint_jax.runs._devices import Tree
from lieint_jax.runs._loop import Change
from lieint_jax.runs._storage.leaves import Saves

SERIES = ("least", "greatest", "mean", "residual", "unconverged")  # of a reduction; per member only the last two
Series = dict[str, np.ndarray]  # by these names


class Summary(NamedTuple):
    """The result of a run with `reduce`. Time is the axis of all fields but the last two; entry 0 is the start.

    Attributes:
        t: times, shape (n+1,).
        least, greatest, mean: the least, greatest and mean change of the reduced quantity since the start, over all
            members and all steps since the previous entry.
        residual: the largest residual over the same members and steps.
        unconverged: the number of members with a step that did not converge since the previous entry.
        state: the states at the end, (members, …).
        failed: the first step of each member that did not converge, or −1.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    mean: np.ndarray
    residual: np.ndarray
    unconverged: np.ndarray
    state: State
    failed: np.ndarray


class MemberSummary(NamedTuple):
    """The result of a run with `reduce` and `per="member"`, over all steps of each member, the start included.

    Attributes:
        t: the times of the start and of the end, (2,).
        least, greatest, total, last: the least, the greatest, the sum and the last value of the quantity, (members,).
        first: the first time at which the condition `first` was true, NaN if never, (members,); None without one.
        residual, unconverged: of the start and of all steps, as in `Summary`, (2,).
        number: the number of values of a member.
        state: the states at the end, (members, …).
        failed: the first step of each member that did not converge, or −1.
        excess: what rounding has added to the sum, (members,), from which it is continued.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    total: np.ndarray
    last: np.ndarray
    first: np.ndarray | None
    residual: np.ndarray
    unconverged: np.ndarray
    number: int
    state: State
    failed: np.ndarray
    excess: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The mean of the quantity over the values, (members,)."""
        return self.total / self.number

    @property
    def change(self) -> Change:
        """The values of the quantity."""
        return Change(self.least, self.greatest, self.total, self.excess, self.last, self.first)


def member_of(found: Any, k: int) -> Any:
    """The trajectory of member k, or the summary of a run of one body without its member axis."""
    if isinstance(found, Trajectory):
        state, info = jax.tree.map(lambda x: np.asarray(x[:, k]), (found.state, found.info))
        return Trajectory(found.t if state.t is None else state.t, state, info)
    return found._replace(**jax.tree.map(lambda x: x[k], _of_members(found)))


def _of_members(summary: Summary | MemberSummary) -> dict[str, Tree]:
    """The fields of a summary that have a member axis."""
    names = ("state", "failed", *(Change._fields if isinstance(summary, MemberSummary) else ()))
    return {name: x for name, x in summary._asdict().items() if name in names}


def with_member_axis(tree: Tree, axis: int = 0) -> Tree:
    """The arrays of one body with a member axis of length 1."""
    return jax.tree.map(lambda x: np.expand_dims(np.asarray(x), axis), tree)


def saves_of_batch(saves: Saves) -> Saves:
    """The saves of a run of one body with a member axis."""
    found: Any = saves.found
    if isinstance(found, Trajectory):
        found = Trajectory(found.t, *with_member_axis((found.state, found.info), 1))
    else:
        found = found._replace(**with_member_axis(_of_members(found)))
    return Saves(found, with_member_axis(saves.failed))
