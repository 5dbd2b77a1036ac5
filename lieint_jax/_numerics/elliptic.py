"""Elliptic functions and Carlson's integrals, in the dtype of their arguments: the basis of `lieint_jax.elliptic`.

All but R_J run a fixed number of iterations. R_J runs as many as it needs, and its derivatives two more.

m = k² is the parameter; the argument is always its complement m1 = 1 − m, so that nothing cancels near m = 1.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics.power_series import arctan_sqrt, horner
from lieint_jax._numerics.select import where
from lieint_jax._xla import forward_mode, materialized

_MEANS, _LANDEN, _DUPLICATIONS, _HALVINGS = 13, 5, 13, 8
_MOST = 24  # duplications of R_F for arguments of any ratio in the range of float64
_Duplicates = tuple[Array, Array, Array]  # three arguments, sums split off for the last of them, 4⁻ⁿ
_CLOSE = 0.1  # relative distance of the arguments of R_C, below which a series is summed


@forward_mode
def quarter_period(m1: Array) -> Array:
    """K = π / (2 agm(1, √m1)), for m1 ≥ 0. Relative error 3 eps.

    K is infinite at m1 = 0; here its value there is that at m1 = √tiny, 179 in float64 and 23 in float32.
    """
    start = jnp.ones_like(m1), jnp.sqrt(m1 + jnp.sqrt(jnp.finfo(m1.dtype).tiny))
    a, _ = lax.fori_loop(0, _MEANS, lambda _, ab: ((ab[0] + ab[1]) / 2, jnp.sqrt(ab[0] * ab[1])), start)
    return jnp.pi / 2 / a


def _jacobi_slopes(_: object, u: Array, m1: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """The slopes of `jacobi` by u and by m1, the latter by that of the amplitude, ∂am: one number, not three."""
    (sn, cn, dn), (by_sn, by_cn, _) = jax.jvp(lambda m1: _jacobi(u, m1), (m1,), (jnp.ones_like(m1),))
    [turn] = materialized((cn * by_sn - sn * by_cn,))
    product = (1 - m1) * sn * cn
    return (cn * dn, -sn * dn, -product), (cn * turn, -sn * turn, (sn * sn / 2 - product * turn) / dn)


@functools.partial(forward_mode, slopes=_jacobi_slopes)
def jacobi(u: Array, m1: Array) -> tuple[Array, Array, Array]:
    """sn u, cn u and dn u of parameter m = 1 − m1, for 0 ≤ m1 ≤ 1 and |u| up to a quarter period or two.

    By Landen's descending transformation for m1 ≥ ½, which ends at sin and cos, else by the ascending one, which ends
    at tanh and sech: neither has a singular derivative at its end. Error: a few eps relative to each function, and
    eps·|u| from the argument. Source: DLMF 22.7.
    """
    return _jacobi(u, m1)


def _jacobi(u: Array, m1: Array) -> tuple[Array, Array, Array]:
    circular = m1 >= 0.5
    descending = _descending(u, where(circular, m1, 1))
    ascending = _ascending(u, where(circular, 0, m1))
    sn, cn, dn = (where(circular, x, y) for x, y in zip(descending, ascending, strict=True))
    return sn, cn, dn


def _descending(u: Array, m1: Array) -> tuple[Array, Array, Array]:
    """Jacobi's functions by the descending transformation.

    With the means (a_n, b_n) of (1, √m1), s = sin(a_N u)/a_N the same at each stage, and x_N = cos(a_N u),

        x_{n−1} = x_n √((x_n² + b_n²s²) / (x_n² + a_n²s²)),    cs u = x₀/s

    There is no subtraction, so nothing cancels.
    """
    means = [(jnp.ones_like(m1), jnp.sqrt(m1))]
    for _ in range(_LANDEN):
        a, b = means[-1]
        means.append(((a + b) / 2, jnp.sqrt(a * b)))
    a, _ = means.pop()
    s, x = jnp.sin(a * u) / a, jnp.cos(a * u)
    for a, b in means[:0:-1]:
        x = x * jnp.sqrt((x * x + (b * s) ** 2) / (x * x + (a * s) ** 2))
    r = 1 / jnp.sqrt(x * x + s * s)
    return s * r, x * r, jnp.sqrt(x * x + m1 * s * s) * r


def _ascending(u: Array, m1: Array) -> tuple[Array, Array, Array]:
    """Jacobi's functions by the ascending transformation.

    With k′ = k′_n = (1 − k_{n−1})/(1 + k_{n−1}), and functions of u_n = u_{n−1}/(1 + k′_n) on the right,

    sn = (1 + k′) sn cn / dn,    cn = (dn² − k′) / ((1 − k′) dn),    dn = (dn² + k′) / ((1 + k′) dn)
    """
    moduli, square = [], m1
    for _ in range(_LANDEN):
        k1 = square / (1 + jnp.sqrt(1 - square)) ** 2
        u, square = u / (1 + k1), k1 * k1
        moduli.append(k1)
    sn, dn = jnp.tanh(u), 1 / jnp.cosh(u)
    cn = dn
    for k1 in reversed(moduli):
        r, square = 1 / dn, dn * dn
        sn, cn, dn = (1 + k1) * sn * cn * r, (square - k1) * r / (1 - k1), (square + k1) * r / (1 + k1)
    return sn, cn, dn


# Derivatives are those of two more duplications than a value needs.
@functools.partial(
    forward_mode,
    smooth=lambda root_x, root_y, root_z, p: _rj_value(_duplicate(root_x, root_y, root_z, p, more=2)),
)
def carlson_rj(root_x: Array, root_y: Array, root_z: Array, p: Array) -> Array:
    """R_J(x, y, z, p) = (3/2) ∫₀^∞ dt / ((t + p) √((t + x)(t + y)(t + z))), given the square roots of x, y and z.

    For p ≥ x, y, z ≥ 0, at most one of which is 0. The arguments are square roots so that derivatives are finite at 0;
    one root may be slightly negative, which continues the integral beyond a quarter period. By duplication, then a
    series of degree 7. Relative error 1e-15 for x, y ≥ 1e-60 z. Source: DLMF 19.26(iii), 19.36(i).

    It duplicates until the arguments are so close that the series has that error: 13 times at most, three or four times
    for arguments of one size.
    """
    return _rj_value(_duplicate(root_x, root_y, root_z, p))


@functools.partial(
    forward_mode,
    smooth=lambda root_x, root_y, root_z, p: _rj_value(_duplicate(root_x, root_y, root_z, p, more=2, ordered=False)),
)
def carlson_rj_of_any(root_x: Array, root_y: Array, root_z: Array, p: Array) -> Array:
    """`carlson_rj` for every p > 0; R_D(x, y, z) = R_J(x, y, z, z) among them.

    A p that is much larger than x, y and z needs log₄ of that ratio duplications.
    """
    return _rj_value(_duplicate(root_x, root_y, root_z, p, ordered=False))


@forward_mode
def carlson_rc(root_x: Array, root_y: Array) -> Array:
    """R_C(x, y) = ½ ∫₀^∞ dt / ((t + y) √(t + x)), given the square roots of x ≥ 0 and y > 0.

    By arctan for y > x, log for y < x, and a series in between, of which each is accurate beyond its threshold.
    """
    x, d = root_x * root_x, (root_y - root_x) * (root_y + root_x)
    near, above = jnp.abs(d) < 2 * _CLOSE * x, d > 0
    ratio = where(near, d, 0) / where(near, x, 1)
    series = horner([(-1) ** k / (2 * k + 1) for k in range(18)], ratio) / where(near, root_x, 1)
    root = jnp.sqrt(where(jnp.abs(d) > _CLOSE / 2 * x, jnp.abs(d), 1))
    far = where(above, jnp.arctan2(root, root_x), jnp.log((root_x + root) / root_y)) / root
    return where(jnp.abs(d) < _CLOSE * x, series, far)


def _duplicate(
    root_x: Array, root_y: Array, root_z: Array, p: Array, more: int = 0, ordered: bool = True
) -> _Duplicated:
    """The arguments of R_J, duplicated until they are close; `ordered` if p ≥ x, y, z."""
    start = _Duplicated.from_roots((root_x, root_y, root_z), p)
    return lax.while_loop(lambda state: jnp.any(state.far), lambda state: state.next(more, ordered), start)


class _Duplicated(NamedTuple):
    """The arguments of R_J after n duplications.

    `far` is whether the error of the series, the eighth power of the relative distances, would be too large. It is
    stored because a batched `while_loop` evaluates its condition twice, to continue and to accept a member's result:
    if it were computed twice with different rounding, the loop might never end.
    """

    x: Array
    y: Array
    z: Array
    p: Array
    mean: Array  # of the arguments, with the weights 1, 1, 1, 2
    roots: tuple[Array, Array, Array]  # of x, y, z; one of the first may be negative
    scale: Array  # 4⁻ⁿ
    total: Array  # of the terms that the duplications have split off
    apart: tuple[Array, Array, Array]  # the distances of the first x, y, z from the first mean
    delta: Array  # (p − x)(p − y)(p − z) of the first
    far: Array

    @classmethod
    def from_roots(cls, roots: tuple[Array, Array, Array], p: Array) -> _Duplicated:
        x, y, z = (root * root for root in roots)
        mean = (x + y + z + 2 * p) / 5
        apart, delta = (mean - x, mean - y, mean - z), (p - x) * (p - y) * (p - z)
        one = jnp.ones_like(mean)
        return cls(x, y, z, p, mean, roots, one, jnp.zeros_like(mean), apart, delta, one > 0)

    def next(self, more: int, ordered: bool) -> _Duplicated:
        """The arguments after one more duplication; `more` duplications follow once the series is good enough."""
        a, b, c = self.roots
        r = jnp.sqrt(self.p)
        d = (r + a) * (r + b) * (r + c)
        shift = a * b + b * c + c * a
        if ordered:
            square = self.scale**3 * self.delta / (d * d)
            square = where(square < 0, 0, square)  # maximum() has half the slope at 0, where p is one of x, y, z
            part = arctan_sqrt(square)
        else:  # R_C(1, 1 + e) with 1 + e as a sum of positive terms: it is near 0 where p is much less than x, y or z
            part = carlson_rc(jnp.ones_like(r), jnp.sqrt(2 * r * (self.p + shift) / d))
        term = self.scale / d * part
        x, y, z, p, mean = ((v + shift) / 4 for v in self[:5])
        scale, most = self.scale / 4, functools.reduce(jnp.maximum, map(jnp.abs, self.apart))
        small = (jnp.finfo(most.dtype).eps / 8) ** 0.125 * mean
        least = 0.25 ** (_DUPLICATIONS + more) if ordered else 16 * jnp.finfo(most.dtype).tiny
        far = (scale * most > small * 0.25**more) & (scale > least)
        roots = (jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z))
        return _Duplicated(x, y, z, p, mean, roots, scale, self.total + term, self.apart, self.delta, far)


def _rj_value(state: _Duplicated) -> Array:
    X, Y, Z = (state.scale * v / state.mean for v in state.apart)
    return state.scale / (state.mean * jnp.sqrt(state.mean)) * _rj_series(X, Y, Z) + 6 * state.total


@forward_mode
def carlson_rf(root_x: Array, root_y: Array, root_z: Array) -> Array:
    """R_F(x, y, z), given the square roots of x, y, z ≥ 0 of any ratio, at most one of which is 0 or slightly negative.

    The roots as in `carlson_rj`.
    """
    return _rf_rd((root_x, root_y, root_z), _MOST)[0]


def carlson_rf_rd(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
    """R_F(x, y, z), and R_D(y, z, x), R_D(z, x, y), R_D(x, y, z), for positive x, y, z of moderate ratios.

    R_F = ½ ∫₀^∞ dt/√((t + x)(t + y)(t + z)), and R_D has a factor 3/(t + its last argument) in the integrand. By
    duplication, then series of degree 7. Source: DLMF 19.26(iii), 19.36(i).
    """
    return _rf_rd((jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z)), _HALVINGS)


def _rf_rd(first: tuple[Array, Array, Array], duplications: int) -> tuple[Array, Array, Array, Array]:
    at, totals, scale = lax.fori_loop(
        1, duplications, lambda _, carry: _duplicate_all(jnp.sqrt(carry[0]), carry), _first_duplicate(first, 3)
    )
    A = (at[0] + at[1] + at[2]) / 3
    X, Y = 1 - at[0] / A, 1 - at[1] / A
    E2, E3 = -X * X - X * Y - Y * Y, -X * Y * (X + Y)
    series = 1 - E2 / 10 + E3 / 14 + E2 * E2 / 24 - 3 * E2 * E3 / 44 - 5 * E2**3 / 208 + 3 * E3 * E3 / 104
    RF = (series + E2 * E2 * E3 / 16) / jnp.sqrt(A)
    x, y, z = (_rd_value(at, k, totals[k], scale) for k in range(3))
    return RF, x, y, z


def _first_duplicate(first: tuple[Array, Array, Array], sums: int) -> _Duplicates:
    roots = jnp.stack(first)
    return _duplicate_all(roots, (roots * roots, jnp.zeros_like(roots[:sums]), jnp.ones_like(first[0])))


def _duplicate_all(roots: Array, duplicates: _Duplicates) -> _Duplicates:
    at, totals, scale = duplicates
    a, b, c = roots
    shift, n = a * b + b * c + c * a, len(totals)
    return (at + shift) / 4, totals + scale / (roots[-n:] * (at[-n:] + shift)), scale / 4


def _rd_value(at: Array, k: int, total: Array, scale: Array) -> Array:
    """R_D with the argument k as its last one."""
    A = (at[0] + at[1] + at[2] + 2 * at[k]) / 5
    X, Y = 1 - at[k - 2] / A, 1 - at[k - 1] / A
    return scale / (A * jnp.sqrt(A)) * _rj_series(X, Y, -(X + Y) / 3) + 3 * total


@functools.partial(forward_mode, smooth=lambda root_x, root_y, root_z: _rds((root_x, root_y, root_z), more=2))
def carlson_rds(root_x: Array, root_y: Array, root_z: Array) -> tuple[Array, Array]:
    """R_D(x, z, y) and R_D(x, y, z), given the square roots of x ≥ 0, which may be slightly negative, and of y, z > 0.

    By duplication until a series of degree 7 is good enough. Source: DLMF 19.26(iii), 19.36(i).
    """
    return _rds((root_x, root_y, root_z))


def _rds(first: tuple[Array, Array, Array], more: int = 0) -> tuple[Array, Array]:
    small = 0.25**more * (float(jnp.finfo(first[0].dtype).eps) / 8) ** 0.125

    def with_flag(duplicates: _Duplicates) -> tuple[_Duplicates, Array]:
        least, most = (functools.reduce(choose, duplicates[0]) for choose in (jnp.minimum, jnp.maximum))
        return duplicates, most - least > small * least

    (at, totals, scale), _ = lax.while_loop(
        lambda state: jnp.any(state[1]),
        lambda state: with_flag(_duplicate_all(jnp.sqrt(state[0][0]), state[0])),
        with_flag(_first_duplicate(first, 2)),
    )
    return _rd_value(at, 1, totals[0], scale), _rd_value(at, 2, totals[1], scale)


def _rj_series(X: Array, Y: Array, Z: Array) -> Array:
    """The series of R_J of degree 7, DLMF 19.36.2."""
    P = -(X + Y + Z) / 2
    XYZ = X * Y * Z
    E2 = X * Y + X * Z + Y * Z - 3 * P * P
    E3 = XYZ + 2 * E2 * P + 4 * P**3
    E4 = (2 * XYZ + E2 * P + 3 * P**3) * P
    E5 = XYZ * P * P
    low = 1 - 3 * E2 / 14 + E3 / 6 + 9 * E2 * E2 / 88 - 3 * E4 / 22 - 9 * E2 * E3 / 52 + 3 * E5 / 26
    six = -(E2**3) / 16 + 3 * E3 * E3 / 40 + 3 * E2 * E4 / 20
    return low + six + 45 * E2 * E2 * E3 / 272 - 9 * (E3 * E4 + E2 * E5) / 68
