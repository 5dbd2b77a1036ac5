"""What a chart offers: the unknowns in which explicit steps of a system are computed, and their rate."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.types import State, System, time_derivative


class Chart(abc.ABC):
    """Coordinates in which an explicit step adds up increments. They are a pytree of arrays, called the unknowns."""

    @abc.abstractmethod
    def supports(self, system: System) -> bool:
        """Whether a system has these coordinates, and its equations of motion are those of `rate`."""

    @abc.abstractmethod
    def unknowns(self, system: Any, state: State) -> Any:
        """The unknowns of a state."""

    @abc.abstractmethod
    def rate(self, system: Any) -> Callable[[Any, Any], Any]:
        """(unknowns, moment) ↦ their time derivative, for a moment of `stage_times`."""

    def stage_times(self, system: Any, state: State, passed: Array) -> Any:
        """What the rate needs of the times t + passed, (n, …) each; None where nothing depends on time."""
        return None

    @abc.abstractmethod
    def advance(self, system: Any, state: State, z: Any, delta: Any) -> State:
        """The state whose unknowns are z, after the increments delta."""

    @abc.abstractmethod
    def split_qp(self, z: Any) -> tuple[Sequence[Array], Sequence[Array]]:
        """The arrays of the configuration and those of the momentum, whose sizes are measured separately."""


class PlainState(Chart):
    """The states themselves, as the unknowns of any system."""

    def supports(self, system: System) -> bool:
        return True

    def unknowns(self, system: Any, state: State) -> State:
        return state

    def rate(self, system: Any) -> Callable[[State, Any], State]:
        return lambda state, _: time_derivative(system, state)

    def advance(self, system: Any, state: State, z: State, delta: State) -> State:
        return jax.tree.map(jnp.add, z, delta)

    def split_qp(self, z: State) -> tuple[Sequence[Array], Sequence[Array]]:
        return [z.q], [z.p]
