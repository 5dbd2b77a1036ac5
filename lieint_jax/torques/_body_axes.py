"""Vectors of space in the axes of a body that rotates in a step, which many laws need.

They come from the rotation h of the step, not from the attitudes after it: what Newton's method differentiates is h.
With a = Λ_nᵀv and s = √(1+|h|²), at the end of the step cay(−2h) a = a + 2(h × (h × a) − h × a)/s², and half-way, as a
rotation by half the angle, a + h × (h × a)/(s(1+s)) − h × a/s.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.vectors import VectorLike, cross, dot
from lieint_jax.core import Rotation
from lieint_jax.groups import so3


def start_axes(rotation: Rotation, v: VectorLike) -> Array:
    """A vector of space in the axes of the body at the start of the step, (3,)."""
    return so3.Ad_star(rotation.q_n, v)


def middle_axes(rotation: Rotation, v: VectorLike) -> Array:
    """A vector of space in the axes of the body half-way, (3,)."""
    s = jnp.sqrt(1 + dot(rotation.h, rotation.h))
    return _rotate(rotation, v, 1 / s, 1 / (s * (1 + s)))


def end_axes(rotation: Rotation, v: VectorLike) -> Array:
    """A vector of space in the axes of the body at the end of the step, (3,)."""
    weight = 2 / (1 + dot(rotation.h, rotation.h))
    return _rotate(rotation, v, weight, weight)


def mean_axes(rotation: Rotation, v: VectorLike) -> Array:
    """Λ̄ᵀv, the mean of a vector of space in the axes of the body at both ends of the step, (3,)."""
    return (start_axes(rotation, v) + end_axes(rotation, v)) / 2


def _rotate(rotation: Rotation, v: VectorLike, first: Array, second: Array) -> Array:
    a = start_axes(rotation, v)
    b = cross(rotation.h, a)
    c = cross(rotation.h, b)
    return jnp.stack(a + second * c - first * b)
