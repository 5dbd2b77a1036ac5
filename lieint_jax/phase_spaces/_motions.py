"""The phase space of several rigid bodies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import PhaseMatrix, PhaseVector, Scalar
from lieint_jax.core import State, pytree, static
from lieint_jax.groups import so3
from lieint_jax.phase_spaces._groups import ByPerturbation


@pytree
class CotangentMotions(ByPerturbation):
    """(T*ℝ³ × T*SO(3))ᴺ, the phase space of N rigid bodies: q (N, 7), position and quaternion, and p (N, 6).

    Tangent vectors are (δx, δθ) of every body, then (δp, δπ) of every body, with δq = δθ q as on T*SO(3).

    Attributes:
        count: N.
    """

    count: int = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 12 N."""
        return 12 * self.count

    @property
    def origin(self) -> State:
        """All bodies at rest in the attitude 1, on a helix, at distances of at least 1 from each other."""
        n = jnp.arange(float(self.count))
        places = jnp.stack([1.3 * n, jnp.sin(n), jnp.cos(n)], axis=1)
        turns = jnp.tile(jnp.array([1.0, 0, 0, 0]), (self.count, 1))
        return State(jnp.concatenate([places, turns], axis=1), jnp.zeros((self.count, 6)))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ, shape (12N,): x + δx, exp(δθ) q, p + δp, π + δπ."""
        along_q, along_p = delta.reshape(2, self.count, 6)
        turned = jax.vmap(so3.multiply)(jax.vmap(so3.exp)(along_q[:, 3:]), state.q[:, 3:])
        return state._replace(q=_join_bodies(state.q[:, :3] + along_q[:, :3], turned), p=state.p + along_p)

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """(δq, δp) in the coordinates of `State`, δq = δθ q for the quaternions."""
        along_q, along_p = delta.reshape(2, self.count, 6)
        turned = jax.vmap(so3.spatial_tangent)(state.q[:, 3:], along_q[:, 3:])
        return _join_bodies(along_q[:, :3], turned), along_p

    def displacement(self, start: State, end: State) -> Array:
        """The δ, shape (12N,), with perturb(start, δ) = end, of the least δθ."""
        turn = jax.vmap(lambda a, b: so3.log(so3.multiply(b, so3.inverse(a))))(start.q[:, 3:], end.q[:, 3:])
        along_q = _join_bodies(end.q[:, :3] - start.q[:, :3], turn)
        return jnp.concatenate([along_q.ravel(), (end.p - start.p).ravel()])

    def units(self, state: State) -> tuple[Array, Array]:
        """The units in which differences are measured, from a state: of δx and δθ, and of δp and δπ, (6N,) each."""
        x, p, spin = state.q[:, :3], state.p[:, :3], state.p[:, 3:]
        length, momentum = (_or_one(jnp.max(jnp.abs(y))) for y in (x - jnp.mean(x, axis=0), p))
        spins = jnp.max(jnp.abs(spin), axis=1, keepdims=True)
        spins = jnp.where(spins > 0, spins, _or_one(jnp.max(spins)))
        lengths, along = (jnp.broadcast_to(y, x.shape) for y in (length, momentum))
        turns = jnp.broadcast_to(spins, x.shape)
        return _join_bodies(lengths, jnp.ones_like(x)).ravel(), _join_bodies(along, turns).ravel()

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δx, δθ, …, δp, δπ, …), shape (12N,), of a tangent vector given in the coordinates of `State`."""
        turning = jax.vmap(so3.spatial_velocity)(state.q[:, 3:], tangent.q[:, 3:])
        return jnp.concatenate([_join_bodies(tangent.q[:, :3], turning).ravel(), tangent.p.ravel()])

    def omega(self, state: State) -> PhaseMatrix:
        """[[α, 1], [−1, 0]], shape (12N, 12N), α being π̂ of each body on its δθ (2.9)."""
        one = jnp.eye(6 * self.count, dtype=state.p.dtype)
        spins = jnp.zeros((self.count, 6, 6), state.p.dtype).at[:, 3:, 3:].set(jax.vmap(so3.hat)(state.p[:, 3:]))
        alpha = jnp.zeros((self.count, 6, self.count, 6), state.p.dtype)
        n = jnp.arange(self.count)
        alpha = alpha.at[n, :, n, :].set(spins).reshape(one.shape)
        return jnp.block([[alpha, one], [-one, 0 * one]])

    def defect(self, state: State) -> Scalar:
        """The largest ||q|² − 1| of the quaternions."""
        return jnp.max(jnp.abs(jax.vmap(so3.defect)(state.q[:, 3:])))


def _join_bodies(linear: Array, angular: Array) -> Array:
    return jnp.concatenate([linear, angular], axis=1)


def _or_one(x: Array) -> Array:
    return jnp.where(x > 0, x, 1)
