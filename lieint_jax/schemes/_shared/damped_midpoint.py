"""The energy–momentum scheme of a rigid body with internal friction, which adds a rotation, but no torque.

With Π̄ = ½(Π_n + Π_{n+1}), Ω̄ = J⁻¹Π̄ and h = ½κΘ̄,

    Θ̄ = Δt(Ω̄ + α Π̄ × Ω̄),    Π̄ + h × Π̄ = Π_n,    ½ Π·J⁻¹Π |_n^{n+1} = −κΔtα|Π̄ × Ω̄|²
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from lieint_jax._numerics import newton
from lieint_jax._numerics.vectors import Vector, cross, dot, max_abs, norm, unit_trace, vector
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa
from lieint_jax.schemes._shared.half_rotation import on_branch
from lieint_jax.schemes._shared.torque_equation import jacobian
from lieint_jax.systems._equations import AbstractDampedBody
from lieint_jax.torques import internal_friction


@pytree
class DampedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with internal friction."""

    system: AbstractDampedBody
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)
    loops = True

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt, (J, r) = jnp.asarray(dt), unit_trace(self.system.inertia)
        alpha, unit = self.system.friction / r, r * vector(so3.Ad_star(state.q, state.p))  # αΠ, Π/tr J

        def turn(P: Vector) -> tuple[Vector, Vector]:
            """Ω̄ and y = ½Θ̄ for P = Π̄/tr J."""
            Omega = J.solve(P)
            return Omega, 0.5 * dt * (Omega + internal_friction(alpha, P, Omega))

        def balance(P: Vector) -> Vector:
            """Π̄ + h × Π̄, over tr J."""
            y = turn(P)[1]
            return P + self.kappa(4 * dot(y, y)) * cross(y, P)

        def correction(P: Vector, f: Vector) -> Vector:
            return jacobian(balance, P).solve(f)

        size = lax.stop_gradient(max_abs(unit))
        per = 1 / jnp.where(size > 0, size, 1)
        P, f, steady = newton.root(
            lambda P: balance(P) - unit,
            correction,
            unit,
            self.iterations,
            unroll=False,
            length=lambda step: per * lax.stop_gradient(max_abs(step)),
        )
        Omega, y = turn(P)
        k = self.kappa(4 * dot(y, y))
        at = lax.stop_gradient
        good = steady & J.well_conditioned
        good &= on_branch(self.kappa, at(y), jacobian(balance, at(P)))
        info = StepInfo.of_root(norm(f), good, size)
        q = so3.cayley_increment(state.q, jnp.stack(k * y))
        slip = cross(P, Omega)
        work = None if state.work is None else state.work - k * dt * alpha / r * dot(slip, slip)
        return state._replace(q=q, work=work), info._replace(residual=info.residual * jnp.abs(0.5 * dt))

    def advice(self, state: State, dt: ArrayLike) -> str:
        return advice(self, dt, "the friction is too strong")


def advice(step: Any, dt: ArrayLike, reason: str) -> str:
    """The advice for a step by a κ that fails by its branch, or for this reason."""
    return (
        f"{step.name} does not converge at dt = {dt}: the branch of this κ {step.kappa.branch}, or {reason}. "
        f"Use a smaller dt, or more than {step.iterations} iterations if |Δt Ω| < 1"
    )
