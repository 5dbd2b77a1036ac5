"""A thruster that fires in a window of time."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax.core import Law, Rotation, pytree
from lieint_jax.torques._window import mean_in_window, window

__all__ = ["thruster"]


@pytree
class Thruster(Law):
    """A constant torque in the body in a window of time. Made by `thruster`."""

    torque: Array
    begin: Array
    stop: Array

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """T times the part of the step in which it fires."""
        return mean_in_window(rotation, self.begin, self.stop, self.torque), inner


def thruster(torque: ArrayLike, start: ArrayLike, stop: ArrayLike) -> Thruster:
    """A pulse: the torque T, constant in the body, from time `start` to time `stop`.

    A step that the pulse begins or ends in has the torque of its part of the step: ∫T dt = T·(stop − start) whatever
    the steps are, and the derivatives with respect to start and stop are right. So steps may end anywhere at order 2; a
    composition of higher order needs steps that end at start and stop.

    Args:
        torque: T in the body, (3,).
        start, stop: times, start ≤ stop, on the clock of `State.t`.

    Raises:
        ValueError: stop < start, a torque that is no vector.
    """
    return Thruster(_checks.real_array("torque", torque, (3,)), *window("a pulse", start, stop))


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"thruster": partial(thruster, torque=jnp.array([0.3, -0.5, 0.7]), start=0.72, stop=0.77)}
