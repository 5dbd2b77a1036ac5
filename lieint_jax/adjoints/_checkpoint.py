"""Runs whose reverse-mode derivative stores states at nested checkpoints and recomputes the steps between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._integrate import Body, Clock, Progress, march, prepared, step_at_node
from lieint_jax._xla import compiled, rematerialized
from lieint_jax.types import State, Step, StepInfo
from lieint_jax.types.shapes import PyTree

LEVELS = 3  # of nested checkpoints, by default: about 3 N^(1/3) of N states are stored


@partial(compiled, static_argnums=(3, 4))
def checkpointed(
    step: Step, state: State, clock: Clock, counts: tuple[int, ...], levels: int = LEVELS
) -> tuple[State, StepInfo]:
    """The states after counts[0], counts[0] + counts[1], … steps, and the reports in between.

    One loop is compiled for all intervals, a little longer than the longest.
    """
    advance_once = partial(step_at_node, prepared(step, state, clock), clock)
    repeat = partial(_nested_steps, most=max(counts, default=0), levels=levels)

    def interval(carry: tuple[State, Array], count: Array) -> tuple[tuple[State, Array], tuple[State, StepInfo]]:
        state, done = carry
        end = march(advance_once, done, count, Progress.begin(state), repeat=repeat)
        return (end.state, done + count), (end.state, end.info)

    start = (state, jnp.zeros((), jnp.int32))
    return lax.scan(jax.checkpoint(interval), start, jnp.asarray(counts, jnp.int32))[1]


def _nested_steps(body: Body, first: Array, count: Array, carry: PyTree, most: int, levels: int) -> PyTree:
    """`count` steps, of at most `most`, in nested blocks; the results of surplus steps are discarded."""

    def step_once(numbered: tuple[Array, PyTree], _: None) -> tuple[tuple[Array, PyTree], None]:
        n, carry = numbered
        after = jax.tree.map(lambda new, old: jnp.where(n < first + count, new, old), body(n, carry), carry)
        return (n + 1, after), None

    return _in_blocks(step_once, (first, carry), most, levels)[1]


def _in_blocks(step_once: Callable[..., PyTree], carry: PyTree, length: int, levels: int) -> PyTree:
    """Apply `step_once` at least `length` times, in about length^(1/levels) nested blocks, each a checkpoint."""
    if levels == 1:
        return lax.scan(rematerialized(step_once), carry, None, length=length)[0]
    blocks = math.ceil(length ** (1 / levels))
    block = math.ceil(length / blocks) if blocks else 0

    def inner(carry: PyTree, _: None) -> tuple[PyTree, None]:
        return _in_blocks(step_once, carry, block, levels - 1), None

    return lax.scan(jax.checkpoint(inner), carry, None, length=blocks)[0]
