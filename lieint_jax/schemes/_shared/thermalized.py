"""The exact flow of friction and noise in the axes of a body."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.vectors import symmetric
from lieint_jax.groups import so3


def thermalized(
    q: Array, J: Array, p: Array, noise: Array, rate: Array, dt: Array, temperature: Array
) -> tuple[Array, Array]:
    """A momentum in space after friction and noise in the axes of the body, and the kinetic energy gained.

    It is the exact flow of an Ornstein–Uhlenbeck process. J is the inertia of the body, or its mass along each axis.
    The gain is ½ (Π′ − Π)·J⁻¹(Π′ + Π).
    """
    decay, spread = jnp.exp(-rate * dt), jnp.sqrt(-jnp.expm1(-2 * rate * jnp.maximum(dt, 0)))
    before = so3.Ad_star(q, p)
    after = decay * before + spread * jnp.sqrt(temperature) * root_times(J, noise)
    mean_velocity = jnp.stack(symmetric(J).solve(before + after)) / 2
    return so3.Ad(q, after), jnp.sum((after - before) * mean_velocity)


def root_times(J: Array, noise: Array) -> Array:
    """A square root of J times a vector: that of the moments, or the lower triangle L with LLᵀ = J."""
    if J.ndim == 1:
        return jnp.sqrt(J) * noise
    a = jnp.sqrt(J[0, 0])
    b, c = J[1, 0] / a, J[2, 0] / a
    d = jnp.sqrt(J[1, 1] - b * b)
    e = (J[2, 1] - b * c) / d
    f = jnp.sqrt(J[2, 2] - c * c - e * e)
    x, y, z = noise
    return jnp.stack([a * x, b * x + d * y, c * x + e * y + f * z])
