"""A kinetic energy and a force that depends on the configuration, constant in time or driven: what splittings take."""

from __future__ import annotations

import abc

from jax import Array

from lieint_jax._numerics.arrays import Scalar, Time
from lieint_jax.core import State, System, clock
from lieint_jax.systems._equations.equation import Equations, equation


class AbstractForcedSystem(Equations):
    """A system with a kinetic energy and a force that depends on the configuration: the kick of a splitting."""

    noun = "systems with a potential (systems.heavy_top, systems.potential_top, systems.group_potential, …)"

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its force."""

    @abc.abstractmethod
    def force(self, q: Array, /) -> Array:
        """π̇ at the configuration q less π̇ of the free system, an array of the shape of π."""

    @equation
    def vector_field(self, state: State) -> State:
        """That of the free system, and the force in π̇."""
        free = self.free.vector_field(state)
        return State(free.q, free.p + self.force(state.q))


class AbstractDrivenSystem(Equations):
    """A kinetic energy and a potential V(q, t) that depends on time in a given way.

    H − W is conserved, with the work W = ∫∂V/∂t dt.
    """

    noun = "systems with a potential of time (systems.driven_top, systems.gravity_gradient, …)"

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its potential."""

    @abc.abstractmethod
    def force(self, q: Array, t: Time, /) -> Array:
        """π̇ at the configuration q and the time t less π̇ of the free system, an array of the shape of π."""

    @abc.abstractmethod
    def power(self, q: Array, t: Time, /) -> Scalar:
        """∂V/∂t, a scalar."""

    @equation
    def vector_field(self, state: State) -> State:
        """That of the free system, the force in π̇, and the power as the rate of the work."""
        free, t = self.free.vector_field(state), clock(state)
        return State(free.q, free.p + self.force(state.q, t), work=self.power(state.q, t))
