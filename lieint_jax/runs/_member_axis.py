"""The member axis of states and saves, which a run of one body has while it is computed."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lieint_jax.runs._job import MemberSummary, Saves, Summary
from lieint_jax.runs._loop import Change
from lieint_jax.types import State, Step, Trajectory, checked_step, promoted

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
    return {name: getattr(summary, name) for name in names}


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


def is_batch(step: Step, states: State, own_step: bool) -> bool:
    """Whether states have one axis more than the phase space of the step's system needs."""
    step, states = checked_step(step), promoted(step, states)[1]
    if own_step:
        step = jax.tree.map(lambda x: x[0], step)
    own = step.system.phase_space.origin
    axes = {name: np.ndim(getattr(states, name)) - np.ndim(getattr(own, name)) for name in ("q", "p")}
    if axes["q"] != axes["p"] or axes["q"] not in (0, 1):
        q, p, needed = np.shape(states.q), np.shape(states.p), (np.shape(own.q), np.shape(own.p))
        raise ValueError(
            f"states of {type(step.system).__name__} have q of shape {needed[0]} and p of shape {needed[1]}, those of "
            f"a batch one leading axis more; got q {q} and p {p}"
        )
    return axes["q"] == 1


def check_own_steps(step: Step, members: int | None) -> None:
    """Raise ValueError unless all leaves of a step have a leading axis of so many members."""
    shapes = [np.shape(x) for x in jax.tree.leaves(checked_step(step))]
    if any(shape[:1] != (members,) for shape in shapes):
        given = ", ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(
            f"own_step=True needs a step for each of {members} members, made by jax.vmap, so that every leaf has a "
            f"leading member axis; got leaves of shapes {given}"
        )
