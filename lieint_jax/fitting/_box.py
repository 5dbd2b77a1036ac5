"""A box low < y < high of coordinates, some of whose sides may be infinite."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._numerics.arrays import PyTree

_EDGE = 1e-6  # distance from a side over that of the first guess, below which a coordinate counts as at its bound
_APPROACH = 0.999  # the part of the way to a side that a step may go
_RANGE = 0.9  # part of the range of floating-point numbers that `inside` uses


class Box(NamedTuple):
    """The sides of a box: concrete numbers, or arrays of the shape of the coordinates.

    Attributes:
        low: the lower sides, −inf where there is none.
        high: the upper sides, inf where there is none.
    """

    low: ArrayLike = -np.inf
    high: ArrayLike = np.inf

    def contains(self, y: ArrayLike) -> np.ndarray:
        """Whether each of some concrete coordinates is finite and between its sides, not on one."""
        return np.isfinite(y) & (np.asarray(y) > self.low) & (np.asarray(y) < self.high)

    def inside(self, x: Array) -> Array:
        """The smooth map of all real x onto the box: exponential from one side, logistic between two."""
        low, high = self._sides(x)
        u = self._limited(x)
        return self._select(low + (high - low) * jax.nn.sigmoid(u), low + jnp.exp(u), high - jnp.exp(-u), x)

    def slope(self, x: Array) -> Array:
        """The derivative of `inside`, nowhere 0."""
        low, high = self._sides(x)
        u = self._limited(x)
        between = (high - low) * jax.nn.sigmoid(u) * jax.nn.sigmoid(-u)
        return self._select(between, jnp.exp(u), jnp.exp(-u), jnp.ones_like(x))

    def free(self, y: Array) -> Array:
        """The inverse of `inside`; not finite for coordinates outside the box."""
        low, high = self._sides(y)
        from_low = jnp.log(jnp.where(np.isfinite(low), y - low, 1))
        from_high = jnp.log(jnp.where(np.isfinite(high), high - y, 1))
        return self._select(from_low - from_high, from_low, -from_high, y)

    def projected(self, y: Array, gradient: Array) -> Array:
        """The projected gradient at y, reduced where descent soon meets a side: it vanishes at a minimum in the box."""
        return gradient * jnp.minimum(1, self._room(y, gradient) / jnp.maximum(jnp.abs(y), 1))

    def changes(self, y: Array, gradient: Array, size: Array) -> Array:
        """By how much the loss would change along each coordinate on a way of length `size`, or to the side."""
        return jnp.abs(gradient) * jnp.minimum(jnp.where(size > 0, size, 1), self._room(y, gradient))

    def reach(self, y: Array) -> tuple[Array, Array]:
        """The lowest and the highest step of each coordinate, which end slightly inside its sides."""
        low, high = self._sides(y)
        return _APPROACH * (low - y), _APPROACH * (high - y)

    def shortened(self, y: Array, step: Array) -> Array:
        """A step from y, or the part of it that stays inside."""
        low, high = self.reach(y)
        room = jnp.where(step > 0, high, -low)
        return step * jnp.min(jnp.where(jnp.abs(step) > room, room / jnp.where(step != 0, jnp.abs(step), 1), 1))

    def at_side(self, y: Array, start: Array) -> Array:
        """True for coordinates whose distance from a side is negligible compared with that of the first guess."""
        low, high = self._sides(y)
        lower = np.isfinite(low) & (y <= low + _EDGE * (start - low))
        return lower | np.isfinite(high) & (y >= high - _EDGE * (high - start))

    def _room(self, y: Array, gradient: Array) -> Array:
        """The distance from the side to which descent leads."""
        low, high = self._sides(y)
        return jnp.where(gradient > 0, y - low, high - y)

    def _sides(self, y: Array) -> tuple[PyTree, PyTree]:
        """The sides in the precision of the coordinates."""
        return np.asarray(self.low, y.dtype), np.asarray(self.high, y.dtype)

    def _limited(self, x: Array) -> Array:
        """x, clipped where exp(x) would overflow or the logistic function round to a side; 0 where there is no side."""
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        limits = jnp.finfo(x.dtype)
        most = _RANGE * np.where(below & above, -np.log(limits.eps), np.log(limits.max))
        return jnp.where(below | above, jnp.clip(x, -most.astype(x.dtype), most.astype(x.dtype)), 0)

    def _select(self, between: Array, above_low: Array, below_high: Array, unbounded: Array) -> Array:
        """For each coordinate one of four values, depending on which of its sides are finite."""
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        return jnp.where(below, jnp.where(above, between, above_low), jnp.where(above, below_high, unbounded))
