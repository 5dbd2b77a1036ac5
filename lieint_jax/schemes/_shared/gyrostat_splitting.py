"""Rotation, drift, rotation: the symplectic splitting for a gyrostat.

    H = ½(Π − h_r)·J⁻¹(Π − h_r) = ½ Π·J⁻¹Π − c·Π + ½ h_r·c,    c = J⁻¹h_r

−c·Π generates Λ ← Λ exp(−tĉ), π ← π, a rotation about an axis in the body, exactly and for every J. So one step is

    Λ ← Λ exp(−½Δt ĉ),    (Λ, π) ← a step of the free body,    Λ ← Λ exp(−½Δt ĉ)
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax.capabilities import AbstractGyrostat
from lieint_jax.groups import so3
from lieint_jax.schemes._shared.half_rotation import attitude_error_limit
from lieint_jax.types import State, Step, StepInfo, pytree, static
from lieint_jax.types.vectors import max_abs, symmetric


@pytree
class GyrostatSplitting(Step):
    """The step that `splitting` makes for a gyrostat.

    Attributes:
        system: a gyrostat.
        drift: a step of the free body of its inertia.
    """

    system: AbstractGyrostat
    drift: Step
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"splitting[{self.drift.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state, info = self.drift.substep(self._turn(state, dt), dt)
        return self._turn(state, dt), self._report(info, state, dt)

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        state, info, T = self.drift.tangent(self._turn(state, dt), dt, T)  # turns about body axes leave (δθ, δπ)
        return self._turn(state, dt), self._report(info, state, dt), T

    def _report(self, info: StepInfo, state: State, dt: ArrayLike) -> StepInfo:
        known = jnp.finfo(state.q.dtype).eps * self._angle(dt) <= attitude_error_limit(state.q.dtype)
        return info._replace(converged=info.converged & known)

    def advice(self, state: State, dt: ArrayLike) -> str:
        turned = self._turn(state, dt)
        if not self.drift(turned, dt)[1].converged:
            return f"{self.name}: {self.drift.advice(turned, dt)}"
        return f"{self.name}: the rotor turns the body by {float(self._angle(dt)):.3g} rad in a step: use a smaller dt"

    def _turn(self, state: State, dt: ArrayLike) -> State:
        turn = so3.exp(jnp.asarray(-0.5 * dt) * _velocity(self.system))
        return state._replace(q=so3.normalize(so3.multiply(state.q, turn)))

    def _angle(self, dt: ArrayLike) -> Array:
        return lax.stop_gradient(jnp.abs(dt) * max_abs(_velocity(self.system)))


def _velocity(system: AbstractGyrostat) -> Array:
    """c = J⁻¹h_r."""
    return jnp.stack(symmetric(system.inertia).solve(system.rotor))
