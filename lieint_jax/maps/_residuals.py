"""The conditions on a map τ by which a step conserves energy (Result 10) and the symplectic form (5.31)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import AlgebraVector, Scalar
from lieint_jax.core import Group
from lieint_jax.maps._maps import Map, derivative


def axis_residual(tau: Map, group: Group, theta: AlgebraVector) -> Scalar:
    """max|Ad_τ(Θ) Θ − Θ| / max|Θ|: zero if a step by τ conserves energy (Result 10)."""
    return jnp.max(jnp.abs(group.Ad(tau(group, theta), theta) - theta)) / jnp.max(jnp.abs(theta))


def symplectic_residual(tau: Map, group: Group, metric: Array, theta: AlgebraVector) -> Scalar:
    """The residual of the symplectic condition (5.31), relative to the metric.

    With (5.33) inserted, Δt drops out: skew[m H⁻¹ (1 + Ad_τ⁻¹)] = ad*([(1 + Ad*_τ⁻¹)⁻¹ − ½] m Θ). The step of
    `schemes.group_midpoint` from a state with Δt Ω_{n+½} = Θ is symplectic if and only if it is zero.

    Args:
        tau: a map (group, Θ) ↦ group element.
        group: the group.
        metric: m, principal (d,) or full (d, d).
        theta: Θ, shape (d,).

    Returns:
        The largest entry of the residual, a scalar: 0 to round-off if τ is symplectic at this Θ.
    """
    one = jnp.eye(group.dim, dtype=theta.dtype)
    m = jnp.diag(metric) if jnp.ndim(metric) == 1 else metric
    back = jax.vmap(group.Ad, (None, 1), 1)(group.inverse(tau(group, theta)), one)  # Ad_τ⁻¹
    M = m @ jnp.linalg.solve(derivative(tau, group, theta), one + back)
    mu = jnp.linalg.solve(one + back.T, m @ theta) - m @ theta / 2
    right = jax.vmap(group.ad_star, (1, None), 1)(one, mu)
    return jnp.max(jnp.abs((M - M.T) / 2 - right)) / jnp.max(jnp.abs(m))


def is_symplectic(tau: Map, group: Group, metric: Array, size: float = 0.3, *, samples: int = 8) -> bool:
    """True if τ conserves the symplectic form for this group and metric, measured at random Θ with |Θᵢ| ≤ `size`.

    Arguments as in `symplectic_residual`; `samples` is the number of random Θ.
    """
    theta = np.random.default_rng(0).uniform(-size, size, (samples, group.dim))
    theta = jnp.asarray(theta, jnp.result_type(metric, float))
    found = jax.jit(jax.vmap(lambda x: symplectic_residual(tau, group, metric, x)))(theta)
    return bool(jnp.max(found) < 1e3 * jnp.finfo(theta.dtype).eps)
