"""The rotation group SO(3) as unit quaternions (Section 2.1).

An attitude Λ is a unit quaternion q = (w, x, y, z), shape (4,), scalar first; q and −q are the same rotation. Algebra
and dual are ℝ³, bracket and pairing are × and ·. All functions have accurate derivatives wherever they are smooth,
including that of `log` at 0 and near π, in float32 and float64.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lieint_jax._numerics import power_series, vectors
from lieint_jax._numerics.arrays import Matrix3, MomentumMap, Quaternion, Scalar, Vector3
from lieint_jax._numerics.select import where
from lieint_jax._numerics.vectors import cross, dot

dim = 3
identity = np.array([1.0, 0.0, 0.0, 0.0])
identity.flags.writeable = False


def examples() -> dict[str, object]:
    import sys

    return {"so3": sys.modules[__name__]}


def multiply(a: Quaternion, b: Quaternion | tuple[Array, ...]) -> Quaternion:
    """The product ab: first b, then a."""
    return jnp.stack(_product(a, b))


def inverse(q: Quaternion) -> Quaternion:
    """q⁻¹ of a unit quaternion: its conjugate."""
    return jnp.stack([q[0], -q[1], -q[2], -q[3]])


def normalize(q: Quaternion) -> Quaternion:
    """q / |q|."""
    return q / jnp.sqrt(_norm_squared(q))


def defect(q: Quaternion) -> Scalar:
    """|q|² − 1, the distance of q from the group."""
    # less 1 at once: |q|² is rounded more coarsely above 1 than below, and |q| corrected by it would stay above 1
    return q[0] * q[0] - 1 + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


def exp(xi: Vector3) -> Quaternion:
    """exp ξ, the rotation about ξ by the angle |ξ| (2.3)."""
    x = dot(xi, xi) / 4
    return jnp.concatenate([power_series.cos_sqrt(x)[None], power_series.sinc_sqrt(x) * xi / 2])


def log(q: Quaternion) -> Vector3:
    """ξ with exp ξ = q and |ξ| ≤ π."""
    q = where(q[0] < 0, -q, q)
    w, v = q[0], q[1:]
    s = dot(v, v)
    small = s < 0.02  # both branches are right near the threshold of 0.01, see `power_series`
    w_near = where(small, w, 1)  # away from w = 0, where the rotation is by π
    s_far = where(s < 0.005, 1, s)  # away from s = 0, where the square root has no derivative
    series = power_series.arctan_sqrt(where(small, s, 0) / (w_near * w_near)) / w_near
    closed = jnp.arctan2(jnp.sqrt(s_far), w) / jnp.sqrt(s_far)
    return 2 * where(s < 0.01, series, closed) * v


def cayley(xi: Vector3) -> Quaternion:
    """cay ξ = (1 + ½ξ̂)(1 − ½ξ̂)⁻¹ (2.5): the rotation about ξ by 2 arctan(|ξ|/2)."""
    h = xi / 2
    return jnp.concatenate([jnp.ones_like(h[:1]), h]) / jnp.sqrt(1 + dot(h, h))


def Ad(q: Quaternion, xi: vectors.VectorLike) -> Vector3:
    """Λξ: from body to space."""
    return jnp.stack(_rotate(q[0], q[1:], xi))


def Ad_star(q: Quaternion, mu: vectors.VectorLike) -> Vector3:
    """Λᵀμ, the transpose of Ad: maps spatial momentum π to body momentum Π."""
    return jnp.stack(_rotate(-q[0], q[1:], mu))


def ad(xi: Vector3, eta: Vector3) -> Vector3:
    """[ξ, η] = ξ × η (2.1)."""
    return jnp.stack(cross(xi, eta))


def ad_star(xi: Vector3, mu: Vector3) -> Vector3:
    """μ × ξ, the transpose of ad: ⟨ad*_ξ μ, η⟩ = ⟨μ, ξ × η⟩."""
    return jnp.stack(cross(mu, xi))


def casimirs(mu: Vector3) -> MomentumMap:
    """|μ|², (1,), which every Ad*_q leaves invariant."""
    return jnp.stack([dot(mu, mu)])


def hat(xi: Vector3) -> Matrix3:
    """ξ̂, the skew matrix with ξ̂ h = ξ × h (2.1)."""
    return vectors.hat(vectors.components(xi)).array


def vee(M: Matrix3) -> Vector3:
    """The inverse of `hat`; for any M, that of its skew part: the paper's rot[M]."""
    return jnp.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) / 2


def spatial_velocity(q: Quaternion, q_dot: Quaternion) -> Vector3:
    """θ with q̇ = ½ θ q, that is Λ̇ = θ̂Λ."""
    return 2 * jnp.stack(_product(q_dot, inverse(q))[1:])


def body_velocity(q: Quaternion, q_dot: Quaternion) -> Vector3:
    """Θ with q̇ = ½ q Θ, that is Λ̇ = ΛΘ̂."""
    return 2 * jnp.stack(_product(inverse(q), q_dot)[1:])


def tangent(q: Quaternion, Omega: Vector3) -> Quaternion:
    """q̇ = ½ q Ω for the body velocity Ω: the inverse of `body_velocity`."""
    return jnp.stack(_product(q, (jnp.zeros_like(Omega[0]), *(Omega / 2))))


def spatial_tangent(q: Quaternion, theta: Vector3) -> Quaternion:
    """q̇ = ½ θ q for the spatial velocity θ: the inverse of `spatial_velocity`."""
    return jnp.stack(_product((jnp.zeros_like(theta[0]), *(theta / 2)), q))


def cayley_increment(q: Quaternion, h: Vector3 | tuple[Array, ...]) -> Quaternion:
    """q cay(2h), as q + q(c − 1, ch) with c = 1/√(1+|h|²).

    The product q·dq has rounding errors proportional to |q| in each step; those of the increment are proportional to
    the step. The increment also corrects |q|, so |q| = 1 to round-off in runs of any length. Energy then drifts by
    1e-13 in 10⁶ steps, not by 1e-12.
    """
    return jnp.stack(vectors.vector(q) + cayley_difference(q, h))


def exp_increment(q: Quaternion, xi: Vector3, left: bool = False) -> Quaternion:
    """q exp ξ, or exp ξ q, as q + q(cos ½|ξ| − 1, sin ½|ξ| ξ/|ξ|), which corrects |q| as in `cayley_increment`."""
    if left:  # exp ξ q = (q⁻¹ exp −ξ)⁻¹
        return inverse(exp_increment(inverse(q), -xi))
    x, d = dot(xi, xi) / 4, defect(q) / 2
    s, c = power_series.sinc_sqrt(x / 4), power_series.cos_sqrt(x / 4)
    return jnp.stack(vectors.vector(q) + _increment(q, -x * s * s / 2 - d, ((1 - d) / 2 * s * c) * vectors.Vector(xi)))


def cayley_difference(q: vectors.VectorLike, h: vectors.VectorLike) -> tuple[Array, Array, Array, Array]:
    """`cayley_increment` less q, in components."""
    y = dot(h, h)
    s = jnp.sqrt(1 + y)
    r = 1 / (s * (1 + s))
    c = r * (1 + s)
    d = c * defect(q) / 2
    return _increment(q, -y * r - d, (c - d) * vectors.Vector(h))  # c − 1 without cancellation; both over |q|


def to_matrix(q: Quaternion) -> Matrix3:
    """The rotation matrix Λ, shape (3, 3)."""
    return matrix_of(*vectors.components(q)).array


def matrix_of(w: Scalar, x: Scalar, y: Scalar, z: Scalar) -> vectors.Matrix:
    """The rows of the rotation matrix of a unit quaternion."""
    return vectors.Matrix(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def from_matrix(R: Matrix3) -> Quaternion:
    """The unit quaternion, (4,), of a rotation matrix, (3, 3), with its largest component positive."""
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]  # 4wx, 4wy, 4wz
    d, e, f = R[2, 1] + R[1, 2], R[0, 2] + R[2, 0], R[1, 0] + R[0, 1]  # 4yz, 4xz, 4xy
    squares = jnp.stack(  # 4w², 4x², 4y², 4z²; the largest is at least 1, so nothing below is near 0/0
        [
            1 + R[0, 0] + R[1, 1] + R[2, 2],
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
        ]
    )
    w, x, y, z = vectors.components(squares)
    candidates = jnp.stack([jnp.stack(row) for row in ((w, a, b, c), (a, x, f, e), (b, f, y, d), (c, e, d, z))])
    largest = jnp.argmax(squares)
    return normalize(candidates[largest])


def from_euler_313(angles: Vector3) -> Quaternion:
    """The attitude R_z(α) R_x(β) R_z(γ) of Euler angles (α, β, γ) in radians, shape (3,)."""
    half_sum, half_difference, b = (angles[0] + angles[2]) / 2, (angles[0] - angles[2]) / 2, angles[1] / 2
    return jnp.stack(
        [
            jnp.cos(b) * jnp.cos(half_sum),
            jnp.sin(b) * jnp.cos(half_difference),
            jnp.sin(b) * jnp.sin(half_difference),
            jnp.cos(b) * jnp.sin(half_sum),
        ]
    )


def to_euler_313(q: Quaternion) -> Vector3:
    """Euler angles (α, β, γ) of q = R_z(α) R_x(β) R_z(γ): β in [0, π], α and γ in (−π, π].

    At β = 0 or π only α + γ or α − γ is determined; the other is set to 0.
    """
    w, x, y, z = vectors.components(q)
    half_sum, half_difference = _arctan2(z, w), _arctan2(y, x)
    b = 2 * jnp.arctan2(_length(x, y), _length(w, z))
    return jnp.stack([_wrap(half_sum + half_difference), b, _wrap(half_sum - half_difference)])


def from_euler(angles: Array, sequence: str = "ZXZ") -> Array:
    """The attitude of Euler angles, or of roll, pitch and yaw, in any of the 24 sequences.

    Args:
        angles: in radians, (3,), in the order of the sequence.
        sequence: three axes as in scipy, of which neighbors differ. Capitals, "ZXZ", mean successive rotations about
            the axes of the body, R_z(α) R_x(β) R_z(γ); small letters, "zxz", mean rotations about those of space.

    Returns:
        The unit quaternion, (4,).

    Raises:
        ValueError: `sequence` is none of these.
    """
    intrinsic, axes = _sequence(sequence)
    q = None
    for k, axis in enumerate(axes):
        half = angles[k] / 2
        turn = jnp.zeros(4, half.dtype).at[0].set(jnp.cos(half)).at[1 + axis].set(jnp.sin(half))
        q = turn if q is None else (multiply(q, turn) if intrinsic else multiply(turn, q))
    assert q is not None
    return q


def to_euler(q: Array, sequence: str = "ZXZ") -> Array:
    """The Euler angles of an attitude in radians, (3,): the inverse of `from_euler`.

    The first and the third angle are in (−π, π]. The second is in [0, π] if the first and the third axis are equal
    ("ZXZ"), otherwise in [−π/2, π/2]. Where the second is at an end of its range, only the sum or the difference of the
    others is determined, and one of them is arbitrary.

    Source: Bernardes & Viollet 2022, PLoS ONE 17.
    """
    intrinsic, axes = _sequence(sequence)
    i, j, k = axes[::-1] if intrinsic else axes
    symmetric = i == k
    k = 3 - i - j if symmetric else k
    sign = (i - j) * (j - k) * (k - i) // 2
    w, *v = vectors.components(q)
    a, b, c, d = w, v[i], v[j], sign * v[k]
    if not symmetric:
        a, b, c, d = a - c, b + d, c + a, d - b
    middle = 2 * jnp.arctan2(_length(c, d), _length(a, b))
    half_sum, half_difference = _arctan2(b, a), _arctan2(d, c)
    first, third = half_sum - half_difference, half_sum + half_difference
    if not symmetric:
        third, middle = sign * third, middle - jnp.pi / 2
    outer = (third, first) if intrinsic else (first, third)
    return jnp.stack([_wrap(outer[0]), middle, _wrap(outer[1])])


def _sequence(sequence: str) -> tuple[bool, list[int]]:
    """Whether a sequence is about the axes of the body, and its axes."""
    axes = ["xyz".find(letter) for letter in sequence.lower()] if isinstance(sequence, str) else []
    one_case = isinstance(sequence, str) and sequence in (sequence.lower(), sequence.upper())
    if len(axes) != 3 or min(axes) < 0 or not one_case or axes[0] == axes[1] or axes[1] == axes[2]:
        raise ValueError(
            'sequence must be three axes of which neighbors differ: capitals for axes of the body, such as "ZXZ" or '
            f'"ZYX", or small letters for axes of space, such as "xyz"; got {sequence!r}'
        )
    return sequence.isupper(), axes


def from_mrp(sigma: Array) -> Array:
    """The attitude of modified Rodrigues parameters σ = e tan(φ/4), (3,), of any length."""
    most = jnp.finfo(sigma.dtype).max / 8  # the reciprocal of a larger number is 0 on machines without subnormal ones
    size = lax.stop_gradient(jnp.clip(jnp.max(jnp.abs(sigma)), 1, most))  # it cancels: without it |σ|² could overflow
    u, r = sigma / size, 1 / size
    square = dot(u, u)
    return jnp.concatenate([(r * r - square)[None], 2 * r * u]) / (r * r + square)


def to_mrp(q: Array) -> Array:
    """Modified Rodrigues parameters σ = e tan(φ/4), (3,), of the shorter rotation: |σ| ≤ 1."""
    q = where(q[0] < 0, -q, q)
    return q[1:] / (1 + q[0])


def angle(a: Quaternion, b: Quaternion) -> Scalar:
    """The angle of the rotation between two attitudes, in [0, π]; where it is 0, its derivative is set to 0."""
    w, x, y, z = _product(inverse(a), b)
    return 2 * jnp.arctan2(_length(x, y, z), jnp.abs(w))


def _increment(q: vectors.VectorLike, k: Scalar, u: vectors.Vector) -> tuple[Array, Array, Array, Array]:
    """The product of q and the quaternion (k, u), in components."""
    w, v = q[0], vectors.Vector(q[1:])
    return (w * k - dot(v, u), *(w * u + k * v + cross(v, u)))


def _product(a: vectors.VectorLike, b: vectors.VectorLike) -> tuple[Array, Array, Array, Array]:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3],
        a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1],
    )


def _norm_squared(q: Quaternion) -> Array:
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


def _rotate(w: Scalar, v: vectors.VectorLike, u: vectors.VectorLike) -> vectors.Vector:
    """u + 2w v×u + 2 v×(v×u): u rotated by the unit quaternion (w, v); by its inverse for −w."""
    t = 2 * cross(v, u)
    return u + w * t + cross(v, t)


def _length(*components: Array) -> Array:
    """√(x² + y² + …), with derivative 0 at 0."""
    square = sum(x * x for x in components[1:]) + components[0] * components[0]
    zero = square == 0  # a NaN stays one
    return where(zero, 0, jnp.sqrt(where(zero, 1, square)))


def _arctan2(y: Scalar, x: Scalar) -> Array:
    """arctan2, with value and derivative 0 at the origin."""
    origin = (x == 0) & (y == 0)
    return where(origin, 0, jnp.arctan2(y, where(origin, 1, x)))


def _wrap(angle: Array) -> Array:
    """An angle, reduced to (−π, π]."""
    return angle - 2 * jnp.pi * jnp.ceil(angle / (2 * jnp.pi) - 0.5)
