"""A thruster that fires in a window of time."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.types import Law, Rotation, pytree
from lieint_jax.types.shapes import PyTree

__all__ = ["Thruster", "thruster"]


@pytree
class Thruster(Law):
    """A constant torque in the body in a window of time. Made by `thruster`."""

    torque: Array
    begin: Array
    stop: Array

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """T times the part of the step in which it fires."""
        length = jnp.abs(rotation.dt)
        overlap = jnp.minimum(rotation.t + length / 2, self.stop) - jnp.maximum(rotation.t - length / 2, self.begin)
        fires = (self.begin <= rotation.t) & (rotation.t < self.stop)
        silent = (rotation.t < self.begin) | (self.stop <= rotation.t)  # neither for NaN
        instant = length == 0
        part = jnp.clip(overlap / jnp.where(instant, 1, length), 0, 1)
        now = jnp.where(fires, 1.0, jnp.where(silent, 0.0, jnp.nan)).astype(part.dtype)
        return jnp.where(instant, now, part) * self.torque, inner


def thruster(torque: ArrayLike, start: ArrayLike, stop: ArrayLike) -> Thruster:
    """A pulse: the torque T, constant in the body, from time `start` to time `stop`.

    A step that the pulse begins or ends in has the torque of its part of the step: ∫T dt = T·(stop − start) whatever
    the steps are, and the derivatives with respect to start and stop are right. Order 2 needs steps that end there.

    Args:
        torque: T in the body, (3,).
        start, stop: times, start ≤ stop, on the clock of `State.t`.

    Raises:
        ValueError: stop < start, a torque that is no vector.
    """
    first, last = _checks.real_array("start", start, ()), _checks.real_array("stop", stop, ())
    if concrete(first, last) and float(last) < float(first):
        raise ValueError(f"a pulse must not stop before it starts, got start = {first} and stop = {last}")
    return Thruster(_checks.real_array("torque", torque, (3,)), first, last)
