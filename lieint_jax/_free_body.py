"""The motion of the free rigid body in closed form, for any inertia, momentum and time.

Units |Π| = 1 and tr J = 1: e = Π/|Π|, τ = |Π|t/tr J, b_i = tr J/J_i. The axes r, m, o are right-handed: m is that of
middle inertia; of the other two, r is the one from which π stays away, e_r² ≤ ½ at all times. Euler's equations are

    ė_r = (b_o − b_m) e_m e_o,    ė_m = (b_r − b_o) e_o e_r,    ė_o = (b_m − b_r) e_r e_m

**Body momentum.** Let

    f_r = (b_r − b_m)[(b_r − b_o)e_r² + (b_m − b_o)e_m²],    f_o = (b_o − b_m)[(b_o − b_r)e_o² + (b_m − b_r)e_m²]

be constants, f the greater and f′ the smaller one; e circulates about the axis of the greater. With S = sn(√f τ)/√f, cn
and dn of parameter f′/f, the addition theorems of sn, cn, dn move e without any initial phase:

    e_m(τ) = [e_m cn dn + S ė_m]/D,    e_r(τ) = [e_r q_r + S q_o ė_r]/D,    e_o(τ) = [e_o q_o + S q_r ė_o]/D

where q = dn for the axis c of circulation and cn for the other, and D = cn² + S²(b_r − b_o)(b_c − b_m) e_c² up to the
sign that makes it a sum. S, cn, dn are smooth in f and f′ ≥ 0, so symmetric and spherical bodies (f′ = 0, f = 0) and
the separatrix (f = f′) are no special cases.

**Attitude.** Axis r rotates about π by the angle

    φ = b_o τ − (b_o − b_r) ν X + θ,    X = ∫₀^τ S²/(1 + νS²) dτ,    ν = (b_m − b_o)[(b_r − b_o)e_r² + (b_m − b_o)e_m²]
    θ = arctan2((b_m − b_o) S e_m e_m(τ),  1 − e_r(τ)² − (b_m − b_o) S e_m e_r(τ) e_o(τ))

where X is S³ R_J(cn², dn², 1, 1 + νS²)/3 up to a quarter period, and θ comes from the addition theorem of Legendre's
integral of the third kind. With ψ the azimuth of e about r, and "e → r" the shortest rotation from e to r,

    Λ(τ) = Λ (r → e)(rotation about r by φ + ψ − ψ(τ))(e(τ) → r)

The vector whose angle an arctangent computes has at least length ½. The quaternion's sign is continuous in time.

**Clock.** The symplectic step of 1/J̃ = s/J + d, 2y = τ(s b + d)·½(e + e(τ)), h = (1 + |h|²) y, is exactly this motion
for the right s and d. They are constant along the trajectory, and computed where the step is symmetric: from −τ/2 to
τ/2 about a passage of e_m through 0. With S, q, χ = b_o τ/2 − (b_o − b_r) ν X all at τ/2, and ν = (b_m − b_o) R,

    ℓ = cos χ − R S (q_r/q_o) sin χ,    s = ℓ² S q_o/(½τ q_r (1 + νS²)),    s b_o + d = ℓ sin χ/(½τ)

where q_o ℓ/√(1 + νS²) is the cosine of half the angle of the step, and no divisor can vanish.

**Mean periods**, for moments A ≤ B ≤ C about the axes x (long), y, z (short), L = |Π|. With

    f = (B − A)(2HC − L²)/(ABC),    g = (C − B)(L² − 2HA)/(ABC),    m = min(f, g)/max(f, g)

Π goes round the long axis in the body if f > g (long-axis mode), else round the short one, in 4K(m)/√max(f, g). The
long axis goes round π at the mean rate of φ̇ = L (2H − Π_x²/A)/(L² − Π_x²), with K − Π(−ν, m) = ν R_J(0, 1−m, 1,
1+ν)/3:

    L [1/C + (1/A − 1/C)(1 − Π(−ν, m)/K)],    ν = A(C − B)/(C(B − A)) if f > g, else A(2HC − L²)/(C(L² − 2HA))

**Tangents** need two more integrals, W = ∫S² dτ and W_dn = ∫S²/dn² dτ, by R_D: see `_slopes_of_phases` for those of
S, cn, dn, and `_tangent_of_increment` for that of the attitude.

Sources: Jacobi 1850; for the addition theorems DLMF 22.8 and 19.11; the form without phases and cases: this package.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._numerics import elliptic, vectors
from lieint_jax._numerics.arrays import Inertia, PyTree, Quaternion, Vector3
from lieint_jax._numerics.select import where
from lieint_jax._numerics.vectors import Matrix, Vector, VectorLike, cross, dot, matrix, norm
from lieint_jax._xla import forward_mode, jvp_of_varied, materialized
from lieint_jax.groups import so3

_Turns = list[tuple[int, Array]]
_FAR = 1e7  # the ν from which Legendre's third integral is computed by its first term for large ν
_BISECTIONS = 50  # of the energies of a mode, then one step of Newton's method, which has the derivative
_EXCLUDED = 1e-12  # fraction of a mode's range of energies that has no ratio of periods, at either end
_ROUNDING = 100  # the errors of R in eps that are those of rounding
_NEAR = 1e-5  # the f τ² below which S, cn, dn are computed by series, with an error of 1e-17


class Accuracy(NamedTuple):
    """The rounding errors of a motion.

    Attributes:
        length: | |e(τ)|² − 1 |, the error of the momentum's length in the body.
        condition: the condition number: relative errors eps of the state and of t change the attitude by about
            condition·eps.
    """

    length: Array
    condition: Array


def attitude(inertia: Inertia, q: Quaternion, p: Vector3, t: ArrayLike) -> tuple[Array, Accuracy]:
    """The attitude after time t of a free body with initial attitude q and constant spatial momentum π.

    Args:
        inertia: principal moments (3,) or a symmetric tensor (3, 3).
        q: unit quaternion, shape (4,).
        p: π, shape (3,).
        t: time, of any size and sign.

    Returns:
        The unit quaternion at t, shape (4,), and its rounding errors.

    Derivatives are right to round-off for principal (3,) moments, equal or not, and for a full tensor of distinct
    ones. For a full tensor with moments equal to within √eps they are finite, but omit the change of the inertia's
    off-diagonal elements between the equal axes.
    """
    J, Pi = vectors.symmetric(inertia), so3.Ad_star(q, p)
    scale, G, e, rest = _units(inertia, Pi)
    (w, *v), accuracy = _increment(scale * inertia, e, G * t)
    v = Vector(where(rest, x, y) for x, y in zip(J.solve(Pi) * t / 2, v, strict=True))  # 0, with its derivative in π
    w, square = where(rest, 1, w), dot(v, v)
    n, d = jnp.sqrt(w * w + square), so3.defect(q) / 2
    less = where(w > 0, -square / (n * (n + jnp.abs(w))), w / n - 1)  # w/n − 1 without cancellation
    increment = materialized((less - d * w / n, *((1 - d) / n * v)))  # with |q| corrected, as in `cayley_increment`
    turned = lax.stop_gradient(vectors.max_abs(Pi) * J.inverse_trace * jnp.abs(t))
    length, condition = (where(rest, 0, x) for x in accuracy)
    return q + so3.multiply(q, increment), Accuracy(length, turned + condition)


def clock(inertia: Inertia, Pi: Vector3, t: ArrayLike) -> tuple[Array, Array, Array]:
    """s and d of the inertia J̃ = J(s + dJ)⁻¹ whose symplectic step of size t is the exact motion.

    Args:
        inertia: as in `attitude`.
        Pi: body momentum, shape (3,).
        t: the size of the step.

    Returns:
        s; d in the unit of 1/inertia; and whether there is such a step, one that rotates the body by at most 90°. All
        three are the same for every Π of a trajectory, and they are 1, 0 and True at rest and for t = 0.
    """
    scale, G, e, rest = _units(inertia, Pi)
    still = rest | (jnp.asarray(t) == 0)
    if inertia.ndim == 1:
        moments, turns = _ascending_moments(scale * inertia)
        e = _permute(e, turns, 1)
    else:
        moments, V = principal_axes(scale * inertia)
        e = matrix(V).T @ e
    s, d, on_branch = _ascending_clock(moments, e, where(still, 1e-3, G * t))
    return where(still, 1, s), where(still, 0, scale * d), still | on_branch


class Periods(NamedTuple):
    """The two mean periods of a tumbling free body, both defined by its long axis, whatever the mode.

    The long axis is that of the least moment of inertia. φ and ψ are Euler angles, with the long axis as the third axis
    of the body and the angular momentum π along the third axis of space. Periods are in the unit of time of the state.

    Attributes:
        precession: P_φ = 2π over the mean rate of φ: the mean time in which the long axis goes once around π. Infinite
            for a body at rest.
        rotation: P_ψ, the time in which Π and Ω repeat in the axes of the body: a rotation of the body about its long
            axis (ψ advances by 2π) in the long-axis mode, an oscillation about it in the short-axis mode. Infinite for
            a body at rest and for a sphere. On the separatrix it is infinite too, but the number returned depends on
            rounding.
        long_axis: the mode: True where Π goes around the axis of least moment (long-axis mode), False where it goes
            around that of greatest moment (short-axis mode).
    """

    precession: Array
    rotation: Array
    long_axis: Array

    @property
    def of_circled_axis(self) -> Array:
        """The mean time in which the axis that Π goes around, the long or the short one, goes once around π.

        The short axis precesses by one more revolution in each rotation than the long one.
        """
        return where(self.long_axis, self.precession, 1 / (1 / self.precession + 1 / self.rotation))


def periods(inertia: Inertia, Pi: Vector3) -> Periods:
    """The mean periods of a free body of body momentum Π, (3,); `inertia` as in `attitude`."""
    if inertia.ndim == 1:
        moments, turns = _ascending_moments(inertia)
        x, y, z = _permute(vectors.components(Pi), turns, 1)
    else:
        moments, V = principal_axes(inertia)
        x, y, z = matrix(V).T @ Pi
    A, B, C = moments
    above = x * x * (C / A - 1) + y * y * (C / B - 1)  # 2HC − L²
    below = y * y * (1 - A / B) + z * z * (1 - A / C)  # L² − 2HA
    f, g = (B - A) * above / (A * B * C), (C - B) * below / (A * B * C)
    long_axis = f > g
    fast = where(long_axis, f, g)
    still = fast == 0
    fast = where(still, 1, fast)
    m1 = where(still, 1, jnp.abs(f - g) / fast)
    K = elliptic.quarter_period(m1)
    over = where(long_axis, A * (C - B), A * above)
    under = where(long_axis, C * (B - A), C * below)
    on_edge = under == 0  # a symmetric body, π across its axis: ν is infinite, Π(−ν, m) vanishes
    nu = over / where(on_edge, 1, under)
    square = x * x + y * y + z * z
    rest = square == 0
    part = where(on_edge, 1, _less_third(m1, nu, K))
    rate = jnp.sqrt(where(rest, 1, square)) * (1 / C + (1 / A - 1 / C) * part)
    rotation = where(still, jnp.inf, 4 * K / jnp.sqrt(fast))
    return Periods(where(rest, jnp.inf, 2 * jnp.pi / rate), rotation, long_axis)


def on_axes(moments: Array, s: Array, long_axis: bool) -> Array:
    """The unit Π in the plane of the long and the short axis at the fraction s of the energies of a mode.

    2HC/|Π|² goes from 1 (s = 0) to the separatrix, C/B, in short-axis modes, from there to C/A in long-axis modes.

    Args:
        moments: A ≤ B ≤ C, (3,).
        s: from 0 to 1.
        long_axis: the mode.
    """
    A, B, C = vectors.components(moments)
    above = C / B - 1 + s * (C / A - C / B) if long_axis else s * (C / B - 1)
    square = above * A / (C - A)
    return jnp.stack([jnp.sqrt(square), 0 * square, jnp.sqrt(1 - square)])


def period_ratio(moments: Array, s: Array, long_axis: bool) -> Array:
    """P_ψ/P_φ at the fraction s of a mode's energies, which has no unit: it grows toward the separatrix."""
    found = periods(moments, on_axes(moments, s, long_axis))
    return found.rotation / found.precession


def momentum_of_ratio(moments: Array, ratio: Array, long_axis: bool) -> Array:
    """The unit Π of `on_axes` at which P_ψ/P_φ is `ratio`, by bisection, with its first derivatives; or NaN."""
    sign, fixed, wanted = -1 if long_axis else 1, lax.stop_gradient(moments), lax.stop_gradient(ratio)

    def bisect(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (bounds[0] + bounds[1]) / 2
        low = sign * (period_ratio(fixed, middle, long_axis) - wanted) < 0
        return where(low, middle, bounds[0]), where(low, bounds[1], middle)

    zero = jnp.zeros_like(wanted)
    low, high = lax.fori_loop(0, _BISECTIONS, bisect, (zero, zero + 1))
    s = (low + high) / 2
    _, slope = jax.jvp(lambda s: period_ratio(fixed, s, long_axis), (s,), (jnp.ones_like(s),))
    found = on_axes(moments, s - (period_ratio(moments, s, long_axis) - ratio) / slope, long_axis)
    return where(mode_exists(fixed, wanted, long_axis), found, jnp.nan)


def mode_exists(moments: Array, ratio: Array, long_axis: bool) -> Array:
    """Whether a mode of this body has the ratio P_ψ/P_φ.

    The least ratio is that of a small wobble; the greatest is evaluated next to the separatrix, where the
    ratio grows without bound, but rounding leaves no digits.
    """
    ends = jnp.asarray([1 - _EXCLUDED, _EXCLUDED] if long_axis else [_EXCLUDED, 1 - _EXCLUDED])
    least, most = jax.vmap(lambda s: period_ratio(moments, s, long_axis))(ends)
    return (least < ratio) & (ratio < most)


def momentum_at_phase(J: Array, unit: Array, psi: Array) -> Array:
    """The unit Π at the phase ψ, by Jacobi's functions of 2Kψ/π; `unit` is that at ψ = 0, in the x-z plane."""
    (A, B, C), (x, _, z) = vectors.components(J), vectors.components(unit)
    above, below = x * x * (C / A - 1), z * z * (1 - A / C)  # 2HC − 1 and 1 − 2HA
    f, g = (B - A) * above, (C - B) * below
    long_axis, fast = f > g, jnp.maximum(f, g)
    m1 = jnp.abs(f - g) / fast
    halves = lax.stop_gradient(jnp.round(psi / jnp.pi))
    sn, cn, dn = elliptic.jacobi(elliptic.quarter_period(m1) * (psi - jnp.pi * halves) * 2 / jnp.pi, m1)
    odd = _sign_after(halves)
    y = jnp.sqrt(B * jnp.where(long_axis, below / (B - A), above / (C - B)))
    ratios = jnp.where(long_axis, dn, odd * cn), odd * sn, jnp.where(long_axis, odd * cn, dn)
    return jnp.stack([x * ratios[0], y * ratios[1], z * ratios[2]])


def _less_third(m1: Array, nu: Array, K: Array) -> Array:
    """1 − Π(−ν, m)/K; above ν = 1e7, where R_J loses its digits, by its first term for large ν, to 1/ν."""
    root = jnp.sqrt(m1 + jnp.sqrt(jnp.finfo(m1.dtype).tiny))  # as in K, or their ratio is wrong on the separatrix
    far = nu > _FAR
    near = where(far, 1, nu)
    part = elliptic.carlson_rj(jnp.zeros_like(m1), root, jnp.ones_like(m1), 1 + near) * near / (3 * K)
    return where(far, 1 - jnp.pi / (2 * K * jnp.sqrt(1 + nu)), part)


def _units(inertia: Inertia, Pi: Vector3) -> tuple[Array, Array, Vector, Array]:
    """1/tr J, |Π|/tr J, e, and whether the body is at rest; at rest |Π|/tr J is set to 1 and e to a unit vector."""
    scale = 1 / vectors.symmetric(inertia).trace
    scaled = scale * vectors.vector(Pi)
    square = dot(scaled, scaled)
    rest = square == 0
    G = jnp.sqrt(where(rest, 1, square))
    return scale, G, Vector(materialized([where(rest, math.sqrt(1 / 3), x) for x in scaled / G])), rest


def _increment(inertia: Inertia, e: Vector, tau: Array) -> tuple[tuple[Array, ...], Accuracy]:
    """Λ⁻¹Λ(τ) in body axes, as a quaternion times a positive number, and its rounding errors."""
    if inertia.ndim == 1:
        moments, turns = _ascending_moments(inertia)
        w, v, accuracy = _ascending_increment(moments, _permute(e, turns, 1), tau)
        return (w, *_permute(v, turns, -1)), accuracy
    moments, V = principal_axes(inertia)
    a, b, _ = matrix(V).T  # made right-handed, and orthonormal to the last bit
    a = _unit(a)
    b = _unit(b - dot(a, b) * a)
    axes = Matrix((a, b, cross(a, b)))
    w, v, accuracy = _ascending_increment(moments, axes @ e, tau)
    return (w, *(axes.T @ v)), accuracy


def _ascending_moments(J: Array) -> tuple[Vector, _Turns]:
    """The moments J in ascending order, and the quarter turns that permute the axes so.

    Component by component: a gather by `argsort` would end XLA's loop over a batch before and after it.
    """
    moments, turns = list(vectors.components(J)), []
    for i in (0, 1, 0):
        a, b = moments[i : i + 2]
        turns.append((i, a > b))
        moments[i : i + 2] = where(a > b, b, a), where(a > b, a, b)
    return Vector(moments), turns


def _permute(v: VectorLike, turns: _Turns, sign: int) -> Vector:
    """v after quarter turns that exchange the components i and i + 1, forwards (sign 1) or backwards (sign −1)."""
    x = list(v)
    for i, turn in turns[::sign]:
        a, b = x[i : i + 2]
        x[i : i + 2] = where(turn, sign * b, a), where(turn, -sign * a, b)
    return Vector(x)


def _unit(v: Vector) -> Vector:
    return 1 / norm(v) * v


@jax.custom_jvp
def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """The moments of a tensor (3, 3) in ascending order, and their axes as columns."""
    return tuple(jnp.linalg.eigh(inertia))


@principal_axes.defjvp
def _principal_axes_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    w, V = principal_axes(*primals)
    M = V.T @ tangents[0] @ V
    M = (M + M.T) / 2
    gap = w[None, :] - w[:, None]
    equal = jnp.abs(gap) <= jnp.sqrt(jnp.finfo(w.dtype).eps) * w[2]
    turn = where(equal, 0, M / where(equal, 1, gap))
    return (w, V), (jnp.stack([M[0, 0], M[1, 1], M[2, 2]]), V @ turn)


class _Labels(NamedTuple):
    """b_o, and the differences b_r − b_m, b_m − b_o, b_r − b_o: all of one sign."""

    b_o: Array
    rm: Array
    mo: Array
    ro: Array


def _labels(J: VectorLike, e: Vector) -> tuple[Array, _Labels]:
    """True if axis 0 of the ascending moments J is r, False if axis 2 is (then m is reversed); and the labels."""
    d01, d12, d02 = ((J[j] - J[i]) / (J[i] * J[j]) for i, j in ((0, 1), (1, 2), (0, 2)))  # b_i − b_j
    x, y, z = (c * c for c in e)
    far0, far2 = d02 * x + d12 * y, d02 * z + d01 * y
    first = (far0 < far2) | ((far0 == far2) & (x <= z))
    b_o, rm = where(first, 1 / J[2], 1 / J[0]), where(first, d01, -d12)
    return first, _Labels(*materialized((b_o, rm, where(first, d12, -d01), where(first, d02, -d02))))


def _relabel(first: Array, v: VectorLike) -> Vector:
    """The components of v on the axes r, m, o from those on the axes 0, 1, 2, or back."""
    return Vector((where(first, v[0], v[2]), where(first, v[1], -v[1]), where(first, v[2], v[0])))


def _ascending_increment(J: VectorLike, e: Vector, tau: Array) -> tuple[Array, Vector, Accuracy]:
    """Λ⁻¹Λ(τ) as scalar and vector part, and its rounding errors, for ascending moments J."""
    first, b = _labels(J, e)
    w, v, accuracy = _labeled_increment(b, Vector(materialized(_relabel(first, e))), tau)
    return w, _relabel(first, v), accuracy


@jax.custom_jvp
def _labeled_increment(b: _Labels, e: Vector, tau: Array) -> tuple[Array, Vector, Accuracy]:
    """Λ⁻¹Λ(τ) as scalar and vector part, times a positive number, and its rounding errors, in the axes r, m, o."""
    return _from_motion(b, e, _motion(b, e, tau))


@functools.partial(_labeled_increment.defjvp, symbolic_zeros=True)
def _tangent_of_increment(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """The tangent, by the conservation of momentum and the principle of least action.

    Momentum is constant in space, Λ e(τ) = e: so the rotation η of the end, in body axes, has η × e(τ) = Λᵀδe − δe(τ).
    The action is ∫½Ω·JΩ dτ = hτ with 2h = b_o + R: so

        e(τ)·η = δ(hτ) + h δτ + ½ Σ δb_i ∫e_i² dτ,    ∫e_m² dτ = R (b_r − b_o − R) W + S e_m e_m(τ)

    with W = ∫S² dτ; ∫e_r² dτ follows as R is constant, and ∫e_o² dτ as |e| is 1.
    """
    b, e, tau = primals

    def end(b: _Labels, e: Vector, tau: Array) -> tuple[tuple[Vector, Vector, Array], _Motion]:
        m = _motion(b, e, tau)
        return (e, _change(b, e, m), b.b_o + m.R), m

    (_, change, h), (de, dchange, dh), m = jvp_of_varied(end, primals, tangents)
    f = e + _signed(m, change, e)
    _, greater, _, m1 = _frequencies(b.rm, b.mo, m.R, m.h, m.away)
    _, W = _integrals(m.S, m.cn, m.dn, greater, m1, m.halves)
    about_m = m.R * m.h * W + m.S * e[1] * f[1] * m.signs[1]
    sphere, y = b.ro == 0, e[1] * e[1]
    growth = where(sphere, tau * tau * e[0] * e[1] * e[2], (about_m - y * tau) / where(sphere, 1, b.ro))
    about_r = e[0] * e[0] * tau - b.mo * growth

    def explicit(b: _Labels, _: Vector, t: Array) -> tuple[Array, None]:
        return b.b_o * tau + b.ro * about_r + b.mo * about_m + 2 * h * t, None

    w, v, accuracy = _from_motion(b, e, m)
    turned = 2 / (w * w + dot(v, v)) * cross(v, cross(v, de) - w * de)  # Λᵀδe − δe
    _, along, _ = jvp_of_varied(explicit, primals, tangents)
    eta = cross(f, turned - _signed(m, dchange, de)) + (dh * tau + along) / 2 * f
    tangent = -dot(v, eta) / 2, (w * eta + cross(v, eta)) / 2, jax.tree.map(jnp.zeros_like, accuracy)
    return (w, v, accuracy), tangent


def _euler(b: _Labels, e: Vector) -> tuple[Array, Array, Array]:
    """ė by Euler's equations."""
    er, em, eo = e
    return -b.mo * em * eo, b.ro * eo * er, -b.rm * er * em


def _change(b: _Labels, e: Vector, m: _Motion) -> Vector:
    """e(τ) − e free of cancellation, less the signs of half periods."""
    er, em, eo = e
    rate, k = _euler(b, e), b.ro * where(m.about_r, b.rm * er * er, b.mo * eo * eo)  # k = (D − cn²)/S²
    common, together = b.rm * b.mo * em * em, m.cn + m.dn
    middle = where(m.about_r, m.excess, -m.excess) * m.cn / where(together == 0, 1, together) - k
    r = m.S / (m.cn * m.cn + m.S * m.S * k)
    change = (  # q_r − D = S²(common − f_o/(1 + q_r)), and so on
        r * (er * m.S * (common - m.f_o / (1 + m.q_r)) + m.q_o * rate[0]),
        r * (em * m.S * middle + rate[1]),
        r * (eo * m.S * (common - m.f_r / (1 + m.q_o)) + m.q_r * rate[2]),
    )
    return Vector(materialized(change))


def _signed(m: _Motion, change: Vector, e: Vector) -> Vector:
    """e(τ) − e with the signs of half periods."""
    return Vector(s * x + (s - 1) * y for s, x, y in zip(m.signs, change, e, strict=True))


def _from_motion(b: _Labels, e: Vector, m: _Motion) -> tuple[Array, Vector, Accuracy]:
    er, em, eo = e
    change = Vector(materialized(_on_polhode(b, m.R, e, _change(b, e, m))))
    fr, fm, fo = f = e + change
    theta = jnp.arctan2(b.mo * m.S * em * fm, 1 - fr * fr - b.mo * m.S * em * fr * fo)
    length, signs = jnp.abs(dot(f, f) - 1), m.signs
    change = _signed(m, change, e)
    _, fm, fo = e + change
    azimuth = jnp.arctan2(signs[2] * (em * change[2] - eo * change[1]), signs[2] * (em * fm + eo * fo))
    azimuth = azimuth - where(m.about_r, jnp.pi * m.halves * jnp.sign(er * b.rm), 0)
    twist = (m.turn + theta - azimuth) / 2
    w, v = _rotation_between(e, change, *materialized((jnp.cos(twist), jnp.sin(twist))))
    return w, v, Accuracy(*lax.stop_gradient((length, m.condition)))


def _on_polhode(b: _Labels, R: Array, e: Vector, change: Vector) -> Vector:
    """f − e without its rounding errors in |f|² and R: those of S, cn, dn are the same at every step, and add up.

    Where the gradient of R along the sphere vanishes, an error of f does not change R, and R is not corrected, unless
    its error is more than rounding: beside the middle axis, to all digits, those of S, cn, dn cancel.
    """
    e, given, b, R = lax.stop_gradient((e, change, b, R))
    f = e + given
    squares = Vector(d * (x + y) for d, x, y in zip(given, e, f, strict=True))  # f² − e², component by component
    long = sum(squares) / 2
    x, y, z = f - long * f
    g = Vector((2 * (b.ro - R) * x, 2 * (b.mo - R) * y, -2 * R * z))
    off = b.ro * squares[0] + b.mo * squares[1] - 2 * long * R
    precision = jnp.finfo(off.dtype)
    rounding = jnp.abs(off) <= _ROUNDING * precision.eps * jnp.abs(R)
    floor = where(rounding, where(b.ro == 0, 1, b.ro * b.ro / 4), jnp.abs(off * b.ro) + precision.tiny)
    square = jnp.maximum(dot(g, g), floor)
    by, bent = off / square, b.ro * g[0] * g[0] + b.mo * g[1] * g[1] - R * dot(g, g)  # off = by·g² − by²·bent
    return change - long * f - by * (1 + by * bent / square) * g


def _ascending_clock(J: VectorLike, e: Vector, tau: Array) -> tuple[Array, Array, Array]:
    """`clock` for ascending moments J of trace 1 and τ ≠ 0."""
    first, b = _labels(J, e)
    half = tau / 2
    m = _motion(b, _relabel(first, e), half)
    c, s = jnp.cos(m.turn), jnp.sin(m.turn)
    lag = c - m.R * m.S * (m.q_r / m.q_o) * s
    size = 1 + m.nu * m.S * m.S
    scale = m.S * m.q_o * lag * lag / (half * m.q_r * size)
    # On the polhode e_0² is at most e_0² + e_1² (b_1 − b_2)/(b_0 − b_2), which bounds |Ω| where J_0 is small
    sphere = J[2] == J[0]
    share = where(sphere, 1, J[0] * (J[2] - J[1]) / (J[1] * where(sphere, 1, J[2] - J[0])))
    fastest = (e[0] * e[0] + share * e[1] * e[1]) / (J[0] * J[0]) + 1 / (J[1] * J[1])  # ≥ |Ω|²
    not_about_720 = tau * tau * fastest <= (2 * math.pi) ** 2
    small_turn = (m.q_o * lag >= jnp.sqrt(size / 2)) & not_about_720
    return scale, s * lag / half - scale * b.b_o, small_turn


def _sign_after(halves: Array) -> Array:
    """The sign that sn and cn have after so many half periods."""
    return 1 - 2 * jnp.abs(halves % 2)


class _Motion(NamedTuple):
    """The functions of τ that move e, less `halves` half periods, and turn = b_o τ − (b_o − b_r) ν X.

    `condition` is that of the phase along the polhode: a half period is ½ log of f_r − f_o near the separatrix, where
    the two are equal, so a change of e alters it by that of f_r − f_o, relative.
    """

    about_r: Array
    R: Array
    h: Array
    away: Array
    nu: Array
    S: Array
    cn: Array
    dn: Array
    f_r: Array
    f_o: Array
    excess: Array
    halves: Array
    turn: Array
    condition: Array

    @property
    def q_r(self) -> Array:
        return where(self.about_r, self.dn, self.cn)

    @property
    def q_o(self) -> Array:
        return where(self.about_r, self.cn, self.dn)

    @property
    def signs(self) -> tuple[Array, Array, Array]:
        """The signs that e(τ) has after `halves` half periods."""
        odd = _sign_after(self.halves)
        return where(self.about_r, 1, odd), odd, where(self.about_r, odd, 1)


def _motion(b: _Labels, e: Vector, tau: Array) -> _Motion:
    x, y, z = (c * c for c in e)
    R, h, away = materialized((b.ro * x + b.mo * y, b.ro * z + b.rm * y, b.rm * x - b.mo * z))
    f_r, f_o, nu, excess = materialized((b.rm * R, b.mo * h, b.mo * R, b.ro * away))  # excess = f_r − f_o
    S, cn, dn, turn, halves = _phases(b.rm, b.mo, R, h, away, tau)
    lever = jnp.abs(b.ro) * (jnp.abs(b.rm * e[0]) + jnp.abs(b.mo * e[2]))
    condition = jnp.abs(halves) * where(halves == 0, 0, lever / where(halves == 0, 1, jnp.abs(excess)))
    return _Motion(excess > 0, R, h, away, nu, S, cn, dn, f_r, f_o, excess, halves, b.b_o * tau + turn, condition)


def _frequencies(rm: Array, mo: Array, R: Array, h: Array, away: Array) -> tuple[Array, Array, Array, Array]:
    """Whether π circulates about r; f; f − f′ ≥ 0; and m1 = (f − f′)/f, which is 1 for f = 0."""
    excess = (rm + mo) * away
    about_r = excess > 0
    f, apart = where(about_r, rm * R, mo * h), where(about_r, excess, -excess)
    return about_r, f, apart, where(f == 0, 1, apart / where(f == 0, 1, f))


def _slopes_of_phases(
    value: tuple[Array, ...], rm: Array, mo: Array, R: Array, h: Array, away: Array, tau: Array
) -> list[tuple[Array, ...]]:
    """The slopes of `_phases` by b_r − b_m, b_m − b_o, R and τ, with h and `away` as functions of these.

    With W = ∫₀^τ S² dτ and W_dn = ∫₀^τ S²/dn² dτ, S is a function of f, of a = f − f′ and of τ that changes by

        dS = cn dn (dτ + ½ W df + ½ W_dn da) − ½ S³ df

    as follows from τ = ∫₀^S dS/(cn dn); so do the others. X is in none of these slopes: the flow is symplectic.
    """
    S, cn, dn, _, halves = value
    about_r, f, apart, m1 = _frequencies(rm, mo, R, h, away)
    ro, nu, sign = rm + mo, mo * R, where(about_r, 1, -1)
    W_dn, W = _integrals(S, cn, dn, f, m1, halves)
    P, square, ratio = 1 + nu * S * S, S * S, cn / dn
    c_f, c_g = where(about_r, mo, R), where(about_r, R, mo)
    by_f = (c_f * (ratio * S**3 - cn * cn * W) / P + sign * away * W_dn) / 2
    by_apart = -c_g * dn * dn * W_dn / (2 * P)
    flat = ro == 0
    by_nu = where(flat, 0, tau - S * cn * dn / P + rm * h * W) / (2 * where(flat, 1, ro))
    speed = cn * dn, -f * S * dn, -(f - apart) * S * cn, ro * nu * square / P

    def slope(of_f: Array, of_apart: Array, of_nu: Array, of_tau: Array | float = 0) -> tuple[Array, ...]:
        shift, less = of_tau + (W * of_f + W_dn * of_apart) / 2, square * of_f / 2
        return (
            shift * speed[0] - less * S,
            shift * speed[1] - less * cn,
            shift * speed[2] - less * dn + square * of_apart / (2 * dn),
            of_tau * speed[3] + by_f * of_f + by_apart * of_apart + by_nu * of_nu,
            0 * S,
        )

    zero = 0 * S
    return [
        slope(where(about_r, R, mo), sign * away, zero),
        slope(where(about_r, 0, h + mo), sign * (away - ro), R),
        slope(where(about_r, rm, -mo), sign * ro, mo),
        (zero,) * 5,
        (zero,) * 5,
        slope(zero, zero, zero, 1),
    ]


@functools.partial(forward_mode, slopes=_slopes_of_phases)
def _phases(rm: Array, mo: Array, R: Array, h: Array, away: Array, tau: Array) -> tuple[Array, ...]:
    """S, cn, dn of τ less `halves` half periods, (b_r − b_o) ν X of all of τ, and `halves`.

    Args:
        rm, mo: b_r − b_m and b_m − b_o.
        R: (b_r − b_o)e_r² + (b_m − b_o)e_m².
        h, away: b_r − b_o − R and R − (b_m − b_o), computed so that nothing cancels.
        tau: τ.
    """
    _, f, apart, m1 = _frequencies(rm, mo, R, h, away)
    nu, x, y = mo * R, f * tau * tau, (f - apart) * tau * tau
    near = x < _NEAR
    f_far, m1 = where(near, 1, f), where(near, 1, m1)
    frequency = jnp.sqrt(f_far)
    K = elliptic.quarter_period(m1)
    u = where(near, 0, frequency * tau)
    halves = jnp.round(u / (2 * K))
    sn, cn, dn = elliptic.jacobi(u - 2 * K * halves, m1)
    S = where(near, tau * (1 - (x + y) / 6 + (x * x + 14 * x * y + y * y) / 120), sn / frequency)
    cn = where(near, 1 - x / 2 + x * (x + 4 * y) / 24, cn)
    dn = where(near, 1 - y / 2 + y * (y + 4 * x) / 24, dn)
    S, cn, dn = materialized((S, cn, dn))
    X = _integral(lambda s2, x, y, z: elliptic.carlson_rj(x, y, z, 1 + nu * s2), S, cn, dn, f_far, m1, halves)
    return S, cn, dn, (rm + mo) * nu * X, halves


def _integrals(S: Array, cn: Array, dn: Array, f: Array, m1: Array, halves: Array) -> tuple[Array, Array]:
    """∫S²/dn² dτ and ∫S² dτ from 0 to τ."""
    return _integral(lambda _, x, y, z: elliptic.carlson_rds(x, y, z), S, cn, dn, f, m1, halves)


def _integral(
    carlson: Callable[..., PyTree], S: Array, cn: Array, dn: Array, f: Array, m1: Array, halves: Array
) -> PyTree:
    """An integral of S² from 0 to τ, by one of Carlson's functions of S² and of the roots cn, dn, 1.

    That of a quarter period has 1/f, 0, √m1, 1. Where it is not needed, its arguments need no duplication.
    """
    one, needed = jnp.ones_like(S), halves != 0
    root = jnp.sqrt(m1 + jnp.sqrt(jnp.finfo(m1.dtype).tiny))
    f, zero, root = (where(needed, x, 1) for x in (f, 0 * one, root))
    pairs = (S * S, where(needed, 1 / f, 0)), (cn, zero), (dn, root), (one, one)
    factors = S**3 / 3, 2 * halves / (3 * f * jnp.sqrt(f))
    return jax.tree.map(
        lambda both: dot(factors, materialized(vectors.components(both))), carlson(*(jnp.stack(x) for x in pairs))
    )


def _rotation_between(e: Vector, change: Vector, c: Array, s: Array) -> tuple[Array, Vector]:
    """(r → e)(rotation about r by 2 arctan2(s, c))(e + change → r), times a positive number: scalar and vector part.

    Their rounding errors are proportional to the change and to s, so that those of small steps are small.
    """
    f = e + change
    a, b = 1 + e[0], 1 + f[0]
    across, along = e[2] * change[1] - e[1] * change[2], e[1] * f[1] + e[2] * f[2]
    return c * (a * b + along) + s * across, Vector(
        (
            s * (a * b - along) + c * across,
            s * (a * f[1] + b * e[1]) + c * (a * change[2] - e[2] * change[0]),
            s * (a * f[2] + b * e[2]) + c * (e[1] * change[0] - a * change[1]),
        )
    )
