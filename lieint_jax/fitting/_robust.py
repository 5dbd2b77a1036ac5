"""Errors with heavy tails: Student's t in place of the normal distribution, with the noise level fitted as well.

Vectors e of d components with scale σ and ν degrees of freedom have the negative log-likelihood

    Σ [d log σ + (ν + d)/2 log(1 + |e|²/(νσ²))] + constant

An outlier enters it by its logarithm only. The smaller ν, the heavier the tails; ν = 4 is the usual choice where there
are too few data to fit it, ν → ∞ the normal distribution.

Source: Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84, 881, where the minimum is found by reweighting; here it is
written as a sum of squares, for any method of least squares (Triggs, McLauchlan, Hartley & Fitzgibbon 2000, Lecture
Notes in Computer Science 1883, Section 4.3).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

FREEDOM = 4.0
_SMALL = 1e-8  # |e|²/(νσ²) below which log(1 + u)/u is 1 − u/2 to round-off


def student_t(
    errors: Array, noise: ArrayLike, least: ArrayLike, freedom: ArrayLike = FREEDOM
) -> tuple[Array, Array]:
    """Residuals whose half sum of squares is the negative log-likelihood, less a constant that `least` sets.

    Args:
        errors: vectors of errors, (..., d); each vector as a whole is an outlier or not.
        noise: their scale σ in the same unit, to be fitted or given. Bound it by `interval(least, most)`.
        least: a lower bound of σ, without influence on the estimate: d log(σ/least) must not be negative.
        freedom: ν.

    Returns:
        Two arrays for `fit`: the errors, shortened the more the longer they are, (..., d); and the part of σ, (...).
    """
    d = errors.shape[-1]
    u = jnp.sum(errors * errors, axis=-1) / (freedom * jnp.square(noise))
    safe = jnp.where(u < _SMALL, 1, u)  # before the division, or its derivative is NaN at 0
    shortening = jnp.sqrt((freedom + d) / freedom * jnp.where(u < _SMALL, 1 - u / 2, jnp.log1p(safe) / safe))
    level = jnp.sqrt(2 * d * jnp.log(noise / least))
    return errors / noise * shortening[..., None], jnp.broadcast_to(level, u.shape)


def student_t_weights(errors: Array, noise: ArrayLike, freedom: ArrayLike = FREEDOM) -> Array:
    """The weights (ν + d)/(ν + |e|²/σ²) of the vectors e in the equivalent weighted least squares, (...).

    1 + d/ν at most, about 1 where |e|² is dσ², and small for an outlier.
    """
    return (freedom + errors.shape[-1]) / (freedom + jnp.sum(errors * errors, axis=-1) / jnp.square(noise))


def student_t_information(d: int, freedom: float = FREEDOM) -> tuple[float, float]:
    """The Fisher information of one vector of d components: of its mean, and of the logarithm of its scale.

    Returns:
        (ν + d)/(ν + d + 2), in units of 1/σ², and 2dν/(ν + d + 2). For ν → ∞ they are 1 and 2d.
        The two estimates are independent to this order.
    """
    return (freedom + d) / (freedom + d + 2), 2 * d * freedom / (freedom + d + 2)
