"""The central difference method (Störmer–Verlet) for pseudo-rigid bodies on T*GL⁺(3): kick, drift, kick.

    P ← P − ½Δt F S,  S = 2∇W(FᵀF),    F ← F + Δt P E⁻¹,    P ← P − ½Δt F S

F S Fᵀ and P E⁻¹Pᵀ are symmetric, so neither a kick nor a drift changes rot[PFᵀ].
"""

from __future__ import annotations

import jax.numpy as jnp
from jax.typing import ArrayLike

from lieint_jax.capabilities import AbstractElasticBody
from lieint_jax.types import State, Step, StepInfo, pytree, static
from lieint_jax.types.vectors import matrix


@pytree
class ElasticSplitting(Step):
    """The step that `splitting` makes for a pseudo-rigid body.

    Attributes:
        system: an elastic body.
    """

    system: AbstractElasticBody
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return "splitting"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state = self._kick(state, dt)
        F = state.q + dt * self.system.vector_field(state).q
        return self._kick(state._replace(q=F), dt), StepInfo(jnp.zeros((), F.dtype), matrix(F).det() > 0)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return f"{self.name} inverts the body (det F ≤ 0) at dt = {dt}: use a smaller dt, or schemes.additive"

    def _kick(self, state: State, dt: ArrayLike) -> State:
        return state._replace(p=state.p + 0.5 * dt * self.system.vector_field(state).p)
