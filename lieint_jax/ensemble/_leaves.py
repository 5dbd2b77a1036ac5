"""The arrays of states by the names that stores and files have for them: q, p, t, work, and extra.NAME."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lieint_jax.types import State

_EXTRA = "extra."


def named(state: State) -> dict[str, Any]:
    """The arrays that a state has, by name."""
    own = {name: x for name, x in state._asdict().items() if name != "extra" and x is not None}
    return own | {f"{_EXTRA}{name}": x for name, x in (state.extra or {}).items()}


def state_of(arrays: Mapping[str, Any]) -> State:
    """The state of these arrays, which `named` gives."""
    extra = {name.removeprefix(_EXTRA): x for name, x in arrays.items() if name.startswith(_EXTRA)}
    own = {name: x for name, x in arrays.items() if not name.startswith(_EXTRA)}
    return State(**own, extra=extra or None)


def stored_name(name: str) -> str:
    """The name that an array has in a store, an identifier: extra_NAME for extra.NAME."""
    return name.replace(".", "_")


def shared_time(times: np.ndarray, members: int) -> np.ndarray:
    """The time of each member, (…, members), where all share `times`, (…); a view that takes no memory."""
    return np.broadcast_to(times[..., None], (*times.shape, members))
