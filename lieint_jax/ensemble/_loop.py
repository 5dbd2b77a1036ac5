"""One member's part of a run: its save intervals, its carry; and XLA's loop over all members."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from platform import machine
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._integrate import GridClock, UniformClock, prepared
from lieint_jax.types import State, Step, StepInfo, energy_less_work

Reduction = Callable[[Step, State], Array]


class Range(NamedTuple):
    """The least, the greatest and the sum of a quantity over the steps since the last save, one of each per member."""

    least: Array
    greatest: Array
    total: Array

    @classmethod
    def empty(cls, like: Array) -> Range:
        """The range of no steps yet."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), jnp.zeros_like(like))

    def include(self, x: Array) -> Range:
        """This range with one more value per member; a NaN shows in all three."""
        return Range(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x)


class Carry(NamedTuple):
    """What a run carries from one step to the next, for one member, or with the member axis first.

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


class Origin(NamedTuple):
    """What a run begins with, and refers to at every step.

    Attributes:
        t0: the time of the initial states: a scalar if the members share it, else one for each; None if they have none,
            or the step has its own, which then is part of the state.
        clock: when the steps are; if they are of one size, its own t0 says nothing.
        quantity: the reduced quantity of the initial states; None if nothing is reduced.
    """

    t0: Array | None
    clock: UniformClock | GridClock
    quantity: Array | None

    def add_time(self, n: ArrayLike, state: State) -> State:
        """The state with its time, that of node n, if it has one."""
        if self.t0 is None:
            return state
        clock = self.clock._replace(t0=self.t0) if isinstance(self.clock, UniformClock) else self.clock
        return state._replace(t=clock.time(n))


class Span(NamedTuple):
    """A save interval, or the part of one that a call does.

    Attributes:
        first, end: the numbers of the steps taken before it, and at its end.
        rest: the size of the shorter step from its end to the output; None if the output is at the end.
        fresh: True if a save interval begins here; False if one is continued, whose report is in the carry.
    """

    first: Any
    end: Any
    rest: Any
    fresh: Any


class Interval(NamedTuple):
    """The function of one member that a run repeats: (carry, step, plain step, origin, span) ↦ (carry, saved).

    The step of shorter steps to outputs, which has no constants for whole steps, is None where it is the same. What is
    saved is the report, and the state or the change of the reduced quantity since the origin. An iteration of the loop
    makes `together` steps, as long as so many are left.
    """

    reduction: Reduction | None
    together: int = 1

    def __call__(self, carry: Carry, step: Step, plain: Step | None, origin: Origin, span: Span) -> tuple[Carry, Any]:
        info, change = carry.info, carry.change
        fresh = StepInfo.fresh(info.residual), None if change is None else Range.empty(change.total)
        info, change = jax.tree.map(lambda new, old: jnp.where(span.fresh, new, old), fresh, (info, change))

        def stepped(step: Step, n: Array, carry: Carry, dt: Array) -> Carry:
            state, info = step(origin.add_time(n, carry.state), dt)
            state = state if origin.t0 is None else state._replace(t=None)
            failed = jnp.where((carry.failed < 0) & ~info.converged, n.astype(carry.failed.dtype), carry.failed)
            return Carry(state, carry.info.merge(info), failed, carry.change)

        def one(n: Array, carry: Carry) -> Carry:
            carry = stepped(step, n, carry, origin.clock.size(n))
            if self.reduction is None or carry.change is None or origin.quantity is None:
                return carry
            after = self.reduction(step, origin.add_time(n + 1, carry.state))
            return carry._replace(change=carry.change.include(after - origin.quantity))

        def several(k: Array, carry: Carry) -> Carry:
            for j in range(self.together):
                carry = one(span.first + k * self.together + j, carry)
            return carry

        carry, first = carry._replace(info=info, change=change), span.first
        if self.together > 1:
            times = (span.end - first) // self.together
            carry, first = lax.fori_loop(0, times, several, carry), first + times * self.together
        carry = shown = lax.fori_loop(first, span.end, one, carry)
        if span.rest is not None:
            shown = stepped(step if plain is None else plain, span.end, carry, span.rest)
            carry = carry._replace(failed=shown.failed)
        return carry, (shown.info, shown.state if self.reduction is None else shown.change)


class Quantity(NamedTuple):
    """A function of a step and a state, of one member: (step, state, origin, n) ↦ its value at node n."""

    function: Callable[..., Any]

    def __call__(self, step: Step, state: State, origin: Origin, n: Array) -> Any:
        return self.function(step, origin.add_time(n, state))


class Preparation(NamedTuple):
    """(step, state, origin) ↦ the step with its constants for whole steps."""

    def __call__(self, step: Step, state: State, origin: Origin) -> Step:
        return prepared(step, origin.add_time(0, state), origin.clock)


def start(states: State, reduced: Array | None) -> Carry:
    """The carry of a run that begins with `states`, arrays of the host."""
    members, dtype = states.p.shape[0], states.p.dtype
    info = StepInfo(np.zeros(members, dtype), np.ones(members, bool))  # pyright: ignore[reportArgumentType]
    change = None
    if reduced is not None:
        change = Range(*(np.full(members, x, dtype) for x in (np.inf, -np.inf, 0)))  # pyright: ignore
    return Carry(states, info, np.full(members, -1, step_dtype()), change)  # pyright: ignore[reportArgumentType]


def step_dtype() -> Any:
    """The dtype of step counts: int64, or int32 without x64."""
    return jax.dtypes.canonicalize_dtype(np.int64)


def energy(step: Step, state: State) -> Array:
    """The energy of a step's system, less the work where the state counts it: H − W."""
    return energy_less_work(step.system, state)


def compiler_options(platform: str | None = None) -> dict[str, Any]:
    """XLA's options for the compiled loops.

    512-bit vectors on x86, 1.4 to 1.7 times faster on AVX-512 machines. On a GPU whole loops are in one command buffer:
    else the host, which does not know how often they go around, waits for the device at every iteration.

    Args:
        platform: "cpu" or "gpu"; None is that of JAX's default devices.
    """
    platform = platform or jax.default_backend()
    if platform == "gpu":
        return {"xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL"}
    on_x86 = platform == "cpu" and machine().lower() in ("x86_64", "amd64")
    return {"xla_cpu_prefer_vector_width": 512} if on_x86 else {}


@cache
def compile_for_members(function: Callable[..., Any], axes: Any) -> Callable[..., Any]:
    """A function of one member, compiled by XLA for many; `axes` as in `jax.vmap`."""
    return jax.jit(jax.vmap(function, axes), compiler_options=compiler_options())


@cache
def compile_intervals(interval: Callable[..., Any]) -> Callable[..., tuple[Carry, Any]]:
    """`over_intervals`, compiled by XLA."""
    return jax.jit(over_intervals(interval), compiler_options=compiler_options())


def over_intervals(interval: Callable[..., Any]) -> Callable[..., tuple[Carry, Any]]:
    """The loop over save intervals: (carry, step, plain step, origin, spans, their number) ↦ (carry, saved).

    Args:
        interval: `Interval` for all members, vmapped or flattened.
    """

    def advanced(carry: Carry, step: Step, plain: Step | None, origin: Origin, spans: Span, count: Array) -> Any:
        def one(k: Array, loop: tuple[Carry, Any]) -> tuple[Carry, Any]:
            carry, saved = loop
            carry, row = interval(carry, step, plain, origin, jax.tree.map(lambda x: x[k], spans))
            return carry, jax.tree.map(lambda to, x: to.at[k].set(x), saved, row)

        shown = carry.info, carry.state if carry.change is None else carry.change
        saved = jax.tree.map(lambda x: jnp.zeros((len(spans.first), *x.shape), x.dtype), shown)
        return lax.fori_loop(0, count, one, (carry, saved))

    return advanced


@cache
def vmap_interval(reduction: Reduction | None, axes: Any) -> Callable[..., tuple[Carry, Any]]:
    """`Interval` for all members."""
    return jax.vmap(Interval(reduction), axes)
