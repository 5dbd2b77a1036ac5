"""The free motion of a rigid body on SE(3): it rotates about its center of mass, which moves on a straight line."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lieint_jax.capabilities import AbstractGeodesicFlow
from lieint_jax.groups import so3
from lieint_jax.groups.catalogue import special_euclidean
from lieint_jax.maps import kappa_symplectic
from lieint_jax.schemes._shared.half_rotation import ITERATIONS, half_rotation
from lieint_jax.types import State, Step, StepInfo, pytree, static
from lieint_jax.types.vectors import cross, matrix, unit_trace, vector


@pytree
class FreeMotion(Step):
    """The symplectic step of `so3_midpoint` for the attitude, and the exact motion of the center of mass.

    For an isotropic mass the two decouple in the coordinates (x, P) and (Λ, S), with the spin S = L − x × P. Momentum
    is conserved bit for bit, the symplectic form to round-off; energy too, if x × P is not large compared with S.

    Attributes:
        system: a geodesic flow on SE(3) with the metric diag(J, m1).
    """

    system: AbstractGeodesicFlow
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        m = self.system.metric
        inertia, mass = (m[:3], m[3]) if m.ndim == 1 else (m[:3, :3], m[3, 3])
        R, x, L, P = state.q[:3, :3], state.q[:3, 3], state.p[:3], state.p[3:]
        Pi = jnp.stack(matrix(R).T @ (vector(L) - cross(x, P)))
        J, r = unit_trace(inertia)
        h, info = half_rotation(J, (0.5 * r * dt) * Pi, kappa_symplectic, ITERATIONS["scalar"])
        turn = so3.to_matrix(so3.cayley_increment(jnp.array([1.0, 0, 0, 0], h.dtype), h))
        R = matrix(R) @ matrix(turn)
        moved = x + dt / mass * P
        rows = [jnp.stack([*R[i], moved[i]]) for i in range(3)]
        return state._replace(q=jnp.stack([*rows, state.q[3]])), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return f"{self.name} does not converge at dt = {dt}, where |Δt Ω| must stay below 1: use a smaller dt"


def is_free_motion(system: AbstractGeodesicFlow) -> bool:
    """True if a geodesic flow of a concrete metric is one that `FreeMotion` integrates."""
    if system.group != special_euclidean(3):
        return False
    m = np.asarray(system.metric)
    m = np.diag(m) if m.ndim == 1 else m
    return bool(not m[:3, 3:].any() and (m[3:, 3:] == m[3, 3] * np.eye(3)).all())
