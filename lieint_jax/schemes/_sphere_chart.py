"""The midpoint rule in spherical coordinates, a Darboux chart of T*S² (Section 1.1, claims 4 and 5).

With z = (θ, φ, p_θ, p_φ) about an axis, z_m = ½(z_n + z_{n+1}) and the constant 𝒥 of (1.2), one step is

    z_{n+1} − z_n = Δt 𝒥∇H(z_m),    H = (p_θ² + p_φ²/sin²θ)/(2m) + V                             (1.1)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array, lax
from jax.typing import ArrayLike, DTypeLike

from lieint_jax import _checks
from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.phase_spaces import SphericalChart
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.systems._equations import AbstractSphereSystem

__all__ = ["sphere_chart"]


@pytree
class SphereChart(Step):
    """The step made by `sphere_chart`."""

    system: AbstractSphereSystem
    chart: SphericalChart
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)
    loops = True

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt, m = jnp.asarray(dt), self.system.mass
        z = self.chart.coordinates(state._replace(p=state.p / m))  # so that nothing depends on the unit of mass
        near = jnp.sin(z[0]) <= _pole(z.dtype)
        z = jnp.where(near, jnp.stack([jnp.ones_like(dt), *z[1:]]), z)  # on the axis, harmless numbers and a flag

        def potential(angles: Array) -> Array:
            at_rest = jnp.zeros_like(angles)
            return self.system.potential(self.chart.state(jnp.concatenate([angles, at_rest])).q) / m

        def rate(z: Array) -> Array:
            """𝒥∇H, with H, p_θ and p_φ over m."""
            slope, sine = autodiff_gradient(potential)(z[:2]), jnp.sin(z[0])
            turn = z[3] / (sine * sine)
            return jnp.stack([z[2], turn, turn * z[3] * jnp.cos(z[0]) / sine - slope[0], -slope[1]])

        def residual(u: Array) -> Array:
            return u - dt * rate(z + u / 2)

        def correction(u: Array, f: Array) -> Array:
            return jnp.stack(la.solve(la.unrolled(jax.jacfwd(residual)(u)), la.unrolled(f)))

        first = dt * rate(z)
        momentum = jnp.where(_largest(z[2:]) > 0, _largest(z[2:]), _largest(first[2:]))  # the latter from rest
        unit = jnp.stack([jnp.ones_like(dt)] * 2 + [jnp.where(momentum > 0, momentum, 1)] * 2)
        u, f, steady = newton.root(
            residual, correction, first, self.iterations, unroll=False, length=lambda x: _largest(x / unit)
        )
        after = z + u
        error = _largest(f / unit)
        inside = jnp.minimum(jnp.sin(after[0]), jnp.sin(z[0] + u[0] / 2)) > _pole(z.dtype)
        inside &= (after[0] > 0) & (after[0] < np.pi) & ~near
        unfolded = la.determinant(la.unrolled(lax.stop_gradient(jax.jacfwd(residual)(u)))) > 0
        end = self.chart.state(after)
        return state._replace(q=end.q, p=m * end.p), StepInfo.of_root(
            error, steady & inside & unfolded, 1 + _largest(u / unit)
        )

    def advice(self, state: State, dt: ArrayLike) -> str:
        theta = float(self.chart.coordinates(state)[0])
        on_axis = not np.sin(theta) > _pole(state.p.dtype)
        cure = "another axis" if on_axis else f"a smaller dt, or more iterations than {self.iterations}"
        return (
            f"{self.name} does not converge at dt = {dt}, {np.degrees(theta):.3g}° off the axis, where the chart is "
            f"singular: use {cure}, or sphere_midpoint, which has no singularity"
        )


def sphere_chart(
    system: AbstractSphereSystem, axis: npt.ArrayLike = (0.0, 0.0, -1.0), iterations: int = 8
) -> SphereChart:
    """The midpoint rule for a pendulum in spherical coordinates about an axis.

    | conserved | to |
    |---|---|
    | symplectic form (claim 4) | round-off |
    | momentum about the axis, if V is invariant under rotations about it (claim 4) | round-off |
    | energy (claim 5) | O(Δt³) per step, bounded |
    | \\|q\\| = 1 and q·π = 0 | round-off |

    Second order, time-symmetric. The paper's warning: the chart is singular on the axis. A step that comes within about
    1e-5 (float64) of it reports `converged=False`, and near it only small steps converge; `sphere_midpoint` has no such
    axis.

    Args:
        system: `systems.pendulum(...)`.
        axis: γ of the chart, a unit vector to 1e-6; by default that of `systems.pendulum`.
        iterations: Newton corrections per step.

    Raises:
        ValueError: not a pendulum, no unit vector, a bad count.

    Source: Lewis & Simo 1994, Section 1.1, claims 4 and 5.
    """
    PROPERTIES.check(system)
    gamma = _checks.unit_vector("axis", axis, like=system.mass)
    chart = SphericalChart(gamma / jnp.linalg.norm(gamma))
    return SphereChart(system, chart, _checks.count("iterations", iterations, 1))


PROPERTIES = SchemeProperties(
    name="sphere_chart",
    systems="the spherical pendulum",
    conserves=("momentum", "form"),
    limit="away from the axis",
    aliases=("implicit midpoint rule in spherical coordinates",),
    source="Lewis & Simo 1994, Section 1.1, claims 4 and 5",
    accepts=(AbstractSphereSystem,),
)


@PROPERTIES.by_name
def examples(system: AbstractSphereSystem) -> list[Step]:
    """The rule about the axis that pendulums have by default."""
    return [sphere_chart(system)]


def _pole(dtype: DTypeLike) -> float:
    """The least sin θ of a step: at its square root of eps p_φ²/sin²θ has half of the digits left."""
    return float(jnp.finfo(dtype).eps) ** (1 / 3)


def _largest(x: Array) -> Array:
    return jnp.max(jnp.abs(lax.stop_gradient(x)))
