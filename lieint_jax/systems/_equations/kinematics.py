"""Motions on a group with a given rate: an attitude from a gyro, a spin in a given field."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import AlgebraVector, Time
from lieint_jax.core import Group, State, clock
from lieint_jax.phase_spaces import ConfigurationGroup
from lieint_jax.systems._equations.equation import Equations, equation


class AbstractKinematics(Equations):
    """A motion with a given rate: q̇ = qω̂(t) if the rate is that of the body, q̇ = ω̂(t)q if it is given in space.

    States have a time and no momenta. There is no energy, which is NaN, no momentum map and no symplectic form.

    Attributes:
        group: the group G.
        rate: ω, t ↦ (d,) in the basis of the algebra.
        frame: "body" or "space".
    """

    noun = "motions with given rates (systems.kinematics)"
    hamiltonian: ClassVar[bool] = False
    group: Group
    rate: Callable[[Array], Array]
    frame: Literal["body", "space"]

    @property
    def phase_space(self) -> ConfigurationGroup:
        return ConfigurationGroup(self.group)

    def energy(self, state: State) -> Array:
        """NaN: there is none."""
        return jnp.full((), jnp.nan, state.q.dtype)

    def momentum(self, state: State) -> Array:
        """None, shape (0,)."""
        return state.p

    def mean_rate(self, t: Time, h: Time) -> AlgebraVector:
        """The mean of the rate from t to t + h, by its method `mean(t, h)` if it has one, else ω(t + ½h), (d,)."""
        mean = getattr(self.rate, "mean", None)
        return jnp.asarray(self.rate(t + h / 2) if mean is None else mean(t, h), h.dtype)

    @equation
    def vector_field(self, state: State) -> State:
        """q̇ = qω̂(t), or ω̂(t)q in space."""
        move = self.group.tangent if self.frame == "body" else self.group.spatial_tangent
        return State(move(state.q, jnp.asarray(self.rate(clock(state)), state.q.dtype)), state.p)
