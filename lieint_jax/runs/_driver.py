"""The loop over steps on which all runs are built: of one body or many, with output, events or derivatives.

`saved_states` makes a trajectory, in machine code (`native.march`). `reported` goes from node to node of a clock, in a
loop of one of two kinds: `counted`, in machine code, may run a number of steps that is known only at run time, so that
one program serves all lengths, but then it has no derivative in reverse mode; `scanned`, by XLA, is for runs that
record into arrays. Ensembles define their own loop, of several steps per iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import native
from lieint_jax._xla import rematerialized, with_common_mesh
from lieint_jax.core import State, Step, StepInfo, Trajectory
from lieint_jax.runs._clock import Clock, GridClock, at_time, uniform_clock

Tree = Any  # a tree of arrays
_Carry = TypeVar("_Carry")
Body = Callable[[Array, _Carry], _Carry]  # (n, carry at node n) ↦ carry at node n + 1
Reached = tuple[State, StepInfo]  # the state at a node, and the merged report of the steps that led there


def step_at_node(
    step: Callable[..., tuple[Any, ...]], clock: Clock, state: State, n: Array, *more: Array
) -> tuple[Any, ...]:
    """The step from node n, where `state` is: the state at the next node, and the step's report.

    Args:
        step: (state, dt, …) ↦ state, report, …: a step, or its `continued` or `tangent`.
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

    return lax.scan(step_once, (jnp.asarray(first), carry), None, length=count)[0][1]


def counted(body: Body, first: ArrayLike, count: ArrayLike, carry: _Carry) -> _Carry:
    """`body` in a loop whose number of steps may be traced."""

    def step(k: Array, carry: _Carry, _: None) -> tuple[_Carry, None]:
        return body(jnp.asarray(first, k.dtype) + k, carry), None

    return native.march(step, carry, rows=1, every=count)[0]


def at_start(state: State) -> Reached:
    """A run before its first step."""
    return state, StepInfo.empty(state.p)


def reported(step: Callable[..., tuple[Any, ...]], clock: Clock) -> Body:
    """The body of a loop over steps at the nodes of a clock, whose carry is a `Reached`."""

    def step_once(n: Array, at: Reached) -> Reached:
        end, info = step_at_node(step, clock, at[0], n)
        return end, at[1].merge(info)

    return step_once


def saved_states(
    step: Step, state: State, clock: Clock, num_saves: ArrayLike, save_every: ArrayLike, most: int | None = None
) -> Reached:
    """The states after every `save_every` steps, and the reports of the steps between them.

    Forward mode, and reverse mode, which stores the states before about 2√N of N steps, are in machine code too. With
    `most`, the length of the rows, of which those beyond `num_saves` are undefined, the two numbers may be traced; then
    there is no reverse mode. States have no time that follows from the number of steps: members may share it.
    """
    nodes = None
    if isinstance(clock, GridClock) and most is None:
        nodes = clock.times[:-1], clock.times[1:] - clock.times[:-1]
    timed = state.t is not None and (isinstance(clock, GridClock) or clock.t0 is not None)

    def step_once(
        n: Array, carry: tuple[Reached, Tree], node: tuple[Array, Array] | None
    ) -> tuple[tuple[Reached, Tree], Reached]:
        (at, so_far), known = carry
        t, size = (clock.time(n), clock.size(n)) if node is None else node
        end, info, known = step.continued(at._replace(t=t) if timed else at, size, known)
        reached = without_time(end), info_since(n, save_every, so_far, info)
        return (reached, known), reached

    def without_time(state: State) -> State:
        return state._replace(t=None) if timed else state

    known = None
    if step.reuses:  # in machine code at the start too
        found = native.scan(lambda state, _: (state, step.known_at(state)), state, length=1)[1]
        known = jax.tree.map(lambda x: x[0], found)
    start = at_start(without_time(state)), known
    return native.march(step_once, start, nodes, rows=num_saves, every=save_every, most=most)[1]


def join_start(state: State, later: Reached, t: Array | None) -> Trajectory:
    """The trajectory of an initial state, and of later states and reports.

    `t` are the times of all, which states without a time do not have, and `later` may lack.
    """
    states, info = later
    if state.t is not None and states.t is None and t is not None:
        states = states._replace(t=t[1:])
    start = at_start(state)
    start, later = with_common_mesh((start, (states, info)))
    states, info = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, later)
    times = t if states.t is None else states.t
    assert times is not None  # a state or a clock has the time
    return Trajectory(times, states, info)


def info_since(n: Array, every: ArrayLike, so_far: StepInfo, info: StepInfo) -> StepInfo:
    """The merged report of the steps since the last multiple of `every`: those before step n, and step n."""
    fresh = StepInfo.empty(info.residual)
    before = jax.tree.map(lambda new, old: jnp.where(n % every == 0, new, old), fresh, so_far)
    return (fresh if isinstance(every, int) and every == 1 else before).merge(info)


def steps(step: Step, state: State, dt: ArrayLike, count: ArrayLike) -> Reached:
    """The state after `count` steps, which may be traced, and the merged report of the steps."""
    clock = uniform_clock(step, state, jnp.asarray(dt, state.p.dtype))
    return counted(reported(step, clock), 0, count, at_start(state))


def prepared(step: Step, state: State, clock: Clock) -> Step:
    """The step with its constants computed in advance, if the clock has one step size."""
    return step if isinstance(clock, GridClock) else step.prepare(state, clock.dt)
