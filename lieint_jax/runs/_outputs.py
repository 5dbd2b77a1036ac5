"""States at given output times: whole steps, and before each output a shorter one from the last node before it.

They are one loop over rows of equally many entries, of which the last leads to an output, and all others are whole
steps or nothing. So the loop stores few rows more than there are outputs, whatever the gaps between them.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import native
from lieint_jax._xla import compiled
from lieint_jax.runs._clock import GridClock, RoundedClock, UniformClock
from lieint_jax.runs._driver import Reached, at_start, prepared
from lieint_jax.types import State, Step, StepInfo


class _Entry(NamedTuple):
    """An entry of a row.

    Attributes:
        whole, last: whether it is a whole step, and one to an output; or nothing.
        t, dt: the time of its node, and the size of its step.
    """

    whole: Array
    last: Array
    t: Array
    dt: Array


@partial(compiled, static_argnums=4)
def at_output_times(
    step: Step, state: State, clock: UniformClock | RoundedClock | GridClock, save_at: Array, num_steps: int
) -> Reached:
    """The states at output times, without these, and the reports of the steps since the output before."""
    span = clock.time(num_steps) - clock.time(0)
    inside = jnp.abs(save_at - clock.time(0) - span / 2) <= jnp.abs(span) / 2 * (1 + 1e-12)  # False for NaN
    own = clock.node(jnp.where(inside, save_at, clock.time(0)), num_steps)
    nodes = lax.cummax(own)
    entries, rows, length = _entries(clock, save_at, nodes, num_steps)
    whole, has_time = prepared(step, state, clock), state.t is not None

    def step_once(_: Array, at: Reached, x: _Entry) -> tuple[Reached, Reached]:
        here = at[0]._replace(t=x.t if has_time else None)
        dt = clock.dt if isinstance(clock, UniformClock) else x.dt

        def advanced(step: Step, dt: Array) -> Reached:
            end, info = step(here, dt)
            return end._replace(t=None), at[1].merge(info)

        after = lax.cond(x.whole, lambda: advanced(whole, dt), lambda: at)
        output = lax.cond(x.last, lambda: advanced(step, x.dt), lambda: after)
        following = after[0], jax.tree.map(partial(jnp.where, x.last), StepInfo.empty(state.p), after[1])
        return following, output

    start, count = at_start(state._replace(t=None)), len(entries.t) // length
    found = native.march(step_once, start, entries, rows=count, every=length)[1]
    later, info = jax.tree.map(lambda x: x[rows], found)
    return later, info._replace(converged=info.converged & inside & (own == nodes))  # else traced times are unordered


def _entries(
    clock: UniformClock | RoundedClock | GridClock, save_at: Array, nodes: Array, num_steps: int
) -> tuple[_Entry, Array, int]:
    """The entries of all rows, the row of each output, and the number of entries of a row.

    Args:
        clock, save_at, num_steps: see `at_output_times`.
        nodes: the last node before each output.
    """
    count = save_at.size
    length = max(1, -(-num_steps // max(count, 1))) + 1
    steps = jnp.diff(nodes, prepend=0)
    rows = jnp.cumsum(steps // length + 1) - 1
    size = length * (count + num_steps // length)
    n = jnp.arange(num_steps)
    output = jnp.cumsum(jnp.zeros(num_steps + 1, int).at[nodes].add(1))[:-1]  # to which the step from node n leads
    before = jnp.concatenate([jnp.zeros(1, rows.dtype), rows + 1])[output] * length
    place = before + n - jnp.concatenate([jnp.zeros(1, nodes.dtype), nodes])[output]
    place = jnp.where(output < count, place, size)  # beyond the end where no output follows

    def spread(nothing: ArrayLike, of_steps: ArrayLike, of_outputs: ArrayLike) -> Array:
        found = jnp.full(size, nothing).at[place].set(of_steps, mode="drop")
        return found.at[rows * length + length - 1].set(of_outputs)

    entries = _Entry(
        spread(False, True, False),
        spread(False, False, True),
        spread(clock.time(0), clock.time(n), clock.time(nodes)),
        spread(clock.size(0), clock.size(n), save_at - clock.time(nodes)),
    )
    return entries, rows, length
