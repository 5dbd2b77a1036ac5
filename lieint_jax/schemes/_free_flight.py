"""The exact free motion of many rigid bodies: centres go straight on, each body turns as a free rigid body does."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _free_body
from lieint_jax._numerics import three
from lieint_jax.groups import so3
from lieint_jax.schemes._capability import Integrand
from lieint_jax.schemes.exact import judged
from lieint_jax.types import Bodies, FreeBodies, State, Step, StepInfo, pytree, static


def free_motion(bodies: FreeBodies | Bodies, state: State) -> Array:
    """q̇ of bodies, (N, 7): ẋ = p/m and Λ̇ = ΛΩ̂."""

    def turning(J: Array, q: Array, spin: Array) -> Array:
        return so3.tangent(q, jnp.stack(three.solve_symmetric(three.symmetric(J), so3.Ad_star(q, spin))))

    turned = jax.vmap(turning)(bodies.inertias, state.q[:, 3:], state.p[:, 3:])
    return jnp.concatenate([state.p[:, :3] / bodies.masses[:, None], turned], axis=1)


def _motion(bodies: FreeBodies, state: State) -> State:
    """The vector field of free bodies."""
    return State(free_motion(bodies, state), jnp.zeros_like(state.p))


MANY_FREE_BODIES = Integrand(FreeBodies, "free rigid bodies (systems.rigid_bodies(...).free)", _motion)


@pytree
class FreeFlight(Step):
    """The exact flow of free rigid bodies, the drift of a splitting.

    Attributes:
        system: free rigid bodies.
    """

    system: FreeBodies
    order: float = static(default=math.inf)
    symmetric: bool = static(default=True)

    @property
    def commuting(self) -> bool:
        return True

    @property
    def name(self) -> str:
        return "free_flight"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        J, spins = self.system.inertias, state.p[:, 3:]
        turned, report = jax.vmap(_free_body.attitude, (0, 0, 0, None))(J, state.q[:, 3:], spins, jnp.asarray(dt))
        info = jax.vmap(judged)(J, turned, *report)
        x = state.q[:, :3] + dt * (state.p[:, :3] / self.system.masses[:, None])
        together = StepInfo(jnp.max(info.residual), jnp.all(info.converged))
        return state._replace(q=jnp.concatenate([x, turned], axis=1)), together

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} lost its digits at dt = {dt}: a body turns too often in a step, or there is a NaN or an "
            "infinity in the state or an inertia. Take a smaller dt"
        )
