"""The midpoint rule in spherical coordinates, a Darboux chart of T*S² (Section 1.1, claims 4 and 5).

With z = (θ, φ, p_θ, p_φ) about an axis, z_m = ½(z_n + z_{n+1}) and the constant 𝒥 of (1.2), one step is

    z_{n+1} − z_n = Δt 𝒥∇H(z_m),    H = (p_θ² + p_φ²/sin²θ)/(2m) + V                             (1.1)

It shows what coordinates cost; `schemes.sphere_midpoint` has no singular axis.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax._numerics import newton, vectors
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.phase_spaces import frame


@pytree
class SphericalChart:
    """Spherical coordinates z = (θ, φ, p_θ, p_φ) of T*S² about an axis γ: a Darboux chart, singular on the axis.

    With e₁, e₂, γ orthonormal, q = cos θ γ + sin θ (cos φ e₁ + sin φ e₂) and π = p_θ q × ∂q/∂θ + p_φ q × ∂q/∂φ / sin²θ,
    so that p_φ = γ·π. The form of T*S² is dθ∧dp_θ + dφ∧dp_φ: on (δθ, δφ, δp_θ, δp_φ) the constant matrix of (1.2).

    Attributes:
        axis: γ, a unit vector, shape (3,).
    """

    axis: Array

    def state(self, z):
        """The state of coordinates z, shape (4,)."""
        theta, phi, p_theta, p_phi = z
        q, down, along = self._frame(theta, phi)
        return State(q, p_theta * along - p_phi / jnp.sin(theta) * down)

    def coordinates(self, state):
        """The coordinates of a state, shape (4,): θ in [0, π], φ in (−π, π]. On the axis φ is 0."""
        e1, e2 = frame(self.axis)
        x, y, h = (vectors.dot(e, state.q) for e in (e1, e2, self.axis))
        polar = x * x + y * y == 0
        x = jnp.where(polar, 1, x)  # harmless before the square root and the angle
        theta = jnp.arctan2(jnp.where(polar, 0, jnp.sqrt(x * x + y * y)), h)
        phi = jnp.arctan2(y, x)
        along = self._frame(theta, phi)[2]
        return jnp.stack([theta, phi, vectors.dot(state.p, along), vectors.dot(state.p, self.axis)])

    def _frame(self, theta, phi):
        """q, ∂q/∂θ, and the unit vector q × ∂q/∂θ along ∂q/∂φ."""
        e1, e2 = frame(self.axis)
        out, along = jnp.cos(phi) * e1 + jnp.sin(phi) * e2, jnp.cos(phi) * e2 - jnp.sin(phi) * e1
        c, s = jnp.cos(theta), jnp.sin(theta)
        return c * self.axis + s * out, c * out - s * self.axis, along


@pytree
class SphereChart(Step):
    """The midpoint rule for a pendulum in spherical coordinates about an axis.

    It is symplectic, conserves the momentum about the axis if V does (claim 4), and has a bounded error of energy
    (claim 5). The chart is singular on the axis: a step that comes within about 1e-5 of it is not `converged`.
    """

    system: Any
    chart: SphericalChart
    iterations: int = static(default=8)
    order: float = static(default=2)
    symmetric: bool = static(default=True)
    loops = True

    def advance(self, state, dt):
        dt, m = jnp.asarray(dt), self.system.mass
        z = self.chart.coordinates(state._replace(p=state.p / m))  # so that nothing depends on the unit of mass
        near = jnp.sin(z[0]) <= _pole(z.dtype)
        z = jnp.where(near, jnp.stack([jnp.ones_like(dt), *z[1:]]), z)  # on the axis, harmless numbers and a flag

        def potential(angles):
            at_rest = jnp.zeros_like(angles)
            return self.system.potential(self.chart.state(jnp.concatenate([angles, at_rest])).q) / m

        def rate(z):
            """𝒥∇H, with H, p_θ and p_φ over m."""
            slope, sine = autodiff_gradient(potential)(z[:2]), jnp.sin(z[0])
            turn = z[3] / (sine * sine)
            return jnp.stack([z[2], turn, turn * z[3] * jnp.cos(z[0]) / sine - slope[0], -slope[1]])

        def residual(u):
            return u - dt * rate(z + u / 2)

        def correction(u: Array, f: Array):
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

    def advice(self, state, dt):
        theta = float(self.chart.coordinates(state)[0])
        on_axis = not np.sin(theta) > _pole(state.p.dtype)
        cure = "another axis" if on_axis else f"a smaller dt, or more iterations than {self.iterations}"
        return (
            f"{self.name} does not converge at dt = {dt}, {np.degrees(theta):.3g}° off the axis, where the chart is "
            f"singular: use {cure}, or sphere_midpoint, which has no singularity"
        )


def sphere_chart(system, axis=(0.0, 0.0, -1.0)):
    """The step about a unit vector, by default that of `systems.pendulum`."""
    axis = jnp.asarray(axis, jnp.asarray(system.mass).dtype)
    return SphereChart(system, SphericalChart(axis / jnp.linalg.norm(axis)))


def _pole(dtype):
    """The least sin θ of a step: at its square root of eps p_φ²/sin²θ has half of the digits left."""
    return float(jnp.finfo(dtype).eps) ** (1 / 3)


def _largest(x):
    return jnp.max(jnp.abs(lax.stop_gradient(x)))
