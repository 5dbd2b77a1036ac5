"""The functions of step and state whose values along a run it reports, and their compilation for all of its states."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
from jax import Array

from lieint_jax.types import State, Step, periods_of


@lru_cache(16)
def compile_map(structure: Any, batch: bool, own_step: bool) -> Callable[..., Any]:
    """A function of step and state of this structure, compiled for all states of a run."""

    def map_states(numbers: list[Array], step: Step, states: State) -> Any:
        function: Any = jax.tree.unflatten(structure, numbers)
        if batch:
            function = jax.vmap(function, (0 if own_step else None, 0))
        return jax.vmap(function, (None, 0))(step, states)

    return jax.jit(map_states)


def momentum(step: Step, state: State) -> Array:
    return step.system.momentum(state)


def defect(step: Step, state: State) -> Array:
    return step.system.phase_space.defect(state)


def periods(step: Any, state: State) -> Any:
    return periods_of(step.system, state)


def from_start(series: Array) -> Array:
    return series - series[:1]


def plain(function: Any) -> Any:
    """A function as it was given, without the pytree that has no leaves."""
    partial = isinstance(function, jax.tree_util.Partial) and not (function.args or function.keywords)
    return function.func if partial else function
