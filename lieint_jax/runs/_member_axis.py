"""The member axis of states and saves, which a run of one body has while it is computed."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lieint_jax.runs._job import MemberSummary, Saves, Summary
from lieint_jax.runs._loop import Change
from lieint_jax.types import Trajectory

Tree = Any  # a tree of arrays


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
    return jax.tree.map(lambda x: np.expand_dims(np.asarray(x), axis), tree)


def saves_of_batch(saves: Saves) -> Saves:
    """The saves of a run of one body with a member axis."""
    found: Any = saves.found
    if isinstance(found, Trajectory):
        found = Trajectory(found.t, *with_member_axis((found.state, found.info), 1))
    else:
        found = found._replace(**with_member_axis(_of_members(found)))
    return Saves(found, with_member_axis(saves.failed))
