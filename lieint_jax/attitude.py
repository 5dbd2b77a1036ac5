"""Attitudes from other conventions, and into them.

An attitude of this package is a unit quaternion q = (w, x, y, z), the scalar part first, from body to space: q v q⁻¹
has the components along the axes of space of a vector with the components v along those of the body. `from_…` returns
such a q and `to_…` accepts one, or a scipy `Rotation`.

`frame` is the map that the other numbers stand for, by the same rule q v q⁻¹, or R v for a matrix: "body_to_space", or
"space_to_body", its inverse. Conventions that rotate the axes, not the vector, as in most books on spacecraft, have the
components of "body_to_space" though they speak of a rotation from space to body: see the page Conventions.

All functions accept leading axes, work inside jit, vmap and grad, and keep the precision of what they are given.

    >>> import jax.numpy as jnp
    >>> q = from_euler("ZYX", jnp.deg2rad(jnp.array([90.0, 0.0, 0.0])))
    >>> print((to_matrix(q) @ jnp.array([1.0, 0.0, 0.0])).round(6) + 0.0)
    [0. 1. 0.]
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import Attitude
from lieint_jax.groups import so3

__all__ = [
    "from_euler",
    "from_matrix",
    "from_mrp",
    "from_rotvec",
    "from_scalar_first",
    "from_scalar_last",
    "to_euler",
    "to_matrix",
    "to_mrp",
    "to_rotvec",
    "to_scalar_first",
    "to_scalar_last",
]
__dir__ = __all__.copy

Frame = Literal["body_to_space", "space_to_body"]


def from_scalar_first(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """The attitudes of quaternions (w, x, y, z): those of MuJoCo and Basilisk, of SPICE with "space_to_body".

    Args:
        q: unit quaternions, (…, 4), or scipy `Rotation`s.
        frame: "body_to_space", which changes nothing, or "space_to_body".

    Returns:
        Unit quaternions (w, x, y, z), body to space, (…, 4). Those that are off unit length by more than 1e-6, since
        they were printed with few digits, are normalized.

    Raises:
        ValueError: a norm off 1 by more than 1e-4, or not finite; another shape; another frame.

    Warns:
        RuntimeWarning: a norm off 1 by more than 1e-6.
    """
    return _directed(_checks.unit_quaternion("q", q, leading=True), frame)


def to_scalar_first(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """Quaternions (w, x, y, z) of attitudes, (…, 4): the inverse of `from_scalar_first`, which is the same function."""
    return from_scalar_first(q, frame)


def from_scalar_last(q: ArrayLike, frame: Frame = "body_to_space") -> Array:
    """The attitudes of quaternions (x, y, z, w): those of CCSDS, scipy, Eigen, ROS, JPL, NASA's 42.

    Args:
        q: unit quaternions, (…, 4).
        frame: "body_to_space" or "space_to_body".

    Returns:
        Unit quaternions (w, x, y, z), body to space, (…, 4), as in `from_scalar_first`.

    Example:
        >>> print(from_scalar_last([0.6, 0.0, 0.0, 0.8]), from_scalar_last([0.6, 0.0, 0.0, 0.8], "space_to_body"))
        [0.8 0.6 0.  0. ] [ 0.8 -0.6 -0.  -0. ]
    """
    return from_scalar_first(jnp.roll(_checks.with_leading("q", q, (4,)), 1, axis=-1), frame)


def to_scalar_last(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """Quaternions (x, y, z, w) of attitudes, (…, 4): the inverse of `from_scalar_last`."""
    return jnp.roll(from_scalar_first(q, frame), -1, axis=-1)


def from_mrp(sigma: ArrayLike, frame: Frame = "body_to_space") -> Array:
    """The attitudes of modified Rodrigues parameters σ = e tan(φ/4), such as `sigma_BN` of Basilisk.

    Args:
        sigma: σ, (…, 3), of any length: the shadow set −σ/|σ|² is the same attitude, −q.
        frame: "body_to_space" or "space_to_body".

    Returns:
        Unit quaternions (w, x, y, z), body to space, (…, 4), with w ≥ 0 for |σ| ≤ 1.

    Raises:
        ValueError: σ is not finite, or of another shape; another frame.
    """
    return _directed(_each(so3.from_mrp, 1, _checks.with_leading("sigma", sigma, (3,))), frame)


def to_mrp(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """Modified Rodrigues parameters of attitudes, (…, 3), of the shorter rotation, so that |σ| ≤ 1."""
    return _each(so3.to_mrp, 1, from_scalar_first(q, frame))


def from_matrix(R: ArrayLike, frame: Frame = "body_to_space") -> Array:
    """The attitudes of rotation matrices.

    Args:
        R: matrices, (…, 3, 3), orthogonal to 1e-6. Those of "body_to_space" have the axes of the body, in space, as
            columns; those of "space_to_body", direction cosine matrices and SPICE's C-matrices, as rows.
        frame: "body_to_space" or "space_to_body".

    Returns:
        Unit quaternions (w, x, y, z), body to space, (…, 4), with a positive largest component: it is found first, so
        that all digits and derivatives are right at any angle.

    Raises:
        ValueError: not orthogonal, a reflection, not finite, another shape, another frame. Inside jit the attitude of
            what is no rotation matrix is NaN.
    """
    return _directed(_each(so3.from_matrix, 2, _checks.rotation_matrix("R", R, leading=True)), frame)


def to_matrix(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """The rotation matrices of attitudes, (…, 3, 3); "space_to_body" returns direction cosine matrices."""
    return _each(so3.to_matrix, 1, from_scalar_first(q, frame))


def from_rotvec(rotvec: ArrayLike, frame: Frame = "body_to_space") -> Array:
    """The attitudes of rotation vectors, an axis times an angle in radians, (…, 3), as unit quaternions, (…, 4).

    Raises:
        ValueError: a vector that is not finite, or so long that rounding changes its angle by 1e-3 rad (4.5e12 rad in
            float64, 8e3 rad in float32); another shape; another frame. Inside jit such an attitude is NaN.
    """
    vectors = _checks.with_leading("rotvec", rotvec, (3,))
    most = 1e-3 / float(jnp.finfo(vectors.dtype).eps)
    if not _checks.concrete(vectors):
        longest = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True, initial=0)
        vectors = jnp.where(longest <= most, vectors, jnp.nan)
    else:
        longest = np.max(np.abs(np.asarray(vectors)), initial=0)
        if longest > most:
            raise ValueError(
                f"rotvec must be below {most:.2g} rad in {vectors.dtype}, got {longest:.6g}, whose angle is rounded to "
                "whole milliradians or worse: subtract whole turns before"
            )
    return _directed(_each(so3.exp, 1, vectors), frame)


def to_rotvec(q: Attitude, frame: Frame = "body_to_space") -> Array:
    """The rotation vectors of attitudes, (…, 3), of angles in [0, π] radians."""
    return _each(so3.log, 1, from_scalar_first(q, frame))


def from_euler(sequence: str, angles: ArrayLike, frame: Frame = "body_to_space") -> Array:
    """The attitudes of Euler angles, or of roll, pitch and yaw, in any of the 24 conventions.

    Args:
        sequence: three axes of which neighbors differ, as in scipy. Capitals are successive rotations about the axes of
            the body, "ZYX" for yaw, pitch and roll; small letters are rotations about the axes of space, "xyz" for
            the roll, pitch and yaw of URDF. "ZYX" with (a, b, c) is "xyz" with (c, b, a).
        angles: radians, (…, 3), in the order of the sequence.
        frame: "body_to_space" or "space_to_body".

    Returns:
        Unit quaternions (w, x, y, z), body to space, (…, 4).

    Raises:
        ValueError: no such sequence; angles that are not finite or of another shape; another frame.
    """
    return _directed(_each(so3.from_euler, 1, _checks.with_leading("angles", angles, (3,)), sequence), frame)


def to_euler(sequence: str, q: Attitude, frame: Frame = "body_to_space") -> Array:
    """The Euler angles of attitudes, radians, (…, 3): the inverse of `from_euler`.

    The first and the third angle are in (−π, π]. The second is in [0, π] if the first and the third axis are equal,
    otherwise in [−π/2, π/2]. At the ends of its range, the gimbal lock, one of the others is arbitrary, and its
    derivative is set to 0.
    """
    return _each(so3.to_euler, 1, from_scalar_first(q, frame), sequence)


@partial(jax.jit, static_argnums=(0, 1, 3))
def _each(function: Callable[..., Array], axes: int, x: Array, sequence: str | None = None) -> Array:
    """A function of arrays of so many axes, and of a sequence, over the leading axes."""
    leading, shape = x.shape[: x.ndim - axes], x.shape[x.ndim - axes :]
    arguments = () if sequence is None else (sequence,)
    found = jax.vmap(lambda one: function(one, *arguments))(x.reshape(-1, *shape))
    return found.reshape(*leading, *found.shape[1:])


def _directed(q: Array, frame: str) -> Array:
    """The quaternions, conjugated if they are those of space to body."""
    space_to_body = _checks.choice("frame", frame, get_args(Frame)) == "space_to_body"
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1) if space_to_body else q
