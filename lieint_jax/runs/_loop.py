"""The compiled loop of a run over the save intervals of all members, and its data."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from platform import machine
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import jaxpr_as_fun

from lieint_jax import native
from lieint_jax._xla import compiled, remembered, rereading_jit
from lieint_jax.core import State, Step, StepInfo, energy_less_work
from lieint_jax.runs._clock import Clock, at_time
from lieint_jax.runs._devices import Numbers, Tree, on_host
from lieint_jax.runs._digests import OfMember
from lieint_jax.runs._driver import prepared

Reduction = Callable[[Step, State], Array]
Axes = Any  # the member axes of a function's arguments, as in `jax.vmap`


class Change(NamedTuple):
    """What is known of a reduced quantity, for one member, or with the member axis first.

    Of all members together, these are its changes from the start over the steps since the last save; reduced for each
    member, its values over all steps so far, the start included.

    Attributes:
        least, greatest, total: the least, the greatest and the sum of them.
        excess: what rounding has added to the sum so far, which the next value is added less by.
        last: the last value of each member; None of all members together.
        first: the first time at which a condition was true, NaN before; None if there is no condition.
    """

    least: Numbers
    greatest: Numbers
    total: Numbers
    excess: Numbers
    last: Numbers | None = None
    first: Numbers | None = None

    @property
    def per_member(self) -> bool:
        """Whether it is reduced for each member."""
        return self.last is not None

    @classmethod
    def empty(cls, like: Numbers) -> Change:
        """The change over no steps."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), *[jnp.zeros_like(like)] * 2)

    def include(self, x: Array, reached: Array | None = None, t: Numbers | None = None) -> Change:
        """The change with one more value, at time t, when the condition is `reached` or not.

        If the value is NaN, so are all but `first`. The sum is Kahan's: by plain additions, the mean of 10⁷ values in
        float32 is off by up to a tenth.
        """
        first = self.first
        if first is not None and reached is not None and t is not None:
            first = jnp.where(jnp.isnan(first) & reached, t.astype(first.dtype), first)
        least, greatest = jnp.minimum(self.least, x), jnp.maximum(self.greatest, x)
        added = x - self.excess
        total = self.total + added
        excess = (total - self.total) - added
        excess = jnp.where(jnp.isfinite(excess), excess, 0)  # of infinite values it is NaN
        return Change(least, greatest, total, excess, x if self.per_member else None, first)


class Carry(NamedTuple):
    """The values that a run carries from one step to the next, for one member, or with the member axis first.

    Attributes:
        state: the states.
        info: the merged `StepInfo` since the last save.
        failed: the first step that did not converge, or −1.
        change: of the reduced quantity; None if nothing is reduced.
    """

    state: State
    info: StepInfo
    failed: Array
    change: Change | None


class Given(NamedTuple):
    """What is the same in all steps of a run.

    Attributes:
        step: the step; with its constants for steps of one size if the run prepares it.
        plain: the step without them, for shorter steps to outputs; None if it is the same step.
        clock: the times of the steps, in which t₀ is that of the member if members start at different times.
        quantity: the reduced quantity of the initial states; None if nothing is reduced.
    """

    step: Step
    plain: Step | None
    clock: Clock
    quantity: Numbers | None


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


def _first_failure(failed: Array, n: Numbers, info: StepInfo) -> Array:
    """The first step that failed, after that from node n with such a report."""
    return jnp.where((failed < 0) & ~info.converged, n.astype(failed.dtype), failed)


def start(states: State, change: Change | None) -> Carry:
    """The carry of a run that begins with `states`, arrays of the host."""
    members, dtype = states.p.shape[0], states.p.dtype
    info = StepInfo(np.zeros(members, dtype), np.ones(members, bool))  # pyright: ignore[reportArgumentType]
    return Carry(states, info, np.full(members, -1, step_dtype()), change)  # pyright: ignore[reportArgumentType]


def shapes_of_interval(state: State, has_rest: bool) -> tuple[Carry, Span]:
    """The shapes of the carry and of an interval of a member that starts at `state`, in a run without `reduce`."""

    def number(dtype: Any) -> Any:
        return jax.ShapeDtypeStruct((), dtype)

    n, flag, size = number(step_dtype()), number(np.bool_), number(state.p.dtype)
    return Carry(state, StepInfo(size, flag), n, None), Span(n, n, size if has_rest else None, flag)


def axes_of_leaves(axes: Axes, arguments: Tree) -> list[int | None]:
    """The member axis of each leaf of arguments, from such axes as `jax.vmap` has."""
    found: list[int | None] = []
    jax.tree.map(
        lambda axis, part: found.extend([axis] * len(jax.tree.leaves(part))),
        axes,
        arguments,
        is_leaf=lambda x: x is None,
    )
    return found


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


@remembered(32)
def of_members(function: Reduction | None, axes: Axes) -> Callable[[Given, State], Tree]:
    """A function of step and state, compiled for all members: (given, states) ↦ its values.

    Without a function it is the step with its constants. `axes` are the member axes of what is given.
    """

    def of_member(given: Given, state: State) -> Tree:
        return prepared(given.step, state, given.clock) if function is None else function(given.step, state)

    def by_one_step(*arguments: Tree) -> Tree:
        found = native.march(lambda n, carry, _: (carry, of_member(*arguments)), (), rows=1)[1]
        return jax.tree.map(lambda x: x[0], found)

    return rereading_jit(jax.vmap(by_one_step, (axes, 0)), compiler_options=compiler_options())


@dataclass
class Learned:
    """What engines have found out of a loop.

    Attributes:
        engines: by their names, why they cannot compute it ("" if they can), and about how many numbers of a step the
            members then share.
        equations: the digest of its equations.
    """

    engines: dict[str, tuple[str, int]]
    equations: str | None = None


# Beside the loops, not their attributes: a program is made again where what its function reads has changed, and the
# interval that a loop compiles reads the loop.
_learned: weakref.WeakKeyDictionary[MemberLoop, Learned] = weakref.WeakKeyDictionary()


class MemberLoop:
    """The loop over the save intervals of all members.

    The saved values are the report, and the states or the change of the reduced quantity. `native.make_once` makes it
    once for data of one member of the same shapes.

    Args:
        what: the reduced quantity or None; and of a run that is reduced for each member, a condition of which the first
            time is recorded at which it is true.
        axes: the member axes of the carry and of what is given, as in `jax.vmap`.

    Attributes:
        of_all: (carry, given, spans, number of spans) ↦ (carry, saved), compiled.
    """

    def __init__(self, what: tuple[Reduction | None, Reduction | None], axes: Axes, _: Sequence[Tree]):
        self._reduction, self._condition = what
        self._axes = axes
        self._of_member = jax.jit(self._interval)
        self.of_all = jax.jit(jax.vmap(self._loop, (*axes, None, None), (0, 1)), compiler_options=compiler_options())
        _learned[self] = Learned({})

    @property
    def learned(self) -> Learned:
        """What engines have found out of it."""
        return _learned[self]

    def _loop(self, carry: Carry, given: Given, spans: Span, count: Array) -> tuple[Carry, Tree]:
        return native.march(self._of_member, carry, spans, (given,), rows=count, most=len(spans.first))

    def _interval(self, _: Array, carry: Carry, span: Span, given: Given) -> tuple[Carry, Tree]:
        """A save interval of one member."""
        step, clock, change = given.step, given.clock, carry.change
        fresh = StepInfo.empty(carry.info.residual), change
        if change is not None and not change.per_member:
            fresh = fresh[0], Change.empty(change.total)
        info, change = jax.tree.map(
            lambda new, old: jnp.where(span.begins, new, old), fresh, (carry.info, carry.change)
        )

        def at_node(n: Numbers, state: State) -> State:
            # Its time is computed from n: where members share it, what depends on it alone is computed once for all.
            return state if state.t is None else at_time(state, clock.time(n))

        def step_once(n: Array, carry: tuple[Carry, Tree]) -> tuple[Carry, Tree]:
            at, known = carry
            end, info, known = step.continued(at_node(n, at.state), clock.size(n), known)
            end, failed = at_node(n + 1, end), _first_failure(at.failed, n, info)
            return Carry(end, at.info.merge(info), failed, self._changed(n + 1, end, at.change, given)), known

        start = carry._replace(info=info, change=change), step.known_at(at_node(span.first, carry.state))
        after, _ = lax.fori_loop(span.first, span.end, step_once, start)
        output, worst, failed = after.state, after.info, after.failed
        if span.rest is not None:
            plain = step if given.plain is None else given.plain
            output, last = plain(at_node(span.end, after.state), span.rest)
            worst, failed = worst.merge(last), _first_failure(failed, span.end, last)
        saved = output if step.own_time else output._replace(t=None)  # the plan knows the times of all saves
        return after._replace(failed=failed), (worst, saved if self._reduction is None else after.change)

    def _changed(self, n: Array, state: State, change: Change | None, given: Given) -> Change | None:
        """What is known of the reduced quantity at node n, where `state` is."""
        if self._reduction is None or change is None or given.quantity is None:
            return change
        value = self._reduction(given.step, state)
        if not change.per_member:
            return change.include(value - given.quantity)
        reached = None if self._condition is None else self._condition(given.step, state)
        return change.include(value, reached, given.clock.time(n) if state.t is None else state.t)

    def traced(self, carry: Carry, span: Span, given: Given) -> OfMember:
        """The program of an interval of a member, from arguments or their shapes."""
        arguments = np.zeros((), step_dtype()), carry, span, given
        axes = axes_of_leaves((None, self._axes[0], None, self._axes[1]), arguments)
        return OfMember(self._of_member.trace(*arguments).jaxpr, [axis is not None for axis in axes])

    def by_xla(self, members: Iterable[tuple[Carry, Given, Span]]) -> list[tuple[Carry, Tree]]:
        """(carry, saved) after one interval of each of these members, by one program of XLA."""
        arguments = [(np.zeros((), step_dtype()), carry, span, given) for carry, given, span in members]
        arguments = jax.tree.map(on_host, arguments)  # of no weak types, as in a loop: JAX traces it once
        traced = self._of_member.trace(*arguments[0])
        structure, interval = jax.tree.structure(traced.out_info), compiled(jaxpr_as_fun(traced.jaxpr), once=True)
        with native.engine("xla"):
            return [jax.tree.unflatten(structure, interval(*jax.tree.leaves(x))) for x in arguments]
