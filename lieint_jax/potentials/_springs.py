"""Springs between sites of bodies."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import for_each, named, not_negative, real_array
from lieint_jax._numerics.arrays import Calls, Positions, Rotations, Scalar
from lieint_jax.core import Converted, argument, pytree, static
from lieint_jax.potentials._potential import Potential

__all__ = ["Springs", "springs"]


def _pairs(bodies: Any) -> tuple[tuple[int, int], ...]:
    pairs = np.asarray(bodies)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu" or (pairs < 0).any():
        raise ValueError(f"bodies must be pairs of indices ≥ 0, (k, 2), got {bodies!r}")
    if not len(pairs):
        raise ValueError("springs needs at least one spring, got bodies of shape (0, 2)")
    if (pairs[:, 0] == pairs[:, 1]).any():
        raise ValueError(f"a spring must join two bodies, got {pairs.tolist()}")
    return tuple((int(i), int(j)) for i, j in pairs)


@pytree
class Springs(Potential):
    """Massless springs, each between a point of one body and a point of another: V = Σ ½ k (r − ℓ)².

    The potential is invariant: P and L are conserved. The force of a spring is set to 0 where its ends coincide.

    Args:
        bodies: the two bodies of each of k springs, counted from 0, (k, 2).
        points: the springs' ends, in the axes of these bodies, (k, 2, 3).
        stiffness: ≥ 0, (k,), or one for all.
        lengths: ℓ ≥ 0, at which the springs are slack, (k,), or one for all.

    Raises:
        ValueError: there is no spring, shapes disagree, a spring joins a body to itself, or a stiffness or length is
            negative.
    """

    bodies: Converted[tuple[tuple[int, int], ...]] = static(converter=_pairs)
    points: Converted[Array] = argument(converter=named(real_array, "points"))
    stiffness: Converted[Array] = argument(converter=named(real_array, "stiffness"))
    lengths: Converted[Array] = argument(converter=named(real_array, "lengths"), default=0.0)

    def check_fields(self) -> dict[str, Array]:
        """A stiffness and a length for each spring; ValueError if shapes disagree."""
        k = len(self.bodies)
        real_array("points", self.points, (k, 2, 3))
        stiffness = for_each(not_negative, "stiffness", self.stiffness, k)
        return {"stiffness": stiffness, "lengths": for_each(not_negative, "lengths", self.lengths, k)}

    def invariants(self, x: Positions, R: Rotations) -> Array:
        """The squared length of each spring, (k,)."""
        if max(map(max, self.bodies)) >= x.shape[0]:
            raise ValueError(f"springs join the bodies {self.bodies}, but there are {x.shape[0]}, counted from 0")
        a, b = (self._end(k, x, R) for k in (0, 1))
        return jnp.sum((a - b) ** 2, axis=1)

    def value(self, invariants: Array) -> Scalar:
        """V of the squared lengths."""
        stretched = jnp.where(invariants > 0, (_root(invariants) - self.lengths) ** 2, invariants + self.lengths**2)
        return jnp.sum(self.stiffness * stretched) / 2

    def discrete_gradient(self, start: Array, end: Array) -> Array:
        """D with D·(end − start) = V(end) − V(start), in closed form, without cancellation."""
        together = _root(start) + _root(end)
        inverse = jnp.where(together > 0, 1 / jnp.where(together > 0, together, 1), 0)
        return self.stiffness * (0.5 - self.lengths * inverse)

    def _end(self, k: int, x: Positions, R: Rotations) -> Array:
        body = np.array(self.bodies)[:, k]
        return x[body] + jnp.sum(R[body] * self.points[:, k, None, :], axis=2)


def _root(u: Array) -> Array:
    """√u, with derivative 0 at 0."""
    return jnp.where(u > 0, jnp.sqrt(jnp.where(u > 0, u, 1)), 0)


springs = Springs


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    points = jnp.array([[[0.1, 0.2, 0.0], [-0.1, 0.0, 0.1]]])
    return {"springs": partial(springs, bodies=((0, 1),), points=points, stiffness=0.3, lengths=0.4)}
