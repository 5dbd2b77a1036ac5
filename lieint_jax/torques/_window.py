"""Windows of time: the mean over a step of what acts from one time to another."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.core import Rotation


def window(what: str, start: ArrayLike, stop: ArrayLike | None) -> tuple[Array, Array]:
    """The ends of a window of time, scalars; None is never.

    Raises:
        ValueError: stop < start.
    """
    first = _checks.real_array("start", start, ())
    last = jnp.full_like(first, jnp.inf) if stop is None else _checks.real_array("stop", stop, ())
    if concrete(first, last) and float(last) < float(first):
        raise ValueError(f"{what} must not stop before it starts, got start = {first} and stop = {last}")
    return first, last


def mean_in_window(rotation: Rotation, start: Array, stop: Array, value: Array) -> Array:
    """The mean over a step of a value that acts in a window: the value times the part of the step in the window.

    Its integral over any steps, and the derivatives of that by both ends of the window, are exact for a constant value.
    At an instant it is the value, if start ≤ t < stop, or 0. NaN times give NaN.
    """
    begin, end = jnp.minimum(rotation.start, rotation.end), jnp.maximum(rotation.start, rotation.end)
    length = end - begin
    moves = length != 0
    # Each end of the window is moved into the step. An end at the boundary of two steps is free in one of them only,
    # the one that acts, or else its derivative would be counted twice or not at all. A window of no length has both
    # ends in one.
    over = (stop < begin) | ((stop == begin) & (start < stop))
    first = jnp.where(start < begin, begin, jnp.where(start >= end, end, start))
    last = jnp.where(over, begin, jnp.where(stop > end, end, stop))
    inside = (start <= begin) & (begin < stop)
    outside = jnp.where(moves, (end <= start) | over, (begin < start) | (stop <= begin))  # neither for NaN
    part = (last - first) / jnp.where(moves, length, 1)
    instant = jnp.where(inside, 1.0, jnp.nan).astype(part.dtype)
    mean = jnp.where(moves, part, instant).astype(value.dtype) * value
    return jnp.where(outside, 0, mean)  # also where the value is NaN, such as that of a table of this window's times
