"""Runs whose reverse-mode derivative stores a few states, and computes the steps between them again."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._xla import compiled
from lieint_jax.runs import Clock, Reached, at_start, counted, prepared, reported, saved_states
from lieint_jax.types import State, Step


@partial(compiled, static_argnums=(3,))
def checkpointed(step: Step, state: State, clock: Clock, counts: tuple[int, ...]) -> Reached:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports in between.

    Unless all counts are equal, one loop for the longest serves all, and the results of surplus steps are discarded.
    """
    step = prepared(step, state, clock)
    if len(set(counts)) == 1 and counts[0]:
        states, info = saved_states(step, state, clock, len(counts), counts[0])
        if state.t is not None and states.t is None:
            states = states._replace(t=clock.time(counts[0] * (1 + jnp.arange(len(counts)))))
        return states, info
    step_once, most = reported(step, clock), max((1, *counts))

    def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], Reached]:
        state, done = carry

        def step_if_wanted(n: Array, at: Reached) -> Reached:
            is_wanted = n < jnp.asarray(done + count, n.dtype)
            return jax.tree.map(lambda new, old: jnp.where(is_wanted, new, old), step_once(n, at), at)

        reached = counted(step_if_wanted, done, most, at_start(state))
        return (reached[0], done + count), reached

    start = (state, jnp.zeros((), jnp.int32))
    return lax.scan(jax.checkpoint(interval), start, jnp.asarray(counts, jnp.int32))[1]
