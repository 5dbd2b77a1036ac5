"""The loop over steps on which all runs are built: of one body or many, with output, events or derivatives.

`march` runs from node to node of a clock by `step_at_node`, in a loop of one of several kinds. `scanned` has
derivatives in forward and reverse mode. `counted` runs a number of steps that is known only at run time, so that one
program serves all lengths, but it has no derivative in reverse mode. Other modules define their own loops for nested
checkpoints, and for several steps per iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._integrate._clock import Clock, GridClock, at_time, uniform_clock
from lieint_jax._xla import rematerialized
from lieint_jax.types import State, Step, StepInfo

Tree = Any  # a tree of arrays
_Carry = TypeVar("_Carry")
Body = Callable[[Array, _Carry], _Carry]  # (n, carry at node n) ↦ carry at node n + 1
Repeat = Callable[[Body, Any, Any, Any], Any]  # (body, first node, number of steps, carry) ↦ carry


class Progress(NamedTuple):
    """The progress of a run.

    Attributes:
        state: the state at the last node.
        info: the merged report of the steps up to it.
        seen: what the run has recorded of these steps; None if nothing is recorded.
    """

    state: State
    info: StepInfo
    seen: Tree = None

    @classmethod
    def begin(cls, state: State, seen: Tree = None) -> Progress:
        """A run before its first step."""
        return cls(state, StepInfo.empty(state.p), seen)


def step_at_node(
    step: Callable[..., tuple[Any, ...]], clock: Clock, state: State, n: Array, *more: Array
) -> tuple[Any, ...]:
    """The step from node n, where `state` is: the state at the next node, and the step's report.

    Args:
        step: (state, dt, …) ↦ state, report, …: a step, or its `tangent`.
        clock, state, n: the times of the nodes, the state at node n, and n.
        more: further arguments of `step`, such as tangent vectors.
    """
    end, *report = step(state, clock.size(n), *more)
    return at_time(end, clock.time(n + 1)), *report


def scanned(body: Body, first: ArrayLike, count: int, carry: _Carry) -> _Carry:
    """`body` in a `lax.scan`, where reverse mode stores the carries and computes each step again."""

    @rematerialized
    def step_once(numbered: tuple[Array, _Carry], _: None) -> tuple[tuple[Array, _Carry], None]:
        n, carry = numbered
        return (n + 1, body(n, carry)), None

    return scan(step_once, (jnp.asarray(first), carry), count)[0][1]


def counted(body: Body, first: ArrayLike, count: ArrayLike, carry: _Carry) -> _Carry:
    """`body` in a `lax.fori_loop`, whose number of steps may be traced."""
    return lax.fori_loop(first, first + count, body, carry)


def scan(function: Callable[[_Carry, None], tuple[_Carry, Tree]], carry: _Carry, length: int) -> tuple[_Carry, Tree]:
    """`lax.scan`, without the loop where its length is 1: that is a third of the time of tracing."""
    if length != 1:
        return lax.scan(function, carry, None, length=length)
    carry, result = function(carry, None)
    return carry, jax.tree.map(lambda x: x[None], result)


def march(
    advance_once: Callable[[State, Array], tuple[State, StepInfo]],
    first: ArrayLike,
    count: ArrayLike,
    start: Progress,
    *,
    observe: Callable[[Array, Progress, Progress, StepInfo], Tree] | None = None,
    repeat: Repeat = scanned,
) -> Progress:
    """The run after `count` further steps.

    Args:
        advance_once: (state at node n, n) ↦ state at node n + 1 and report, such as
            `partial(step_at_node, step, clock)`.
        first: the node where the run is.
        count: the number of steps.
        start: the run there.
        observe: (n, the run before the step from node n, the run after it, the step's report) ↦ the new `seen`.
        repeat: the kind of the loop.
    """

    def step_once(n: Array, before: Progress) -> Progress:
        state, info = advance_once(before.state, n)
        after = Progress(state, before.info.merge(info), before.seen)
        return after if observe is None else after._replace(seen=observe(n, before, after, info))

    return repeat(step_once, first, count, start)


def steps(step: Step, state: State, dt: ArrayLike, count: ArrayLike) -> tuple[State, StepInfo]:
    """The state after `count` steps, which may be traced, and the merged report of the steps."""
    clock = uniform_clock(step, state, jnp.asarray(dt, state.p.dtype))
    end = march(partial(step_at_node, step, clock), 0, count, Progress.begin(state), repeat=counted)
    return end.state, end.info


def prepared(step: Step, state: State, clock: Clock) -> Step:
    """The step with its constants computed in advance, if the clock has one step size."""
    return step if isinstance(clock, GridClock) else step.prepare(state, clock.dt)
