"""The arrays of states, by the names that stores and files have for them, and the run that they make."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lieint_jax.core import State, state_from_leaves

Table = dict[str, Any]  # an object of JSON
STEP = "step"  # the group of the arrays of the step


def store_name(name: str) -> str:
    """The name of an array in a store, an identifier: extra_NAME for extra.NAME."""
    return name.replace(".", "_")


def step_array(name: str) -> str:
    """The path of an array of the step: these are in a group of their own, so that readers of the root see the run."""
    return f"{STEP}/{name}"


def shared_time(times: np.ndarray, members: int) -> np.ndarray:
    """The time of each member, (…, members), where all share `times`, (…); a view that needs no memory."""
    return np.broadcast_to(times[..., None], (*times.shape, members))


def states_in(arrays: Any, times: np.ndarray, metadata: Table) -> State:
    """The states among the arrays of a store, whose attributes list them. A shared time has no array of its own."""
    leaves = metadata["leaves"]
    found = {name: arrays[store_name(name)] for name in leaves if store_name(name) in arrays}
    if "t" in leaves and "t" not in found:
        found["t"] = shared_time(times, metadata["members"])
    return state_from_leaves(found)


class Saves(NamedTuple):
    """The saves of a run, in memory or in a store.

    Attributes:
        found: a `Trajectory`, of a store with arrays that are read where they are indexed; or the summary of a reduced
            run, for which its arrays by name stand while it is read.
        failed: the first step of each member that did not converge, or −1; None if that is not known yet.
        attributes: those of the store; None in memory.
    """

    found: Any
    failed: Any
    attributes: Any = None
