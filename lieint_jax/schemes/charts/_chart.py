"""The interface of charts: the unknowns in which steps of a system are computed, and their rate."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.core import State, System, time_derivative
from lieint_jax.groups import so3
from lieint_jax.systems._equations import AbstractRigidBodies

_System = TypeVar("_System", bound=System)
_Unknowns = TypeVar("_Unknowns")


class Chart(abc.ABC, Generic[_System, _Unknowns]):
    """Coordinates in which a step adds up increments. They are a pytree of arrays, called the unknowns."""

    @abc.abstractmethod
    def supports(self, system: System) -> bool:
        """Whether a system has these coordinates, and its equations of motion are those of `rate`."""

    @abc.abstractmethod
    def unknowns(self, system: _System, state: State) -> _Unknowns:
        """The unknowns of a state."""

    @abc.abstractmethod
    def rate(self, system: _System) -> Callable[[_Unknowns, PyTree], _Unknowns]:
        """(unknowns, moment) ↦ their time derivative, for a moment of `stage_times`."""

    def stage_times(self, system: _System, state: State, passed: Array) -> PyTree:
        """The times t + passed, and what the rate needs of them, (n, …) each; None where nothing depends on time."""
        return None

    @abc.abstractmethod
    def apply(self, system: _System, state: State, z: _Unknowns, delta: _Unknowns) -> State:
        """The state whose unknowns are z, after the increments delta."""

    @abc.abstractmethod
    def split_qp(self, z: _Unknowns) -> tuple[Sequence[Array], Sequence[Array]]:
        """The arrays of the configuration and those of the momentum, whose sizes are measured separately."""


class PlainState(Chart[System, State]):
    """The states themselves, as the unknowns of any system."""

    def supports(self, system: System) -> bool:
        return True

    def unknowns(self, system: System, state: State) -> State:
        return state

    def rate(self, system: System) -> Callable[[State, PyTree], State]:
        return lambda state, _: time_derivative(system, state)

    def apply(self, system: System, state: State, z: State, delta: State) -> State:
        return jax.tree.map(jnp.add, z, delta)

    def split_qp(self, z: State) -> tuple[Sequence[Array], Sequence[Array]]:
        return [z.q], [z.p]


class SeveralBodies(PlainState):
    """The states of several bodies, whose quaternions are of unit length after a step."""

    def supports(self, system: System) -> bool:
        return AbstractRigidBodies.governs(system)

    def apply(self, system: System, state: State, z: State, delta: State) -> State:
        end = super().apply(system, state, z, delta)
        turned = jax.vmap(so3.normalize)(end.q[:, 3:])
        return end._replace(q=jnp.concatenate([end.q[:, :3], turned], axis=1))
