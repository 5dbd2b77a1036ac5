"""The rows of a run, and the output that keeps them in memory."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lieint_jax.core import StepInfo, Trajectory
from lieint_jax.runs import _devices as devices
from lieint_jax.runs import _loop as loop
from lieint_jax.runs._devices import Tree
from lieint_jax.runs._dyadic_sum import block_sums, blocks, total
from lieint_jax.runs._loop import Carry
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.runs._summary import MemberSummary, Series, Summary


def first_rows(plan: Plan, carry: Carry) -> Tree | Series:
    """The entry of the start: a row (1, members) of the report and the states, or that of the series of a reduction."""
    if plan.reduction is None:
        return jax.tree.map(lambda x: np.asarray(x)[None], (carry.info, plan.as_saved(carry.state)))
    found: Series = dict.fromkeys(plan.series_names, np.zeros(1, plan.dtype)) | {"unconverged": np.zeros(1, np.int64)}
    if plan.part_members is not None and not plan.per_member:
        found["sums"] = np.zeros((1, len(blocks(plan.part_members.start, plan.part_members.stop))), plan.dtype)
    return found


def rows_and_carry(plan: Plan, saves: Saves) -> tuple[Tree | Series, Carry]:
    """The rows of a run in memory, that of the start first, and the carry at its end."""
    found, failed = saves.found, saves.failed
    end, change = found.state, None
    if isinstance(found, Trajectory):
        rows: Tree = found.info, plan.as_saved(found.state)
        end = jax.tree.map(lambda x: x[-1], found.state)
    else:
        rows = {name: np.asarray(found._asdict()[name]) for name in plan.series_names}
        change = found.change if isinstance(found, MemberSummary) else plan.first_change(failed, None)
    return rows, loop.start(end, change)._replace(failed=failed.astype(loop.step_dtype()))


def reduce_rows(rows: Tree, number: int, plan: Plan) -> Series:
    """Reduce the first `number` rows (saves, members) to series (saves,), of the same bits however the run is split.

    For a part, "sums" (saves, blocks) are the sums from which the mean of the whole run is computed.
    """
    info, change = _rows(rows, number, plan)
    reports = {
        "residual": info.residual.max(axis=1),
        "unconverged": (~np.asarray(info.converged)).sum(axis=1),
    }
    if change.per_member:
        return reports  # pyright: ignore[reportReturnType]
    sums = block_sums(np.asarray(change.total), plan.first_member)
    members = range(plan.first_member, plan.first_member + plan.members)
    found = {
        "least": change.least.min(axis=1),
        "greatest": change.greatest.max(axis=1),
        "mean": total([(members, sums)]) / (plan.members * (plan.save_every or 1)),
        **reports,
    }
    return found if plan.part_members is None else found | {"sums": sums}  # pyright: ignore[reportReturnType]


def _rows(saved: Tree, number: int, plan: Plan) -> Tree:
    """The first `number` saved rows of the members of a plan, on the host."""
    return devices.without_padding(jax.tree.map(lambda x: np.asarray(x)[:number], saved), plan.members, 1)


class MemoryOutput:
    """Results as numpy arrays; `earlier` are those of a run of which this one is the continuation.

    `StoreOutput` has the same methods.

    Attributes:
        commits: whether it writes to a store; then an interrupt waits until the run `can_stop`.
        buffer_rows: the largest number of saves in one call of the compiled loop: the length of its buffer.
        free_rows: the largest number of saves in the next call.
    """

    commits = False

    def __init__(self, plan: Plan, earlier: Saves | None = None) -> None:
        self._plan, self._entries, self._earlier = plan, 0, earlier
        self.buffer_rows = self.free_rows = plan.buffer_rows(plan.members)
        self._out: Any = None  # rows of all entries, or series

    def restore(self) -> tuple[Carry, int, int] | None:
        """The carry and the numbers of steps and of saves of the unfinished run in this output, or None."""
        if self._earlier is None:
            return None
        found = self._earlier.found
        rows, carry = rows_and_carry(self._plan, self._earlier)
        saved = len(found.t) - 1
        done = int(self._plan.nodes[saved])
        if isinstance(found, MemberSummary):  # whose one interval goes on
            done, saved = int(found.number) - 1, 0
            rows = first_rows(self._plan, carry)
            carry = carry._replace(
                info=StepInfo(np.full(carry.failed.shape, found.residual[-1]), carry.failed < 0)  # pyright: ignore
            )
        self._put(rows)
        return devices.placed(self._plan.mesh, carry), done, saved

    def append(self, saved: Tree | Series, number: int) -> None:
        """Receive `number` saved rows, or those of the series of a reduction; that of the start first."""
        self._put(saved if isinstance(saved, dict) else _rows(saved, number, self._plan))

    def _put(self, rows: Tree | Series) -> None:
        """Copy rows to the arrays of all entries, which the first of them make."""
        if self._out is None:
            entries = self._plan.num_saves + 1
            self._out = jax.tree.map(lambda x: np.empty((entries, *x.shape[1:]), x.dtype), rows)
        number = len(jax.tree.leaves(rows)[0])
        for target, x in zip(jax.tree.leaves(self._out), jax.tree.leaves(rows), strict=True):
            target[self._entries : self._entries + number] = x
        self._entries += number

    def checkpoint(self, carry: Carry, done: int, seconds: float, stop: bool) -> None:
        """Receive, after each call of the loop, a carry from which the run can be resumed."""

    def can_stop(self) -> bool:
        """True if everything that a resumed run needs has been written."""
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        """The message for a user who interrupted the run."""
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def result(self, carry: Carry) -> Saves:
        """The saves, after the last step."""
        plan, times = self._plan, self._plan.times
        state, failed = devices.without_padding((carry.state, carry.failed), plan.members)
        if plan.reduction is None:
            info, states = self._out
            return Saves(Trajectory(times, plan.with_times(states), info), failed)  # pyright: ignore
        series = {name: x for name, x in self._out.items() if name != "sums"}
        ends = {"state": plan.with_times(state, -1), "failed": failed}
        if not plan.per_member:
            return Saves(Summary(times, **series, **ends), failed)
        change: Any = devices.without_padding(carry.change, plan.members)
        return Saves(MemberSummary(times, **change._asdict() | series | ends, number=plan.num_steps + 1), failed)
