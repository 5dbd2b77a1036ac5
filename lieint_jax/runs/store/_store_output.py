"""Results in a store, and its checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from lieint_jax.core import StepInfo, leaves_by_name, state_from_leaves
from lieint_jax.runs import _devices as devices
from lieint_jax.runs._devices import Numbers, Tree
from lieint_jax.runs._loop import Carry, Change
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._storage.leaves import Table, store_name
from lieint_jax.runs._summary import Series
from lieint_jax.runs.store._writer import Slab, Writer

Pending = Any  # saved rows, or the series of a reduction by name
SLAB = 8  # chunks of members that are joined along time, and written, at once
_CHECKPOINT_EVERY = 30.0  # seconds between checkpoints within a long save interval


class StoreOutput:
    """Results in a store, written chunk by chunk, with a checkpoint after each chunk."""

    commits = True

    def __init__(self, plan: Plan, writer: Writer) -> None:
        self._plan, self._writer = plan, writer
        self._entries = writer.progress["entries"]  # committed so far
        self._pending: list[tuple[Pending, int]] = []
        self._since = 0.0
        self.buffer_rows = int(writer.attributes["time_chunk"])

    @property
    def _pending_rows(self) -> int:
        return sum(number for _, number in self._pending)

    @property
    def free_rows(self) -> int:
        """The number of saves until the current chunk is full."""
        return self.buffer_rows - (self._entries + self._pending_rows) % self.buffer_rows

    def restore(self) -> tuple[Carry, int, int] | None:
        """The carry and the numbers of steps and of saves of the run in the store, or None."""
        done = self._writer.progress
        if not done["commits"]:
            return None
        found = self._writer.carry()
        info = StepInfo(found["residual"], found["converged"])
        state = state_from_leaves({name: found[name] for name in leaves_by_name(self._plan.states)})
        names = self._plan.change_names
        carry = Carry(state, info, found["failed"], Change(**{name: found[name] for name in names}) if names else None)
        return devices.placed(self._plan.mesh, carry), done["steps"], done["entries"] - 1

    def append(self, saved: Tree | Series, number: int) -> None:
        """See `MemoryOutput`. A part of a longer buffer is copied, so that this can be freed."""

        def on_host(x: Numbers) -> np.ndarray:
            x = np.asarray(x)
            return x if len(x) == number else x[:number].copy()

        self._pending.append((jax.tree.map(on_host, saved), number))

    def checkpoint(self, carry: Carry, done: int, seconds: float, stop: bool) -> None:
        """Commit if a chunk is full; or if no rows are pending and the last commit is old or the run is to stop."""
        self._writer.check()
        self._since += seconds
        last = self._entries + self._pending_rows > self._plan.num_saves
        whole = self._pending_rows and (self._entries + self._pending_rows) % self.buffer_rows == 0
        if not (last or whole or (not self._pending_rows and (stop or self._since > _CHECKPOINT_EVERY))):
            return
        self._writer.wait()
        pending, first, writer = self._pending, self._entries, self._writer
        number = writer.progress["commits"] + 1
        self._entries, self._pending, self._since = first + self._pending_rows, [], 0.0
        row = first // self.buffer_rows if pending else None
        commits = 0 if last else number  # reset: it depends on interruptions
        progress = {"commits": commits, "entries": self._entries, "steps": done, "complete": last}
        writer.write(partial(self._slabs, carry, pending, first, last), partial(self._publish, carry, row, progress))

    def _publish(self, carry: Carry, row: int | None, progress: Table) -> None:
        """Publish a commit whose chunks are written; called by the background thread."""
        arrays = {} if progress["complete"] else devices.without_padding(_leaves_of_carry(carry), self._plan.members)
        self._writer.publish(row, progress, arrays)

    def _slabs(self, carry: Carry, pending: list[tuple[Pending, int]], first: int, last: bool) -> Iterator[Slab]:
        """What a commit writes, piece by piece, computed by the background thread."""
        if last:
            yield from self._end(carry)
        if not pending:
            return
        end = first + sum(number for _, number in pending)
        if self._plan.reduction is None:
            yield from self._slabs_of_rows(pending, slice(first, end))
        else:
            for name in pending[0][0]:
                yield Slab(name, (first,), np.concatenate([values[name] for values, _ in pending]))

    def _end(self, carry: Carry) -> Iterator[Slab]:
        """What is known after the last step only."""
        members = range(self._plan.members)
        host = devices.without_padding(_leaves_of_carry(carry), len(members))
        kept = {"first_failure": host["failed"]}
        if self._plan.reduction is not None:
            names = self._plan.change_names if self._plan.per_member else ()
            kept |= {name: host[name] for name in (*leaves_by_name(self._plan.states), *names)}
            if self._plan.shared_time:
                del kept["t"]
            elif self._plan.own_times:
                kept["t"] = self._plan.times_of(-1)
        for name, x in kept.items():
            yield Slab(store_name(name), (members.start,), x)

    def _slabs_of_rows(self, pending: list[tuple[Pending, int]], entries: slice) -> Iterator[Slab]:
        """The rows of all members, joined along time for a few chunks at once: memory has no copy of all."""
        members, across = range(self._plan.members), SLAB * int(self._writer.attributes["member_chunk"])
        slabs = [members[k : k + across] for k in range(0, len(members), across)]
        saved = [leaves_by_name(state) | info._asdict() for (info, state), _ in pending]
        for name in saved[0]:
            pieces = [devices.without_padding(rows[name], len(members), 1) for rows in saved]
            for slab in slabs:
                rows = [piece[:, slab.start : slab.stop] for piece in pieces]
                joined = np.concatenate(rows) if len(rows) > 1 else rows[0]
                yield Slab(store_name(name), (entries.start, slab.start), joined)
        if self._plan.own_times:
            for slab in slabs:
                times = self._plan.times_of(entries, slice(slab.start, slab.stop))
                yield Slab("t", (entries.start, slab.start), times)

    def can_stop(self) -> bool:
        """True if everything so far is committed."""
        if self._pending:
            return False
        self._writer.wait()
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        """The message for a user who interrupted the run."""
        return f"stopped after {done} of {num_steps} steps, all of them in {self._writer.path}; resume to continue"

    def result(self, carry: Carry) -> None:
        """Wait until everything is written."""
        self._writer.wait()


def _leaves_of_carry(carry: Carry) -> dict[str, Numbers]:
    """The arrays of a carry by name."""
    change = {} if carry.change is None else {k: x for k, x in carry.change._asdict().items() if x is not None}
    return {**leaves_by_name(carry.state), "failed": carry.failed, **carry.info._asdict(), **change}
