"""Runs whose reverse-mode derivative stores a few states, and computes the steps between them again."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._xla import compiled
from lieint_jax.runs import Body, Clock, Progress, counted, march, prepared, saved_states, step_at_node
from lieint_jax.types import State, Step, StepInfo
from lieint_jax.types.shapes import PyTree


@partial(compiled, static_argnums=(3,))
def checkpointed(step: Step, state: State, clock: Clock, counts: tuple[int, ...]) -> tuple[State, StepInfo]:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports in between.

    Unless all counts are equal, one loop for the longest serves all, and the results of surplus steps are discarded.
    """
    step = prepared(step, state, clock)
    if len(set(counts)) == 1 and counts[0]:
        return saved_states(step, state, clock, len(counts), counts[0])
    advance_once, most = partial(step_at_node, step, clock), max((1, *counts))

    def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, done = carry
        end = march(advance_once, done, most, Progress.begin(state), repeat=partial(_first_of, count))
        return (end.state, done + count), (end.state, end.info)

    start = (state, jnp.zeros((), jnp.int32))
    return lax.scan(jax.checkpoint(interval), start, jnp.asarray(counts, jnp.int32))[1]


def _first_of(wanted: Array, body: Body, first: Array, most: int, carry: PyTree) -> PyTree:
    """`wanted` steps, of at most `most`."""

    def step_once(n: Array, carry: PyTree) -> PyTree:
        is_wanted = n < jnp.asarray(first + wanted, n.dtype)
        return jax.tree.map(lambda new, old: jnp.where(is_wanted, new, old), body(n, carry), carry)

    return counted(step_once, first, most, carry)
