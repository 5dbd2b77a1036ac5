"""Elliptic integrals and functions with derivatives: Legendre's, Jacobi's and Carlson's, elementwise in arrays.

| | |
|---|---|
| `K`, `E`, `F`, `Pi` | Legendre's integrals, complete and incomplete |
| `sn`, `cn`, `dn` | Jacobi's functions |
| `RF`, `RC`, `RD`, `RJ` | Carlson's symmetric integrals |

m = k² is the parameter, as in SciPy and mpmath: K(m) = ∫₀^{π/2} dθ/√(1 − m sin²θ). It may be any number up to 1,
including negative ones. Arguments are broadcast against each other, and values have their dtype, float32 or float64.
The value is NaN outside the domain of real values, and infinite where the integral diverges.

Every function can be jitted, vmapped and differentiated with respect to every argument, in forward and reverse mode, to
any order. Where a derivative is infinite because an argument of Carlson's integrals is 0, it is replaced by a very
large number, so that the derivatives with respect to the other arguments stay finite.
"""

from __future__ import annotations

import math
from typing import overload

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import elliptic as numerics
from lieint_jax._numerics.select import where
from lieint_jax._xla import compiled, forward_mode

__all__ = ["RC", "RD", "RF", "RJ", "E", "F", "K", "Pi", "cn", "dn", "sn"]
__dir__ = __all__.copy


def K(m: ArrayLike) -> Array:
    """Legendre's complete elliptic integral of the first kind, ∫₀^{π/2} dθ/√(1 − m sin²θ): SciPy's `ellipk`.

    Args:
        m: the parameter k², ≤ 1.

    Returns:
        K(m), to a relative error of 3 eps; inf at m = 1, NaN for m > 1.

    Source: DLMF 19.8.5, by the arithmetic–geometric mean.

    Example:
        >>> print(f"{float(K(0.5)):.5f}")
        1.85407
    """
    return _complete_first(*_arrays(m=m))


@overload
def E(m: ArrayLike, /) -> Array: ...
@overload
def E(phi: ArrayLike, m: ArrayLike, /) -> Array: ...
def E(*arguments: ArrayLike) -> Array:
    """Legendre's elliptic integral of the second kind, ∫₀^φ √(1 − m sin²θ) dθ: `E(m)` to φ = π/2, or `E(phi, m)`.

    SciPy's `ellipe(m)` and `ellipeinc(phi, m)`.

    Args:
        arguments: m, the parameter k², ≤ 1; or φ in radians, of any size, and m.

    Returns:
        E(m) or E(φ, m), to a relative error of a few eps; NaN for m > 1. The derivative of `E(m)` at m = 1 is −inf.

    Source: DLMF 19.25.9 and 19.25.10, by Carlson's integrals: sums of positive terms, in which nothing cancels.

    Example:
        >>> print(f"{float(E(0.5)):.5f} {float(E(0.3, 0.5)):.5f}")
        1.35064 0.29778
    """
    _number_of_arguments("E", arguments, "E(m) or E(phi, m)", (1, 2))
    if len(arguments) == 1:
        return _complete_second(*_arrays(m=arguments[0]))
    return _incomplete_second(*_arrays(phi=arguments[0], m=arguments[1]))


def F(phi: ArrayLike, m: ArrayLike) -> Array:
    """Legendre's incomplete elliptic integral of the first kind, ∫₀^φ dθ/√(1 − m sin²θ): SciPy's `ellipkinc`.

    Args:
        phi: the amplitude φ in radians, of any size: F(φ + π, m) = F(φ, m) + 2K(m).
        m: the parameter k², ≤ 1.

    Returns:
        F(φ, m), to a relative error of a few eps; ±inf for m = 1 and |φ| > π/2, NaN for m > 1.

    Source: DLMF 19.25.5.

    Example:
        >>> print(f"{float(F(0.3, 0.5)):.5f}")
        0.30225
    """
    return _incomplete_first(*_arrays(phi=phi, m=m))


@overload
def Pi(n: ArrayLike, m: ArrayLike, /) -> Array: ...
@overload
def Pi(n: ArrayLike, phi: ArrayLike, m: ArrayLike, /) -> Array: ...
def Pi(*arguments: ArrayLike) -> Array:
    """Legendre's elliptic integral of the third kind, ∫₀^φ dθ/((1 − n sin²θ) √(1 − m sin²θ)).

    `Pi(n, m)` to φ = π/2, or `Pi(n, phi, m)`: mpmath's `ellippi`. SciPy has none.

    Args:
        arguments: n and m, or n, φ and m. The characteristic n is < 1, or up to 1/sin²φ where |φ| < π/2; φ is in
            radians, of any size; the parameter m = k² is ≤ 1.

    Returns:
        Π(n, m) or Π(n, φ, m), to a relative error of about ten eps; inf for n = 1 or m = 1 where φ is π/2, NaN for
        m > 1 and where 1 − n sin²θ changes its sign within the integral.

    Source: DLMF 19.25.14 for n ≥ 0. For n < 0 by R_J of the characteristic (m − n)/(1 − n), DLMF 19.21.12, so that
    nothing cancels.

    Example:
        >>> print(f"{float(Pi(-2.0, 0.5)):.5f}")
        1.02270
    """
    _number_of_arguments("Pi", arguments, "Pi(n, m) or Pi(n, phi, m)", (2, 3))
    if len(arguments) == 2:
        return _complete_third(*_arrays(n=arguments[0], m=arguments[1]))
    return _incomplete_third(*_arrays(n=arguments[0], phi=arguments[1], m=arguments[2]))


def sn(u: ArrayLike, m: ArrayLike) -> Array:
    """Jacobi's sn(u, m) = sin φ where F(φ, m) = u, the first of SciPy's `ellipj`, for negative m too.

    Args:
        u: the argument, of any size.
        m: the parameter k², ≤ 1.

    Returns:
        sn(u, m), to a relative error of a few eps, plus the effect of a relative error eps of u; NaN for m > 1.

    Source: DLMF 22.7, Landen's transformations; DLMF 22.17 for m < 0.

    Example:
        >>> print(f"{float(sn(0.5, 0.8)):.5f}")
        0.46557
    """
    return _jacobi(*_arrays(u=u, m=m))[0]


def cn(u: ArrayLike, m: ArrayLike) -> Array:
    """Jacobi's cn(u, m) = cos φ where F(φ, m) = u, the second of SciPy's `ellipj`, for negative m too.

    Args, Returns and Source: as in `sn`.

    Example:
        >>> print(f"{float(cn(0.5, 0.8)):.5f}")
        0.88501
    """
    return _jacobi(*_arrays(u=u, m=m))[1]


def dn(u: ArrayLike, m: ArrayLike) -> Array:
    """Jacobi's dn(u, m) = √(1 − m sn²(u, m)), the third of SciPy's `ellipj`, for negative m too.

    Args, Returns and Source: as in `sn`.

    Example:
        >>> print(f"{float(dn(0.5, 0.8)):.5f}")
        0.90917
    """
    return _jacobi(*_arrays(u=u, m=m))[2]


def RF(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """Carlson's symmetric integral of the first kind, ½ ∫₀^∞ dt/√((t + x)(t + y)(t + z)): SciPy's `elliprf`.

    Args:
        x, y, z: ≥ 0, of any ratio.

    Returns:
        R_F, to a relative error of a few eps; inf where two arguments are 0, 0 where one is inf, NaN where one is < 0.

    Source: DLMF 19.36(i), by duplication.

    Example:
        >>> print(f"{float(RF(0.0, 1.0, 2.0)):.5f}")
        1.31103
    """
    return _first(*_arrays(x=x, y=y, z=z))


def RC(x: ArrayLike, y: ArrayLike) -> Array:
    """Carlson's degenerate integral, ½ ∫₀^∞ dt/((t + y) √(t + x)): arctan and log in one. SciPy's `elliprc`.

    Args:
        x: ≥ 0.
        y: not 0; the value for y < 0 is Cauchy's principal value.

    Returns:
        R_C, to a relative error of a few eps; 0 where an argument is infinite, NaN for x < 0 or y = 0.

    Source: DLMF 19.2.17 to 19.2.20.

    Example:
        >>> print(f"{float(RC(0.0, 1.0)):.5f}")
        1.57080
    """
    return _degenerate(*_arrays(x=x, y=y))


def RD(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """Carlson's integral of the second kind, (3/2) ∫₀^∞ dt/((t + z) √((t + x)(t + y)(t + z))): SciPy's `elliprd`.

    The gradient of R_F is that of an ellipsoid's potential: ∂R_F/∂z = −R_D(x, y, z)/6.

    Args:
        x, y, z: ≥ 0, of any ratio.

    Returns:
        R_D, to a relative error of a few eps; inf for z = 0 or x = y = 0, 0 where an argument is inf, NaN where one
        is < 0.

    Source: DLMF 19.36(i), by duplication.

    Example:
        >>> print(f"{float(RD(0.0, 2.0, 1.0)):.5f}")
        1.79721
    """
    return _second(*_arrays(x=x, y=y, z=z))


def RJ(x: ArrayLike, y: ArrayLike, z: ArrayLike, p: ArrayLike) -> Array:
    """Carlson's integral of the third kind, (3/2) ∫₀^∞ dt/((t + p) √((t + x)(t + y)(t + z))): SciPy's `elliprj`.

    Args:
        x, y, z: ≥ 0, of any ratio.
        p: not 0; the value for p < 0 is Cauchy's principal value.

    Returns:
        R_J, to a relative error of a few eps, for p < 0 of the largest of the three terms of DLMF 19.20.14; inf where
        two of x, y, z are 0, 0 where an argument is infinite, NaN where x, y or z is < 0 or p = 0.

    Source: DLMF 19.36(i), by duplication; DLMF 19.20.14.

    Example:
        >>> print(f"{float(RJ(2.0, 3.0, 4.0, 5.0)):.5f}")
        0.14298
    """
    return _third(*_arrays(x=x, y=y, z=z, p=p))


def _arrays(**given: ArrayLike) -> list[Array]:
    """The arguments in one floating-point dtype and one shape."""
    arrays = [_checks.real_array(name, value, finite=False) for name, value in given.items()]
    dtype = jnp.result_type(*arrays)
    try:
        shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
    except ValueError as error:
        raise ValueError(
            f"{', '.join(given)} must have shapes that broadcast, got {', '.join(str(x.shape) for x in arrays)}"
        ) from error
    return [jnp.broadcast_to(jnp.asarray(x, dtype), shape) for x in arrays]


def _number_of_arguments(name: str, arguments: tuple[ArrayLike, ...], form: str, allowed: tuple[int, ...]) -> None:
    if len(arguments) not in allowed:
        raise TypeError(f"{name} is called as {form}, got {len(arguments)} arguments")


def _in_domain(value: Array, valid: Array) -> Array:
    return where(valid, value, jnp.nan)


def _complement(m: Array) -> Array:
    """1 − m, exact for m ≥ ½; 1 outside of the domain."""
    return where(m <= 1, 1 - m, 1)


def _over_zero(value: Array, positive: Array) -> Array:
    """The value, or inf with infinite slopes where it is not positive."""
    return value / positive.astype(value.dtype)


@compiled
def _complete_first(m: Array) -> Array:
    m1 = _complement(m)
    return _in_domain(_over_zero(numerics.quarter_period(m1), m1 > 0), m <= 1)


def _slope_of_complete_second(_: Array, m1: Array) -> list[Array]:
    """∂E/∂m1 = R_D(0, m1, 1)/6, which is (K − E)/2m."""
    root, one = jnp.sqrt(where(m1 > 0, m1, 1)), jnp.ones_like(m1)
    return [_over_zero(_rd(jnp.zeros_like(m1), root, one) / 6, m1 > 0)]


def _complete_second_of(m1: Array) -> Array:
    """E = (m1/3) (R_D(0, m1, 1) + R_D(0, 1, m1)), and √m1 times that of 1/m1 for m1 > 1."""
    positive, large = m1 > 0, m1 > 1
    safe = where(positive, where(large, 1 / where(large, m1, 1), m1), 1)
    zero, root, one = jnp.zeros_like(m1), jnp.sqrt(safe), jnp.ones_like(m1)
    stretch = jnp.sqrt(where(large, m1, 1))
    return stretch * where(positive, safe / 3 * (_rd(zero, root, one) + _rd(zero, one, root)), 1)


_second_of_complement = forward_mode(_complete_second_of, slopes=_slope_of_complete_second)


@compiled
def _complete_second(m: Array) -> Array:
    value = _second_of_complement(where(jnp.isinf(m), 1, _complement(m)))
    return _in_domain(where(m == -jnp.inf, jnp.inf, value), m <= 1)


class _Reduced:
    """The arguments of an incomplete integral, φ reduced to [−π/2, π/2].

    Attributes:
        turns: the number of times π was subtracted.
        s, c: the sine and the cosine of the reduced φ; c may be slightly negative.
        m1: 1 − m.
        q: √(1 − m s²).
    """

    def __init__(self, phi: Array, m: Array) -> None:
        self.turns = lax.stop_gradient(jnp.round(phi / jnp.pi))
        sign = 1 - 2 * jnp.mod(self.turns, 2)
        self.m1 = _complement(m)
        self.s, c = sign * jnp.sin(phi), sign * jnp.cos(phi)
        self.c = where(self.m1 == 0, jnp.abs(c), c)
        self.q = jnp.sqrt(self.c * self.c + self.m1 * self.s * self.s)

    def with_periods(self, part: Array, complete: Array) -> Array:
        """The integral to φ, from that to the reduced φ."""
        return part + where(self.turns == 0, 0, 2 * self.turns * where(self.turns == 0, 1, complete))

    def rf(self) -> Array:
        return numerics.carlson_rf(self.c, self.q, jnp.ones_like(self.q))


@compiled
def _incomplete_first(phi: Array, m: Array) -> Array:
    at = _Reduced(phi, m)
    return _in_domain(at.with_periods(at.s * at.rf(), _complete_first(m)), m <= 1)


def _incomplete_second_of(phi: Array, m: Array) -> Array:
    at, positive = _Reduced(phi, m), m >= 0
    one = jnp.ones_like(at.q)
    rd = _rd(at.c, where(positive, one, at.q), where(positive, at.q, one)) * at.s * at.s / 3
    above = at.m1 * (at.rf() + m * rd) + m * at.c / at.q
    return at.with_periods(at.s * where(positive, above, at.rf() - m * rd), _complete_second(m))


def _slopes_of_incomplete_second(_: Array, phi: Array, m: Array) -> list[Array]:
    """√(1 − m sin²φ) and (E − F)/2m, which is −sin³φ R_D(cos²φ, 1 − m sin²φ, 1)/6, without a difference."""
    at = _Reduced(phi, m)
    part = at.s**3 * _rd(at.c, at.q, jnp.ones_like(at.q)) / 6
    return [at.q, -at.with_periods(part, _slope_of_complete_second(at.m1, at.m1)[0])]


_second_of_amplitude = forward_mode(_incomplete_second_of, slopes=_slopes_of_incomplete_second)


@compiled
def _incomplete_second(phi: Array, m: Array) -> Array:
    return _in_domain(_second_of_amplitude(phi, m), m <= 1)


def _third_kind(n: Array, s: Array, c: Array, q: Array, m1: Array) -> Array:
    """Π(n, φ, m) for |φ| ≤ π/2, from sin φ, cos φ, q = √(1 − m sin²φ) and m1 = 1 − m."""
    one, square = jnp.ones_like(q), s * s
    negative = n < 0
    p, other = c * c + (1 - n) * square, c * c + m1 / where(negative, 1 - n, 1) * square
    positive, valid = p > 0, (p > 0) & (m1 > 0)
    p, other = where(positive, p, 1), where(m1 > 0, other, 1)
    rf, rj = numerics.carlson_rf(c, q, one), numerics.carlson_rj_of_any(c, q, one, where(negative, other, p))
    rc = numerics.carlson_rc(q, jnp.sqrt(p) * jnp.sqrt(other))
    below = (rf - n * (c * rc + m1 * square / (3 * (1 - where(negative, n, 0))) * rj)) / (1 - where(negative, n, 0))
    return s * _over_zero(where(negative, below, rf + n * square / 3 * rj), valid | positive & (c != 0))


@compiled
def _complete_third(n: Array, m: Array) -> Array:
    m1, one = _complement(m), jnp.ones_like(m)
    value = _third_kind(n, one, jnp.zeros_like(m), jnp.sqrt(m1 + jnp.finfo(m1.dtype).tiny), m1)
    return _in_domain(value, (m <= 1) & (n <= 1))


@compiled
def _incomplete_third(n: Array, phi: Array, m: Array) -> Array:
    at = _Reduced(phi, m)
    value = at.with_periods(_third_kind(n, at.s, at.c, at.q, at.m1), _complete_third(n, m))
    inside = at.c * at.c + (1 - n) * at.s * at.s > 0
    return _in_domain(value, (m <= 1) & inside & ((n <= 1) | (at.turns == 0)))


@compiled
def _jacobi(u: Array, m: Array) -> tuple[Array, Array, Array]:
    """sn, cn and dn. For m < 0 those of v = u√(1 − m) and the parameter m/(m − 1): sd/√(1 − m), cd and nd."""
    m1, negative = _complement(m), m < 0
    stretch = jnp.sqrt(where(negative, m1, 1))
    m1 = where(negative, 1 / where(negative, m1, 1), m1)
    u, unbounded = u * stretch, m1 == 0
    period = 2 * numerics.quarter_period(m1)
    turns = where(unbounded, 0, lax.stop_gradient(jnp.round(u / period)))
    most = -0.49 * math.log(float(jnp.finfo(u.dtype).tiny))  # beyond, sech underflows
    rest = where(unbounded, jnp.clip(u, -most, most), u - turns * period)
    s, c, d = numerics.jacobi(rest, m1)
    sign = 1 - 2 * jnp.mod(turns, 2)
    s, c = sign * s, sign * c
    values = where(negative, s / d / stretch, s), where(negative, c / d, c), where(negative, 1 / d, d)
    sn, cn, dn = (_in_domain(x, m <= 1) for x in values)
    return sn, cn, dn


@jax.custom_jvp
def _root(x: Array) -> Array:
    """√x for x ≥ 0, with a very large slope at 0 in place of an infinite one; 1 for x < 0."""
    return jnp.sqrt(where(x >= 0, x, 1))


@_root.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = _root(*primals)
    return root, tangents[0] / (2 * jnp.maximum(root, jnp.finfo(root.dtype).tiny))


def _rd(root_x: Array, root_y: Array, root_z: Array) -> Array:
    return numerics.carlson_rj_of_any(root_x, root_y, root_z, root_z * root_z)


def _carlson(value: Array, arguments: tuple[Array, ...], infinite: Array, valid: Array) -> Array:
    """The value in the domain; 0 where an argument is infinite."""
    any_infinite = jnp.zeros_like(valid)
    for x in arguments:
        any_infinite |= jnp.isinf(x)
    value = where(any_infinite, 0, where(infinite, jnp.inf, value))
    return _in_domain(value, valid)


def _two_zeros(x: Array, y: Array, z: Array) -> Array:
    return (x == 0) & (y == 0) | (y == 0) & (z == 0) | (x == 0) & (z == 0)


@compiled
def _first(x: Array, y: Array, z: Array) -> Array:
    value = numerics.carlson_rf(_root(x), _root(y), _root(z))
    return _carlson(value, (x, y, z), _two_zeros(x, y, z), (x >= 0) & (y >= 0) & (z >= 0))


@compiled
def _degenerate(x: Array, y: Array) -> Array:
    negative, valid = y < 0, (x >= 0) & (y != 0)
    safe = where(valid, y, 1)
    from_y = x - where(negative, y, 0)
    factor = where(negative, _root(x) / jnp.sqrt(where(negative, from_y, 1)), 1)
    value = numerics.carlson_rc(_root(from_y), jnp.sqrt(jnp.abs(safe)))
    return _carlson(factor * value, (x, y), jnp.zeros_like(valid), valid)


@compiled
def _second(x: Array, y: Array, z: Array) -> Array:
    value = _rd(_root(x), _root(y), _root(where(z == 0, 1, z)))
    return _carlson(value, (x, y, z), (z == 0) | (x == 0) & (y == 0), (x >= 0) & (y >= 0) & (z >= 0))


@compiled
def _third(x: Array, y: Array, z: Array, p: Array) -> Array:
    negative, valid = p < 0, (x >= 0) & (y >= 0) & (z >= 0) & (p != 0)
    a, b, c = _sort(_root(x), _root(y), _root(z))
    most = where(negative, c * c, 1)  # c² = 0 only where all are 0
    minus = where(negative, -p, 1)
    total = where(most + minus > 0, most + minus, 1)
    shifted = (most * (b * b + minus) + a * a * (c - b) * (c + b)) / total
    rj = numerics.carlson_rj_of_any(a, b, c, where(negative, shifted, where(p > 0, p, 1)))
    product = shifted * minus
    scale = jnp.sqrt(where(negative, a * a * b * b + product, 1))
    rc = numerics.carlson_rc(scale, jnp.sqrt(where(negative, product, 1)))
    principal = -(c - a) * (c + a) * (c - b) * (c + b) / total * rj
    principal = (principal - 3 * numerics.carlson_rf(a, b, c) + 3 * a * b * c / scale * rc) / total
    return _carlson(where(negative, principal, rj), (x, y, z, p), _two_zeros(x, y, z), valid)


def _sort(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """In ascending order, as a permutation: the slopes of minimum() and maximum() are means where two are equal."""
    low, high = _order(x, y)
    low, other = _order(low, z)
    return low, *_order(other, high)


def _order(x: Array, y: Array) -> tuple[Array, Array]:
    return where(x <= y, x, y), where(x <= y, y, x)
