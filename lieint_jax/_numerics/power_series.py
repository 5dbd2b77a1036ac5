"""Scalar functions that are smooth at 0 where their closed form is 0/0: power series near it, closed forms beyond."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.select import where
from lieint_jax._xla import forward_mode


def horner(coefficients: Sequence[float], x: Array) -> Array:
    """Σ cₖ xᵏ."""
    value = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = c + x * value
    return value


def _entire(series: Sequence[float], closed: Callable[[Array], Array], radius: float) -> Callable[[Array], Array]:
    """A function of x ≥ 0 that is smooth at 0: its Taylor series for x < radius, its closed form beyond.

    Far outside its range each branch gets a harmless argument, so that no derivative is 0/0. Near the radius both get
    x: XLA may compute x twice with different rounding, so each branch must be right on both sides of the threshold.
    """

    def function(x: Array) -> Array:
        inside, outside = where(x < 2 * radius, x, 0), where(x < radius / 2, radius, x)
        return where(x < radius, horner(series, inside), closed(outside))

    return function


def _reciprocal_factorials(first: int) -> list[float]:
    """1/first!, −1/(first+2)!, 1/(first+4)!, …, of which eleven reach the last bit where they are summed."""
    values, value = [], 1.0
    for k in range(11):
        values.append((-1) ** k * value)
        value /= (first + 2 * k + 1) * (first + 2 * k + 2)
    return values


@forward_mode
def log1p_ratio(y: Array) -> Array:
    """log(1 + y)/y for y > −1, smooth at 0: below |y| = 0.1 by the series of 2 artanh z, z = y/(2 + y)."""
    size = jnp.abs(y)
    small_y = where(size < 0.2, y, 0)  # both branches are right near the threshold, see `_entire`
    z = small_y / (2 + small_y)
    series = 2 / (2 + small_y) * horner([1 / (2 * k + 1) for k in range(7)], z * z)
    far = where(size < 0.05, 1, y)
    return where(size < 0.1, series, jnp.log1p(far) / far)


# cos √x, sin √x / √x and arctan √x / √x are analytic in x = |θ|², and so is everything built from them.
cos_sqrt = _entire(_reciprocal_factorials(0), lambda x: jnp.cos(jnp.sqrt(x)), 1.0)
sinc_sqrt = _entire(_reciprocal_factorials(1), lambda x: jnp.sin(jnp.sqrt(x)) / jnp.sqrt(x), 1.0)
arctan_sqrt = _entire(
    [(-1) ** k / (2 * k + 1) for k in range(18)], lambda x: jnp.arctan(jnp.sqrt(x)) / jnp.sqrt(x), 0.1
)


@forward_mode
def stumpff(x: Array) -> tuple[Array, Array, Array, Array]:
    """c₀ … c₃ with c_k(x) = Σ (−x)ⁿ/(k + 2n)! for x of any sign: c₀ = cos √x, c₁ = sin √x/√x, and the next two."""
    near = where(jnp.abs(x) < 2, x, 0)  # the branches overlap, see `_entire`
    bound, free = (jnp.sqrt(where(sign * x > 0.5, sign * x, 1)) for sign in (1, -1))
    half = jnp.sin(bound / 2) / (bound / 2), jnp.sinh(free / 2) / (free / 2)
    far = x > 0
    c2 = where(far, half[0] * half[0], half[1] * half[1]) / 2
    sinhc = half[1] * jnp.sqrt(1 + (free * half[1]) ** 2 / 4)  # sinh x = 2 sinh ½x cosh ½x
    c3 = where(far, (1 - jnp.sin(bound) / bound) / bound**2, (sinhc - 1) / free**2)
    small = jnp.abs(x) < 1
    c2 = where(small, horner(_reciprocal_factorials(2), near) / 2, c2)
    c3 = where(small, horner(_reciprocal_factorials(3), near) / 6, c3)
    return 1 - x * c2, 1 - x * c3, c2, c3
