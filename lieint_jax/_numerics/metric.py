"""The two isomorphisms of a metric: m is principal, (d,), or full, (d, d)."""

from __future__ import annotations

from jax import Array

from lieint_jax._numerics import small_linalg as la
from lieint_jax.types.shapes import AlgebraVector, DualVector


def flat(metric: Array, xi: AlgebraVector) -> DualVector:
    """ξ♭ = m ξ."""
    _check_shape(metric, len(xi))
    return metric * xi if metric.ndim == 1 else la.as_array(la.unrolled(metric) @ la.unrolled(xi), xi)


def sharp(metric: Array, mu: DualVector) -> AlgebraVector:
    """μ♯ = m⁻¹ μ."""
    _check_shape(metric, len(mu))
    if metric.ndim == 1:
        return mu / metric
    return la.as_array(la.solve(la.unrolled(metric), la.unrolled(mu)), mu)


def _check_shape(metric: Array, d: int) -> None:
    if metric.shape not in ((d,), (d, d)):
        raise ValueError(f"the metric of one system has shape ({d},) or ({d}, {d}), got {metric.shape}; use jax.vmap")
