"""The peak memory of a run, before it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from lieint_jax.ensemble._job import rows_of_call
from lieint_jax.ensemble._part_of_task import checked_part
from lieint_jax.ensemble._storage import Url, address
from lieint_jax.ensemble._store_output import StoreOptions, chunk_members
from lieint_jax.types import State

_STATES = 6  # copies of a part's states: of the carries, of a checkpoint, and while they are checked
_ROWS, _STORED_ROWS = 3, 6  # copies of the rows of a call; a store's are joined and encoded while others are computed
_REDUCED = 5 * 8 + 1  # bytes of a member in a row of a run with `reduce`


def peak_memory(
    states: State,
    entries: int,
    *,
    store: str | Path | StoreOptions | None = None,
    reduce: bool = False,
    part: tuple[int, int] | None = None,
    save_every: int = 1,
) -> int:
    """The bytes that `ensemble.run` will need at most, beyond those of the process and of the states before it.

    It is an estimate for machine code on a CPU, whose numbers of copies were fitted to the peaks of free bodies that
    `benchmarks/scale.py` measures; other systems may need more. With `store` it grows by only 16 bytes per entry, with
    `reduce` by 56.

    Args:
        states: the initial states of all members.
        entries: the number of saved entries, that of the start included.
        store: as in `run`.
        reduce: whether the run reduces.
        part: as in `run`.
        save_every: the number of steps between two saves.

    Returns:
        The number of bytes.
    """
    _, count = checked_part(part)
    leaves = jax.tree.leaves(states)
    members = len(states.p)
    own = -(-members // count)
    state = sum(np.dtype(x.dtype).itemsize * int(np.size(x)) for x in leaves) // members
    row = max(state + 9, 24)
    place: Any = store.path if isinstance(store, StoreOptions) else store
    remote = place is not None and isinstance(address(place), Url)
    across = chunk_members(members, count, row, entries, remote) if store is not None else members
    rows = rows_of_call(min(across, own), own, row, save_every, entries, remote)
    digested = max(int(np.size(x)) * np.dtype(x.dtype).itemsize for x in leaves) if store is not None else 0
    kept = entries * (members if part is None else own) * row if store is None and not reduce else 0
    held = rows * own * (_REDUCED if reduce else row) * (_ROWS if store is None or reduce else _STORED_ROWS)
    return kept + held + _STATES * own * state + digested + entries * (16 + 40 * reduce)
