"""One member's part of a run: its save intervals, its carry; and the compiled loop over all members."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from platform import machine
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import jaxpr_as_fun
from jax.typing import ArrayLike

from lieint_jax import native
from lieint_jax._xla import compiled_for
from lieint_jax.runs._clock import GridClock, RoundedClock, StateClock, UniformClock
from lieint_jax.runs._driver import Body, Progress, march, prepared, step_at_node
from lieint_jax.runs._layout import Numbers, Tree
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
    def begin(cls, members: int, dtype: np.dtype) -> Range:
        """The ranges of so many members over no steps, arrays of the host."""
        return cls(*(np.full(members, x, dtype) for x in (np.inf, -np.inf, 0)))  # pyright: ignore[reportArgumentType]

    @classmethod
    def empty(cls, like: Array) -> Range:
        """The range over no steps."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), jnp.zeros_like(like))

    def include(self, x: Array) -> Range:
        """The range with one more value per member; a NaN makes all three NaN."""
        return Range(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x)


class MemberRange(NamedTuple):
    """The values of a quantity of each member over all steps so far, the start included.

    Attributes:
        least, greatest, total, last: the least, the greatest, the sum and the last of them.
        first: the first time at which a condition was true, NaN before; None if there is no condition.
    """

    least: Array
    greatest: Array
    total: Array
    last: Array
    first: Array | None

    @classmethod
    def begin(cls, x: Numbers, first: Numbers | None) -> MemberRange:
        """The range at the start, where the quantity is x."""
        return cls(x, x, x, x, first)  # pyright: ignore[reportArgumentType]

    def include(self, x: Array, reached: Array | None, t: Array) -> MemberRange:
        """The range with the value at time t, when the condition is `reached` or not; NaN makes all but `first` NaN."""
        first = self.first
        if first is not None and reached is not None:
            first = jnp.where(jnp.isnan(first) & reached, t.astype(first.dtype), first)
        return MemberRange(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x, x, first)


class Carry(NamedTuple):
    """The values that a run carries from one step to the next, for one member, or with the member axis first.

    Attributes:
        state: the states, without their time, which follows from the number of steps unless the step has its own.
        info: the merged `StepInfo` since the last save.
        failed: the first step that did not converge, or −1.
        change: the range of the reduced quantity's change since the last save, or, reduced for each member, of its
            values since the start; None if nothing is reduced.
    """

    state: State
    info: StepInfo
    failed: Array
    change: Range | MemberRange | None


Saved = tuple[
    StepInfo, State | Range | MemberRange | None
]  # a saved row: the report, and the states or the reduced change


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
    of the loop computes `together` steps, as long as so many remain. A run that is reduced for each member may have a
    condition, of which the first time is recorded at which it is true.
    """

    reduction: Reduction | None
    condition: Reduction | None = None
    together: int = 1

    def __call__(self, carry: Carry, step: Step, plain: Step | None, origin: Origin, span: Span) -> tuple[Carry, Saved]:
        info, change = carry.info, carry.change
        begun = StepInfo.empty(info.residual), Range.empty(change.total) if isinstance(change, Range) else change
        info, change = jax.tree.map(lambda new, old: jnp.where(span.begins, new, old), begun, (info, change))

        def advance_once(state: State, n: Array) -> tuple[State, StepInfo]:
            end, info = step_at_node(step, origin.own_clock, origin.add_time(n, state), n)
            return origin.remove_time(end), info

        def record(n: Array, before: Progress, after: Progress, info: StepInfo) -> tuple[Array, Any]:
            failed, change = before.seen
            failed = _first_failure(failed, n, info)
            if self.reduction is None or change is None or origin.quantity is None:
                return failed, change
            now = origin.add_time(n + 1, after.state)
            quantity = self.reduction(step, now)
            if isinstance(change, Range):
                return failed, change.include(quantity - origin.quantity)
            reached = None if self.condition is None else self.condition(step, now)
            return failed, change.include(quantity, reached, origin.clock.time(n + 1) if now.t is None else now.t)

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


def prepare(step: Step, state: State, origin: Origin) -> Step:
    """The step with its constants for whole steps."""
    return prepared(step, origin.add_time(0, state), origin.clock)


def start(states: State, change: Range | MemberRange | None) -> Carry:
    """The carry of a run that begins with `states`, arrays of the host."""
    members, dtype = states.p.shape[0], states.p.dtype
    info = StepInfo(np.zeros(members, dtype), np.ones(members, bool))  # pyright: ignore[reportArgumentType]
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


@lru_cache(32)
def compile_for_members(function: Callable[..., Tree], axes: Axes) -> Callable[..., Tree]:
    """A function of one member, compiled for many as a loop of one step; `axes` as in `jax.vmap`."""

    def by_one_step(*arguments: Tree) -> Tree:
        found = native.march(lambda n, carry, _: (carry, function(*arguments)), (), rows=1)[1]
        return jax.tree.map(lambda x: x[0], found)

    return jax.jit(jax.vmap(by_one_step, axes), compiler_options=compiler_options())


def intervals(interval: Interval, axes: Axes, data: Sequence[Tree]) -> Intervals:
    """The loop over save intervals of all members, made once for data of one member of the same shapes.

    Args:
        interval: the function of one member.
        axes: the member axes of its arguments, as in `jax.vmap`, but for the span.
        data: what its arguments are made of, as arrays or shapes.
    """
    return native.make_once(Intervals, interval, axes, data)


class Known(NamedTuple):
    """What an engine makes of a loop.

    Attributes:
        refusal: why it cannot compute it; empty if it can.
        shared: about how many numbers of a step the members share.
        length: the number of operations of a step.
    """

    refusal: str
    shared: int = 0
    length: int = 0


class Intervals:
    """The loop over save intervals: (carry, step, plain step, origin, spans, number of spans) ↦ (carry, saved).

    Attributes:
        known: what is known of it by engines, by their names.
    """

    def __init__(self, interval: Interval, axes: Axes, _: Sequence[Tree]):
        self._of_member = jax.jit(interval.__call__)
        self._of_all = jax.jit(jax.vmap(self._loop, (*axes, None, None), (0, 1)), compiler_options=compiler_options())
        self.known: dict[str, Known] = {}

    def __call__(self, *arguments: Tree) -> tuple[Carry, Saved]:
        return self._of_all(*arguments)

    def _loop(
        self, carry: Carry, step: Step, plain: Step | None, origin: Origin, spans: Span, count: Array
    ) -> tuple[Carry, Saved]:
        return native.march(self._next, carry, spans, (step, plain, origin), rows=count, most=len(spans.first))

    def _next(
        self, n: Array, carry: Carry, span: Span, step: Step, plain: Step | None, origin: Origin
    ) -> tuple[Carry, Saved]:
        return self._of_member(carry, step, plain, origin, span)

    def traced(self, *arguments: Tree) -> jax.stages.Traced:
        """The program for arguments of these shapes, as JAX traces it."""
        return self._of_all.trace(*arguments)

    def loop(self, *arguments: Tree) -> native.Loop:
        """Its loop."""
        [loop] = native.loops_of(self.traced(*arguments).jaxpr)
        assert loop is not None
        return loop

    def by_xla(self, *arguments: Tree) -> Callable[..., tuple[Carry, Saved]]:
        """The function of one member, compiled by XLA for arguments of these shapes."""
        traced = self._of_member.trace(*arguments)
        structure = jax.tree.structure(traced.out_info)
        with native.engine("xla"):
            compiled = compiled_for(jaxpr_as_fun(traced.jaxpr), *jax.tree.leaves(arguments))
        return lambda *x: jax.tree.unflatten(structure, compiled(*jax.tree.leaves(x)))
