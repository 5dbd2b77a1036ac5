"""The peak memory of a run, before it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from lieint_jax.core import State
from lieint_jax.runs._clock import power_of_two
from lieint_jax.runs._made_states import MakeStates, made_states
from lieint_jax.runs._part_of_task import checked_part
from lieint_jax.runs._plan import chunk_members, rows_of_call
from lieint_jax.runs._storage.storage import StoreOptions, Url, address
from lieint_jax.runs.store._store_output import SLAB

_CARRIES = 6  # copies of a part's carry: of the loop, and while states are made and checked
_ENCODED = 2  # more of them while a store encodes one
_ROWS = 2  # copies of the rows of a call: a store's are written while others are computed
_CHUNKS = 3  # copies of the chunks that are joined and encoded at once
_IMPORTS = 50_000_000  # bytes of pydantic and the codecs of a store
_REPORT, _CHANGE = 2 * 8 + 1, 3 * 8  # bytes of a member's report and of its reduced quantity in a carry
_REDUCED = 5 * 8 + 1  # bytes of a member in a row of a run with `reduce`


def peak_memory(
    states: State | MakeStates,
    entries: int,
    *,
    store: str | Path | StoreOptions | None = None,
    reduce: bool = False,
    part: tuple[int, int] | None = None,
    save_every: int = 1,
    members: int | None = None,
) -> int:
    """The bytes that `li.run` will need at most, beyond those of the process and of the states before it.

    It is an estimate for machine code on a CPU, whose numbers of copies were fitted to the peaks of free bodies that
    `benchmarks/scale.py` measures; other systems may need more. With `store` it grows by only 16 bytes per entry, with
    `reduce` by 56. The memory of a part grows with the number of its own members only, if `states` is a function.

    Args:
        states: the initial states of all members, or their shapes; or the function of member numbers.
        entries: the number of saved entries, that of the start included.
        store: as in `run`.
        reduce: whether the run reduces.
        part: as in `run`.
        save_every: the number of steps between two saves.
        members: as in `run`.

    Returns:
        The number of bytes.
    """
    count = 1 if part is None else checked_part(part)[1]
    made = made_states(states, members)
    first: Any = states if made is None else made.make(range(1))
    given = len(first.p)
    state = sum(np.dtype(x.dtype).itemsize * int(np.size(x)) for x in jax.tree.leaves(first)) // given
    members = given if made is None else made.members
    own = -(-members // count)
    row = max(state + 9, 24)
    remote = store is not None and isinstance(address(StoreOptions.of(store).path), Url)
    across = chunk_members(members, count, row, entries, remote) if store is not None else members
    rows = power_of_two(rows_of_call(min(across, own), own, row, save_every, entries, remote))
    kept = entries * (members if part is None else own) * row if store is None and not reduce else 0
    held = _ROWS * rows * own * (_REDUCED if reduce else row)
    if store is not None:
        held += _IMPORTS + _CHUNKS * rows * min(own, SLAB * across) * row * (not reduce)
    carry = state + _REPORT + _CHANGE * reduce
    return kept + held + (_CARRIES + _ENCODED * (store is not None)) * own * carry + entries * (16 + 40 * reduce)
