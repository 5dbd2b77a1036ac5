"""One member's part of a run: its save intervals, its carry; and XLA's loop over all members."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from platform import machine
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._integrate import (
    Body,
    GridClock,
    Progress,
    RoundedClock,
    StateClock,
    UniformClock,
    march,
    prepared,
    step_at_node,
)
from lieint_jax.ensemble._layout import Numbers
from lieint_jax.types import State, Step, StepInfo, energy_less_work

_T = TypeVar("_T")
Reduction = Callable[[Step, State], Array]
Axes = Any  # the member axes of a function's arguments, as in `jax.vmap`


class Range(NamedTuple):
    """The least, the greatest and the sum of a quantity over the steps since the last save, for each member."""

    least: Array
    greatest: Array
    total: Array

    @classmethod
    def empty(cls, like: Array) -> Range:
        """The range over no steps."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), jnp.zeros_like(like))

    def include(self, x: Array) -> Range:
        """The range with one more value per member; a NaN makes all three NaN."""
        return Range(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x)


class Carry(NamedTuple):
    """The values that a run carries from one step to the next, for one member, or with the member axis first.

    Attributes:
        state: the states, without their time, which follows from the number of steps unless the step has its own.
        info: the merged `StepInfo` since the last save.
        failed: the first step that did not converge, or −1.
        change: the range of the reduced quantity's change since the last save; None if nothing is reduced.
    """

    state: State
    info: StepInfo
    failed: Array
    change: Range | None


Saved = tuple[StepInfo, State | Range | None]  # a saved row: the report, and the states or the reduced change
MappedInterval = Callable[..., tuple[Carry, Saved]]  # `Interval` or a loop of it, for all members


class Origin(NamedTuple):
    """The data of the start to which every step refers.

    Attributes:
        t0: the time of the initial states: a scalar if the members share it, else one for each. None if they have no
            time, or if the step has a time of its own, which then is part of the state.
        clock: the times of the steps; for steps of one size its t0 is not used.
        quantity: the reduced quantity of the initial states; None if nothing is reduced.
    """

    t0: Numbers | None
    clock: UniformClock | RoundedClock | GridClock
    quantity: Numbers | None

    def add_time(self, n: ArrayLike, state: State) -> State:
        """The state with the time of node n, if states have a time."""
        return state if self.t0 is None else state._replace(t=self.own_clock.time(n))

    def remove_time(self, state: State) -> State:
        """The state without a time that follows from the number of steps."""
        return state if self.t0 is None else state._replace(t=None)

    @property
    def own_clock(self) -> UniformClock | RoundedClock | GridClock | StateClock:
        """The clock of a member, which begins at the time of its initial state."""
        if isinstance(self.clock, GridClock):
            return self.clock
        return StateClock(self.clock.dt) if self.t0 is None else self.clock._replace(t0=self.t0)


class Span(NamedTuple):
    """A save interval, or the part of one that a call computes.

    Attributes:
        first, end: the numbers of steps before it and at its end.
        rest: the size of the shorter step from its end to the output; None if the output is at the end.
        begins: True if a save interval begins here; False if one continues, whose report is in the carry.
    """

    first: Numbers
    end: Numbers
    rest: Numbers | None
    begins: Numbers | np.bool_


class Interval(NamedTuple):
    """The function of one member that a run repeats: (carry, step, plain step, origin, span) ↦ (carry, saved).

    The plain step, without the constants of whole steps, is for shorter steps to outputs; None if it is the same step.
    The saved values are the report, and the state or the change of the reduced quantity since the origin. An iteration
    of the loop computes `together` steps, as long as so many remain.
    """

    reduction: Reduction | None
    together: int = 1

    def __call__(self, carry: Carry, step: Step, plain: Step | None, origin: Origin, span: Span) -> tuple[Carry, Saved]:
        info, change = carry.info, carry.change
        empty = StepInfo.empty(info.residual), None if change is None else Range.empty(change.total)
        info, change = jax.tree.map(lambda new, old: jnp.where(span.begins, new, old), empty, (info, change))

        def advance_once(state: State, n: Array) -> tuple[State, StepInfo]:
            end, info = step_at_node(step, origin.own_clock, origin.add_time(n, state), n)
            return origin.remove_time(end), info

        def record(n: Array, before: Progress, after: Progress, info: StepInfo) -> tuple[Array, Range | None]:
            failed, change = before.seen
            failed = _first_failure(failed, n, info)
            if self.reduction is None or change is None or origin.quantity is None:
                return failed, change
            quantity = self.reduction(step, origin.add_time(n + 1, after.state))
            return failed, change.include(quantity - origin.quantity)

        start = Progress(carry.state, info, (carry.failed, change))
        count, repeat = span.end - span.first, partial(_several_at_once, together=self.together)
        state, info, (failed, change) = march(advance_once, span.first, count, start, observe=record, repeat=repeat)
        output, worst = state, info
        if span.rest is not None:
            output, last = (step if plain is None else plain)(origin.add_time(span.end, state), span.rest)
            output, worst = origin.remove_time(output), info.merge(last)
            failed = _first_failure(failed, span.end, last)
        saved = worst, output if self.reduction is None else change
        return Carry(state, info, failed, change), saved


def _first_failure(failed: Array, n: Numbers, info: StepInfo) -> Array:
    """The first step that failed, after that from node n with such a report."""
    return jnp.where((failed < 0) & ~info.converged, n.astype(failed.dtype), failed)


def _several_at_once(body: Body, first: Array, count: Array, carry: _T, together: int) -> _T:
    """A `lax.fori_loop`, with so many steps in an iteration of the loop as long as so many remain."""

    def iteration(k: Array, carry: _T) -> _T:
        for j in range(together):
            carry = body(first + k * together + j, carry)
        return carry

    if together == 1:
        return lax.fori_loop(first, first + count, body, carry)
    times = count // together
    carry = lax.fori_loop(0, times, iteration, carry)
    return lax.fori_loop(first + times * together, first + count, body, carry)


class Quantity(NamedTuple):
    """A function of a step and a state, of one member: (step, state, origin, n) ↦ its value at node n."""

    function: Reduction

    def __call__(self, step: Step, state: State, origin: Origin, n: Array) -> Array:
        return self.function(step, origin.add_time(n, state))


class Preparation(NamedTuple):
    """(step, state, origin) ↦ the step with its constants for whole steps."""

    def __call__(self, step: Step, state: State, origin: Origin) -> Step:
        return prepared(step, origin.add_time(0, state), origin.clock)


def start(states: State, reduced: Numbers | None) -> Carry:
    """The carry of a run that begins with `states`, arrays of the host."""
    members, dtype = states.p.shape[0], states.p.dtype
    info = StepInfo(np.zeros(members, dtype), np.ones(members, bool))  # pyright: ignore[reportArgumentType]
    change = None
    if reduced is not None:
        change = Range(*(np.full(members, x, dtype) for x in (np.inf, -np.inf, 0)))  # pyright: ignore
    return Carry(states, info, np.full(members, -1, step_dtype()), change)  # pyright: ignore[reportArgumentType]


def step_dtype() -> np.dtype:
    """The dtype of step counts: int64, or int32 without x64."""
    return jax.dtypes.canonicalize_dtype(np.int64)


def energy(step: Step, state: State) -> Array:
    """The energy of a step's system, minus the work where the state has it: H − W."""
    return energy_less_work(step.system, state)


def compiler_options(platform: str | None = None) -> dict[str, str | int]:
    """XLA's options for the compiled loops.

    On x86 they select 512-bit vectors, which are 1.4 to 1.7 times as fast on AVX-512 machines. On a GPU they put whole
    loops into one command buffer; otherwise the host would wait for the device at every iteration.

    Args:
        platform: "cpu" or "gpu"; None means that of JAX's default devices.

    Returns:
        The options by name, for `compiler_options` of `jax.jit`.
    """
    platform = platform or jax.default_backend()
    if platform == "gpu":
        return {"xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL"}
    on_x86 = platform == "cpu" and machine().lower() in ("x86_64", "amd64")
    return {"xla_cpu_prefer_vector_width": 512} if on_x86 else {}


@cache
def compile_for_members(function: Callable[..., _T], axes: Axes) -> Callable[..., _T]:
    """A function of one member, compiled by XLA for many; `axes` as in `jax.vmap`."""
    return jax.jit(jax.vmap(function, axes), compiler_options=compiler_options())


@cache
def compile_intervals(interval: MappedInterval) -> MappedInterval:
    """`over_intervals`, compiled by XLA."""
    return jax.jit(over_intervals(interval), compiler_options=compiler_options())


def over_intervals(interval: MappedInterval) -> MappedInterval:
    """The loop over save intervals: (carry, step, plain step, origin, spans, number of spans) ↦ (carry, saved).

    Args:
        interval: `Interval` for all members, vmapped or flattened.
    """

    def loop(
        carry: Carry, step: Step, plain: Step | None, origin: Origin, spans: Span, count: Array
    ) -> tuple[Carry, Saved]:
        def body(k: Array, both: tuple[Carry, Saved]) -> tuple[Carry, Saved]:
            carry, saved = both
            carry, row = interval(carry, step, plain, origin, jax.tree.map(lambda x: x[k], spans))
            return carry, jax.tree.map(lambda to, x: to.at[k].set(x), saved, row)

        row = carry.info, carry.state if carry.change is None else carry.change
        saved = jax.tree.map(lambda x: jnp.zeros((len(spans.first), *x.shape), x.dtype), row)
        return lax.fori_loop(0, count, body, (carry, saved))

    return loop


@cache
def vmap_interval(reduction: Reduction | None, axes: Axes) -> MappedInterval:
    """`Interval` for all members."""
    return jax.vmap(Interval(reduction), axes)
