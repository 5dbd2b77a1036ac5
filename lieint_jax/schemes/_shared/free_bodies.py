"""The free motion of many rigid bodies: centers move on straight lines, and each body rotates freely."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics.arrays import Inertia
from lieint_jax.core import State, Step, StepInfo, pytree
from lieint_jax.systems._equations import AbstractFreeBodies, AbstractFreeBody


@pytree
class FreeFlight(Step):
    """The drift of a splitting: free rigid bodies, each rotated by `turn`, a step of one body, with its own inertia."""

    system: AbstractFreeBodies
    turn: Step

    @classmethod
    def with_step(cls, system: AbstractFreeBodies, step: Callable[[AbstractFreeBody], Step]) -> FreeFlight:
        """The drift by the step of a scheme for one body."""
        return cls(system, step(system.single_body(system.inertias)))

    @property
    def order(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.turn.order

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.turn.symmetric

    @property
    def commuting(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.turn.commuting

    @property
    def name(self) -> str:
        return "free_flight" if self.commuting else f"free_flight[{self.turn.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        def rotate_body(J: Inertia, body: State) -> tuple[Array, StepInfo]:
            step: Any = self.turn
            own: Any = dataclasses.replace(step, system=dataclasses.replace(step.system, inertia=J))
            end, info = own.substep(body, dt)
            return end.q, info

        attitudes, info = jax.vmap(rotate_body)(self.system.inertias, State(state.q[:, 3:], state.p[:, 3:]))
        x = state.q[:, :3] + dt * (state.p[:, :3] / self.system.masses[:, None])
        together = StepInfo(jnp.max(info.residual), jnp.all(info.converged))
        return state._replace(q=jnp.concatenate([x, attitudes], axis=1)), together

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} lost its digits at dt = {dt}: a body rotates too far in a step, or there is a NaN or an "
            "infinity in the state or an inertia. Use a smaller dt"
        )
