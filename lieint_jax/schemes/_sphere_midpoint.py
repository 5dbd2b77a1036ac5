"""The midpoint rule on T*S², in the ambient space (1.6), and the scaled one that is symplectic (Section 1.1).

With q_m = ½(q_n + q_{n+1}) and π_m = ½(π_n + π_{n+1}),

    q_{n+1} − q_n = (Δt/m) π_m × r,   π_{n+1} − π_n = −Δt r × ∇V(r),   r = q_m or r = q_m/|q_m|

π_m = π_n − ½Δt r × ∇V(r) is explicit in r, so three equations for u = q_{n+1} − q_n are left.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import newton
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax._numerics.vectors import cross, dot, matrix, max_abs, norm
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.systems._equations import AbstractSphereSystem

__all__ = ["sphere_midpoint"]

_TURN = 2.5  # radians; no step of a midpoint rule turns by 180°, and near that other branches come close


@pytree
class SphereMidpoint(Step):
    """The step made by `sphere_midpoint`."""

    system: AbstractSphereSystem
    normalized: bool = static()
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"sphere_midpoint[{'normalized' if self.normalized else 'plain'}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        q, p, dt = state.q, state.p, jnp.asarray(dt)
        h = dt / self.system.mass

        def torque(u: Array) -> tuple[Array, Array]:
            """r, and −Δt r × ∇V(r)."""
            r = q + u / 2
            r = r / norm(r) if self.normalized else r
            return r, -dt * jnp.stack(cross(r, autodiff_gradient(self.system.potential)(r)))

        def equation(u: Array) -> Array:
            r, change = torque(u)
            return u - h * jnp.stack(cross(p + change / 2, r))

        def correction(u: Array, f: Array) -> Array:
            return jnp.stack(matrix(jax.jacfwd(equation)(u)).solve(f))

        kicked = p + torque(jnp.zeros_like(q))[1] / 2
        first = h * jnp.stack(cross(kicked, q))
        guess = first + h / 2 * jnp.stack(cross(kicked, first))
        u, f, steady = newton.root(equation, correction, guess, self.iterations)
        # with a positive K the equation is monotone, so it has one root; without normalization that is a proof
        K = matrix(lax.stop_gradient(jax.jacfwd(equation)(u))).plus_transpose()
        unique = K.positive_definite & (norm(h * p) < _TURN)
        info = StepInfo.of_root(max_abs(f), (dot(u, u) < 4) & steady & unique)
        return state._replace(q=q + u, p=p + torque(u)[1]), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        turn = float(np.linalg.norm(dt / self.system.mass * state.p))
        more = f", or more iterations than {self.iterations}" if turn < 1 else ""
        return (
            f"{self.name} does not converge at dt = {dt}, where |Δt q̇| = {turn:.3g}: it may be 2.5, and the "
            "branch of solutions ends at |Δt| of some 2/ω in a field that makes small oscillations of ω. Use a "
            f"smaller dt{more}"
        )


def sphere_midpoint(system: AbstractSphereSystem, normalized: bool = False, iterations: int = 6) -> SphereMidpoint:
    """The midpoint rule (1.6) for a pendulum, with ∇H at the midpoint.

    | | `normalized=False` (1.6) | `normalized=True` |
    |---|---|---|
    | \\|q\\| = 1 and q·π = 0 | exact | exact |
    | momentum γ·π | exact | exact |
    | energy | exact for at most quadratic g | exact for linear g |
    | symplectic form | O(Δt³) per step | exact |

    "Exact" is to round-off. Both are of second order and time-symmetric.

    Args:
        system: `systems.pendulum(...)`.
        normalized: whether to replace the mean direction q_m by q_m/|q_m| on the right-hand sides.
        iterations: Newton corrections per step; 6 reach round-off where a step rotates q by less than about a radian.

    Raises:
        ValueError: not a pendulum, a bad count.

    Source: Lewis & Simo 1994, Section 1.1 and its closing remark.
    """
    PROPERTIES.check(system)
    return SphereMidpoint(system, bool(normalized), _checks.count("iterations", iterations, 1))


PROPERTIES = SchemeProperties(
    name="sphere_midpoint",
    systems="the spherical pendulum",
    conserves=("momentum", "energy (plain)", "form (normalized)"),
    limit="less than 180° a step",
    aliases=("midpoint rule on T*S²",),
    source="Lewis & Simo 1994, (1.6)",
    accepts=(AbstractSphereSystem,),
)


@PROPERTIES.by_name
def examples(system: AbstractSphereSystem) -> list[Step]:
    """The plain and the normalized rule, for pendulums."""
    return [sphere_midpoint(system), sphere_midpoint(system, normalized=True)]
