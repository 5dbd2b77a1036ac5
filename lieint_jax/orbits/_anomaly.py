"""Kepler's equation, elliptic and hyperbolic: the eccentric anomaly and its derivatives.

Everything is written with rest = |1 − e| and with E − sin E by its series, so that no digits cancel near a parabola.
Derivatives are those of the equation for E, not of the iterations that solve it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.power_series import horner

Function = Callable[[Array], Array]
_CORRECTIONS = 3  # by Halley's method: 2 suffice for all E, on ellipses and on hyperbolas
_CUBIC = [1 / math.factorial(2 * k + 3) for k in range(9)]  # (sinh E − E)/E³ = Σ E^{2k}/(2k+3)!


def slope(E: Array, e: Array, rest: Array, sine: Function) -> Array:
    """dM/dE = 1 − e cos E or e cosh E − 1, which is also r/|a|."""
    return rest + 2 * e * sine(E / 2) ** 2


def _halley(E: Array, m: Array, e: Array, rest: Array, sine: Function, less: Function) -> Array:
    """Corrections of E as a root of rest·E + e·less(E) = m, with less(E) = E − sin E or sinh E − E."""
    for _ in range(_CORRECTIONS):
        f = rest * E + e * less(E) - m
        rate, bend = slope(E, e, rest, sine), e * sine(E)
        E = E - 2 * f * rate / (2 * rate * rate - f * bend)
    return E


@jax.custom_jvp
def elliptic_anomaly(M: Array, e: Array, rest: Array) -> Array:
    """E of E − e sin E = M for |M| ≤ π."""
    m = jnp.abs(M)
    alpha = (3 * jnp.pi**2 + 1.6 * jnp.pi * (jnp.pi - m) / (1 + e)) / (jnp.pi**2 - 6)
    d = 3 * rest + alpha * e
    q = 2 * alpha * d * rest - m * m
    r = 3 * alpha * d * (d - rest) * m + m**3
    w = jnp.cbrt(r + jnp.sqrt(jnp.maximum(q**3 + r * r, 0))) ** 2
    E = (2 * r * w / (w * w + w * q + q * q) + m) / d
    E = _halley(E, m, e, rest, jnp.sin, less_sine)
    return jnp.where(M < 0, -E, E)


@elliptic_anomaly.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    E, (_, e, rest), (dM, de, drest) = elliptic_anomaly(*primals), primals, tangents
    return E, (dM - E * drest - (E - jnp.sin(E)) * de) / slope(E, e, rest, jnp.sin)


@jax.custom_jvp
def hyperbolic_anomaly(M: Array, e: Array, rest: Array) -> Array:
    """E of e sinh E − E = M.

    The cubic (e − 1)E + eE³/6 = M gives an upper bound of |E|, and E ↦ asinh((|M| + E)/e) maps an upper bound to a
    smaller one. The left side is convex, so from there the corrections decrease to the root.
    """
    m = jnp.abs(M)
    p = 2 * rest / e
    s = 3 * m / e
    w = jnp.cbrt(s + jnp.sqrt(s * s + p**3))
    cubic = 2 * s / (w * w + p + (p / w) ** 2)
    E = jnp.minimum(cubic, jnp.arcsinh((m + cubic) / e))
    E = _halley(E, m, e, rest, jnp.sinh, sinh_less)
    return jnp.where(M < 0, -E, E)


@hyperbolic_anomaly.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    E, (_, e, rest), (dM, de, drest) = hyperbolic_anomaly(*primals), primals, tangents
    return E, (dM - E * drest - (jnp.sinh(E) - E) * de) / slope(E, e, rest, jnp.sinh)


def less_sine(E: Array) -> Array:
    """E − sin E, by its series below 1."""
    x = E * E
    return jnp.where(E < 1, E * x * horner(_CUBIC, -jnp.minimum(x, 4)), E - jnp.sin(E))


def sinh_less(E: Array) -> Array:
    """sinh E − E, by its series below 1."""
    x = E * E
    return jnp.where(E < 1, E * x * horner(_CUBIC, jnp.minimum(x, 4)), jnp.sinh(E) - E)
