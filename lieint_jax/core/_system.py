"""The functions that every Hamiltonian system has."""

from __future__ import annotations

import abc
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import MomentumMap, Scalar
from lieint_jax.core._group import PhaseSpace
from lieint_jax.core._law import Law
from lieint_jax.core._state import State

__all__ = ["System", "energy_less_work", "time_derivative"]


class System(abc.ABC):
    """A system: the functions that every scheme and every diagnostic may call.

    Attributes:
        hamiltonian: whether it has an energy and a symplectic form; all have, except motions with given rates.
        default_drift: a name in `schemes`: what makes the drift of `schemes.splitting`, if the user gives none, of this
            free system, or of a system whose free system declares another; "" if none is declared.
    """

    hamiltonian: ClassVar[bool] = True
    default_drift: ClassVar[str] = ""

    @property
    def domain(self) -> str:
        """Where its potential is defined, in words; "" if everywhere."""
        return ""

    @property
    @abc.abstractmethod
    def phase_space(self) -> PhaseSpace:
        """Its phase space, which has the symplectic form."""

    @abc.abstractmethod
    def energy(self, state: State, /) -> Scalar:
        """H, a scalar."""

    @abc.abstractmethod
    def momentum(self, state: State, /) -> MomentumMap:
        """The momentum map of the known symmetries, (k,); (0,) if there are none."""

    @abc.abstractmethod
    def vector_field(self, state: State, /) -> State:
        """The time derivative of a state."""

    @abc.abstractmethod
    def check(self, state: State, /) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""

    def sampled(self, state: State, dt: Array, /) -> tuple[State, Array | bool]:
        """The state that a step of dt begins with, where a controller has sampled it, and whether dt suits the samples.

        By default nothing is sampled.
        """
        return state, True

    @property
    def initial_extra(self) -> dict[str, Array] | None:
        """The arrays that the states of this system have in `extra`, at rest; None if there are none."""
        return None

    def terms(self) -> dict[str, System]:
        """Systems with one of a user's functions each, by what messages call it; empty if they are not told apart."""
        return {}

    @property
    def laws(self) -> tuple[Law, ...]:
        """Its laws of torque, by default none."""
        return ()


def time_derivative(system: System, state: State) -> State:
    """The time derivative of all fields of a state: 1 for t, and 0 for what the system does not move."""
    moving, rest = system.vector_field(state), jax.tree.map(jnp.zeros_like, state)
    pairs = zip(State._fields, moving, state, strict=True)
    moved = {name: x for name, x, own in pairs if x is not None and own is not None}
    return rest._replace(**moved | ({} if state.t is None else {"t": jnp.ones_like(state.t)}))


def energy_less_work(system: System, state: State) -> Scalar:
    """H − W, a scalar, which is conserved: W is `state.work` or the sum of the laws' works, 0 if none is counted."""
    energy, work, works = system.energy(state), state.work, (state.extra or {}).get("works")
    if work is None and works is not None:
        work = jnp.sum(works, axis=-1)
    return energy if work is None else energy - work
