"""A particle on the sphere (Section 1)."""

from __future__ import annotations

import abc

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Scalar, Vector3
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax.core import State
from lieint_jax.phase_spaces import CotangentSphere
from lieint_jax.systems._equations.equation import Equations, equation

_PHASE_SPACE = CotangentSphere()


class AbstractSphereSystem(Equations):
    """A particle on the unit sphere, on T*S²: q̇ = π × q/m, π̇ = −q × ∇V(q) (1.4).

    Attributes:
        mass: m.
    """

    noun = "pendulums (systems.pendulum)"
    mass: Array

    @property
    def phase_space(self) -> CotangentSphere:
        return _PHASE_SPACE

    @abc.abstractmethod
    def potential(self, q: Vector3, /) -> Scalar:
        """V(q), smooth around the sphere too."""

    @equation
    def velocity(self, state: State) -> Vector3:
        """q̇ = π × q/m, shape (3,)."""
        return jnp.cross(state.p, state.q) / self.mass

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (π × q/m, −q × ∇V(q))."""
        return State(self.velocity(state), -jnp.cross(state.q, autodiff_gradient(self.potential)(state.q)))
