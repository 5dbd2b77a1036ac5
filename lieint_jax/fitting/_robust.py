"""Errors with heavy tails: Student's t in place of the normal distribution, with the noise level fitted as well.

Vectors e of d components with scale σ and ν degrees of freedom have the negative log-likelihood

    Σ [d log σ + (ν + d)/2 log(1 + |e|²/(νσ²))] + constant

An outlier contributes by its logarithm only. The smaller ν, the heavier the tails; ν = 4 is the usual choice if there
are too few data to fit it, and ν → ∞ is the normal distribution.

Source: Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84, 881, where the minimum is found by reweighting; here it is
written as a sum of squares, for any method of least squares (Triggs, McLauchlan, Hartley & Fitzgibbon 2000, Lecture
Notes in Computer Science 1883, Section 4.3).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._checks import all_plain

DEGREES_OF_FREEDOM = 4.0
_SMALL = 1e-8  # |e|²/(νσ²) below which log(1 + u)/u is 1 − u/2 to round-off


def student_t(
    errors: Array, noise: Array | float, least: Array | float, freedom: Array | float = DEGREES_OF_FREEDOM
) -> tuple[Array, Array]:
    """Residuals for a fit robust to outliers: half their sum of squares is the negative log-likelihood of Student's t.

    A constant that depends on `least` is subtracted.

    Args:
        errors: vectors of errors, (..., d); each vector as a whole is an outlier or not.
        noise: their scale σ in the same unit, fitted or given. Bound it by `interval(least, most)`.
        least: a lower bound of σ, without influence on the estimate: d log(σ/least) must not be negative.
        freedom: ν.

    Returns:
        Two arrays for `fit`: the errors, reduced the more the larger they are, (..., d); and the term of σ, (...).
    """
    all_plain(errors=errors, noise=noise, least=least, freedom=freedom)
    d = errors.shape[-1]
    u = jnp.sum(errors * errors, axis=-1) / (freedom * jnp.square(noise))
    safe = jnp.where(u < _SMALL, 1, u)  # before the division, or its derivative is NaN at 0
    shortening = jnp.sqrt((freedom + d) / freedom * jnp.where(u < _SMALL, 1 - u / 2, jnp.log1p(safe) / safe))
    level = jnp.sqrt(2 * d * jnp.log(noise / least))
    return errors / noise * shortening[..., None], jnp.broadcast_to(level, u.shape)


def student_t_weights(errors: Array, noise: Array | float, freedom: Array | float = DEGREES_OF_FREEDOM) -> Array:
    """The weights (ν + d)/(ν + |e|²/σ²) of the vectors e in the equivalent weighted least squares, (...).

    Arguments as in `student_t`. The weights are at most 1 + d/ν, about 1 where |e|² is dσ², and small for an outlier.
    """
    all_plain(errors=errors, noise=noise, freedom=freedom)
    return (freedom + errors.shape[-1]) / (freedom + jnp.sum(errors * errors, axis=-1) / jnp.square(noise))


def student_t_curvature(errors: Array, noise: Array | float, freedom: Array | float = DEGREES_OF_FREEDOM) -> Array:
    """The second derivative of the negative log-likelihood by each vector of errors e, (..., d, d).

    w/σ² (1 − 2eeᵀ/(νσ² + |e|²)) with the weight w. With J the derivative of e by parameters, Σ Jᵀ(…)J is their
    observed information, whose inverse is a better covariance than that of the expected one (Efron & Hinkley 1978,
    Biometrika 65, 457).
    """
    all_plain(errors=errors, noise=noise, freedom=freedom)
    square = freedom * jnp.square(noise) + jnp.sum(errors * errors, axis=-1)
    outer = errors[..., :, None] * errors[..., None, :] / square[..., None, None]
    factor = student_t_weights(errors, noise, freedom) / jnp.square(noise)
    return factor[..., None, None] * (jnp.eye(errors.shape[-1]) - 2 * outer)


def student_t_noise_error(vectors: int, d: int, freedom: float = DEGREES_OF_FREEDOM) -> float:
    """The standard error of log σ from a number of vectors of d components, by the information 2dν/(ν + d + 2)."""
    all_plain(vectors=vectors, d=d, freedom=freedom)
    return (2 * d * freedom / (freedom + d + 2) * vectors) ** -0.5
