"""The times at which a digital controller looks at the body: 0, period, 2 period, …; it holds its output in between."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

_NEAR = 1 / 16  # of a step: how far from a sample, by the rounding of the time, a step may begin
_EQUAL = 1e-5  # relative: how far from a multiple of dt, by rounding, the period may be


def held_in_step(period: Array, t: Array, dt: Array, new: Array, held: Array) -> tuple[Array, Array]:
    """What is held in a step of dt from t, and whether no such step passes over a sample.

    Args:
        period: between two samples, > 0.
        new: what a sample at t gives.
        held: what was held until t.
    """
    apart, near = jnp.abs(t - jnp.round(t / period) * period), _NEAR * jnp.abs(dt)
    moves = dt != 0
    number, passed = (x / jnp.where(moves, dt, 1) for x in (period, t))
    divides = jnp.abs(number - jnp.round(number)) <= _EQUAL * number
    fits = (dt > 0) & divides & (jnp.abs(passed - jnp.round(passed)) <= _NEAR)
    between = jnp.where(apart > near, held, jnp.nan).astype(held.dtype)  # NaN where a time is NaN
    return jnp.where(apart <= near, new, between), fits | ~moves


def why_not(name: str, period: Array, t: Array, dt: ArrayLike) -> str:
    """Which steps a controller of this name accepts."""
    every = float(period)
    return (
        f"{name} samples at multiples of {every:g}, and no step may go back or pass over a sample: give a dt > 0 that "
        f"divides {every:g} and a start at a multiple of dt, got dt = {dt} at t = {t}"
    )
