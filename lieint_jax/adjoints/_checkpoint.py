"""Runs whose reverse-mode derivative keeps the states at nested checkpoints and recomputes the steps between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._xla import compiled, rematerialized
from lieint_jax.types import State, Step, StepInfo, on_clock, start_time

_LEVELS = 3  # levels of nested checkpoints: about 3 N^(1/3) of N states are kept


@partial(compiled, static_argnums=3)
def checkpointed(step: Step, state: State, dt: Array, counts: tuple[int, ...]) -> tuple[State, StepInfo]:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports in between.

    One loop is compiled for all intervals, a little longer than the longest; results of surplus steps are dropped.
    """

    step, t0 = step.prepare(state, dt), start_time(step, state)

    def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, done = carry

        def step_once(carry: tuple[Array, State, StepInfo], _: None) -> tuple[tuple[Array, State, StepInfo], None]:
            k, state, so_far = carry
            after, info = step(state, dt)
            after = on_clock(after, t0, done + k + 1, dt)
            taken = jax.tree.map(
                lambda new, old: jnp.where(k < count, new, old), (after, so_far.merge(info)), carry[1:]
            )
            return (k + 1, *taken), None

        start = (jnp.zeros((), jnp.int32), state, StepInfo.fresh(state.p))
        _, state, info = _nested(step_once, start, max(counts, default=0), _LEVELS)
        return (state, done + count), (state, info)

    start = (state, jnp.zeros((), jnp.int32))
    return lax.scan(jax.checkpoint(interval), start, jnp.asarray(counts, jnp.int32))[1]


def _nested(one: Callable[..., Any], carry: Any, length: int, levels: int) -> Any:
    """Apply `one` at least `length` times, in about length^(1/levels) nested blocks, each a checkpoint."""
    if levels == 1:
        return lax.scan(rematerialized(one), carry, None, length=length)[0]
    blocks = math.ceil(length ** (1 / levels))
    block = math.ceil(length / blocks) if blocks else 0

    def inner(carry: Any, _: None) -> tuple[Any, None]:
        return _nested(one, carry, block, levels - 1), None

    return lax.scan(jax.checkpoint(inner), carry, None, length=blocks)[0]
