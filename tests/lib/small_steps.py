"""Steps and a system of few operations, which compile in a moment: for tests of what is built around a step."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.core import State, Step, StepInfo, System, pytree, static
from lieint_jax.phase_spaces import CotangentMatrices


@pytree
class Rests(Step):
    """A step that leaves q and p as they are. As the drift of a splitting it leaves the kicks alone."""

    system: Any

    order, symmetric, name = 2, True, "rests"

    def advance(self, state, dt):
        return state, StepInfo.empty(state.p)

    def advance_tangents(self, state, dt, T):
        return state, StepInfo.empty(state.p), T


@pytree
class Paced(Step):
    """A step of size dt·σ(state) by another scheme, which advances the time itself: of order 1, not symmetric."""

    step: Step
    pace: Callable[[State], Array] = static()

    order, symmetric, own_time = 1, False, True

    @property
    def system(self):
        return self.step.system

    @property
    def name(self):
        return f"paced({self.step.name})"

    def start(self, state):
        return state if state.t is not None else state._replace(t=jnp.zeros((), state.p.dtype))

    def advance(self, state, dt):
        return self.step.substep(state, dt * self.pace(state))


@pytree
class Oscillators(System):
    """Nine oscillators F̈ = −kF on T*GL⁺(3), whose motion is linear."""

    stiffness: Array

    phase_space = CotangentMatrices()

    def energy(self, state):
        return (jnp.sum(state.p**2) + self.stiffness * jnp.sum(state.q**2)) / 2

    def momentum(self, state):
        return jnp.zeros(0)

    def vector_field(self, state):
        return State(state.p, -self.stiffness * state.q)

    def check(self, state):
        pass


@pytree
class Leapfrog(Step):
    """Half a kick, a drift and half a kick of `Oscillators`: symmetric, of order 2, and linear."""

    system: Oscillators

    order, symmetric, name = 2, True, "leapfrog"

    def advance(self, state, dt):
        kick = dt / 2 * self.system.stiffness
        p = state.p - kick * state.q
        q = state.q + dt * p
        return state._replace(q=q, p=p - kick * q), StepInfo.empty(state.p)


def leapfrog(stiffness, dt):
    """The matrix (2, 2) of a step of `Leapfrog` on a pair of entries of q and p, in any arithmetic."""
    kick, drift = np.array([[1, 0], [-dt / 2 * stiffness, 1]]), np.array([[1, dt], [0, 1]])
    return kick @ drift @ kick
