"""The free motion of many rigid bodies: centers move on straight lines, and each body rotates freely."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax.groups import so3
from lieint_jax.schemes._shared.accepts import AcceptedSystems
from lieint_jax.types import AbstractFreeBodies, AbstractFreeBody, AbstractRigidBodies, State, Step, StepInfo, pytree
from lieint_jax.types.shapes import Inertia, Poses, Quaternion, Vector3
from lieint_jax.types.vectors import symmetric


def free_motion(bodies: AbstractFreeBodies | AbstractRigidBodies, state: State) -> Poses:
    """q̇ of bodies, (N, 7): ẋ = p/m and Λ̇ = ΛΩ̂."""

    def attitude_rate(J: Inertia, q: Quaternion, spin: Vector3) -> Quaternion:
        return so3.tangent(q, jnp.stack(symmetric(J).solve(so3.Ad_star(q, spin))))

    rates = jax.vmap(attitude_rate)(bodies.inertias, state.q[:, 3:], state.p[:, 3:])
    return jnp.concatenate([state.p[:, :3] / bodies.masses[:, None], rates], axis=1)


def _motion(bodies: AbstractFreeBodies, state: State) -> State:
    """The vector field of free bodies."""
    return State(free_motion(bodies, state), jnp.zeros_like(state.p))


MANY_FREE_BODIES = AcceptedSystems(AbstractFreeBodies, "free rigid bodies (systems.rigid_bodies(...).free)", _motion)


@pytree
class FreeFlight(Step):
    """The drift of a splitting: free rigid bodies, each rotated by a step of one body.

    Attributes:
        system: free rigid bodies.
        turn: a step of one free rigid body, which is applied with the inertia of each.
    """

    system: AbstractFreeBodies
    turn: Step

    @classmethod
    def from_scheme(
        cls, scheme: str, system: AbstractFreeBodies, step: Callable[[AbstractFreeBody], Step]
    ) -> FreeFlight:
        """The drift by the step of a scheme for one body."""
        MANY_FREE_BODIES.check(scheme, system)
        return cls(system, step(system.single_body(system.inertias)))

    @property
    def order(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.turn.order

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.turn.symmetric

    @property
    def commuting(self) -> bool:
        return self.turn.commuting

    @property
    def name(self) -> str:
        return "free_flight" if self.commuting else f"free_flight[{self.turn.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        attitudes, info = self._rotate_all(self.system.inertias, State(state.q[:, 3:], state.p[:, 3:]), dt)
        x = state.q[:, :3] + dt * (state.p[:, :3] / self.system.masses[:, None])
        together = StepInfo(jnp.max(info.residual), jnp.all(info.converged))
        return state._replace(q=jnp.concatenate([x, attitudes], axis=1)), together

    def _rotate_all(self, inertias: Array, states: State, dt: ArrayLike) -> tuple[Array, StepInfo]:
        """The quaternions (N, 4) after a time, and the reports."""

        def rotate_body(J: Inertia, body: State) -> tuple[Array, StepInfo]:
            step: Any = self.turn
            own: Any = dataclasses.replace(step, system=dataclasses.replace(step.system, inertia=J))
            end, info = own.substep(body, dt)
            return end.q, info

        return jax.vmap(rotate_body)(inertias, states)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} lost its digits at dt = {dt}: a body rotates too far in a step, or there is a NaN or an "
            "infinity in the state or an inertia. Use a smaller dt"
        )
