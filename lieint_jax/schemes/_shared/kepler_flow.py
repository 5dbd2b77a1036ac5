"""The exact relative motion of two points that attract each other, for a time of any size and sign."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import newton
from lieint_jax._numerics.arrays import Scalar, Vector3
from lieint_jax._numerics.power_series import stumpff
from lieint_jax._numerics.select import where
from lieint_jax._numerics.vectors import dot, norm
from lieint_jax.core import StepInfo

_ITERATIONS = 4  # corrections of Kepler's equation, each of order 4


def kepler_flow(d: Vector3, v: Vector3, mu: Scalar, dt: Array) -> tuple[Array, Array, StepInfo]:
    """Δd and Δv of the motion d̈ = −μd/|d|³ in the time Δt, and the report: the residual of the equation for s over Δt.

    By universal variables: r₀G₁ + ηG₂ + μG₃ = Δt with G_k = sᵏc_k(βs²), β = 2μ/r₀ − |v|², η = d·v; on every conic.
    """
    r0, eta = norm(d), dot(d, v)
    beta = 2 * mu / r0 - dot(v, v)
    bend = mu - beta * r0

    def powers(s: Array) -> tuple[Array, Array, Array, Array]:
        c0, c1, c2, c3 = stumpff(beta * s * s)
        return c0, s * c1, s * s * c2, s**3 * c3

    def excess(s: Array) -> Array:
        _, G1, G2, G3 = powers(s)
        return r0 * G1 + eta * G2 + mu * G3 - dt

    def correction(s: Array, F: Array) -> Array:
        """A correction of order 4 (Danby 1987), from F and its derivatives r, dr/ds and d²r/ds² at s."""
        G0, G1, G2, _ = powers(s)
        r, r1, r2 = r0 * G0 + eta * G1 + mu * G2, eta * G0 + bend * G1, bend * G0 - beta * eta * G1
        step = F / r
        step = F / (r - step * r1 / 2)
        return F / (r - step * (r1 / 2 - step * r2 / 6))

    tau, lift = dt / r0, eta / (2 * r0)
    guess = tau * (1 - tau * (lift - tau * (2 * lift * lift - bend / (6 * r0))))
    s, F, steady = newton.root(excess, correction, guess, _ITERATIONS, unroll=False, length=jnp.abs)
    G0, G1, G2, G3 = powers(s)
    r = r0 * G0 + eta * G1 + mu * G2
    moved = -mu * G2 / r0 * d + (dt - mu * G3) * v
    faster = -mu * G1 / (r0 * r) * d - mu * G2 / r * v
    return moved, faster, StepInfo.of_root(jnp.abs(F / where(dt == 0, 1, dt)), steady & (r > 0))
