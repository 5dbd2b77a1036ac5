"""Dissipative laws of two bodies and of chains, and the forces by which they act on N bodies."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

__all__ = ["ChainLaw", "PairLaw", "pair_forces"]

Action = tuple[Array, Array, Array]  # the force on the second body, and the torques on both, each (3,), in space


class PairLaw(abc.ABC):
    """A dissipative force between two bodies: (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j), all in space.

    r and v are the position and the velocity of the second body relative to the first, f is the force on the second, −f
    that on the first, and τ_i and τ_j are torques about the centers. A law must conserve angular momentum,
    r × f + τ_i + τ_j = 0, and must not supply energy, f·v + τ_i·ω_i + τ_j·ω_j ≤ 0. Every law f = −Au,
    τ_i + τ_j = r × Au, with A ≥ 0 and u the velocity of one surface relative to the other, satisfies both.

    A subclass is decorated with `li.pytree` and defines `__call__`. If bodies differ, it defines `between` too.
    """

    @abc.abstractmethod
    def __call__(self, r: Array, v: Array, omega_i: Array, omega_j: Array) -> Action: ...

    @property
    def count(self) -> int | None:
        """N, or None if the law holds for any number of bodies."""
        return None

    def between(self, i: int, j: int) -> PairLaw:
        """The law of two bodies by their numbers, i < j; here the same for all."""
        return self

    def loss(self, r: Array, v: Array, omega_i: Array, omega_j: Array) -> Array:
        """The power that is dissipated, ≥ 0; a law may override it by a sum of squares."""
        return -power(self(r, v, omega_i, omega_j), v, omega_i, omega_j)


class ChainLaw(abc.ABC):
    """A dissipative law in which each body acts only on the one before and the one after it, for all bodies at once."""

    @abc.abstractmethod
    def act(self, t: Array | None, x: Array, R: Array, v: Array, omega: Array) -> tuple[Array, Array]:
        """The forces and torques (N, 6) at positions, rotations, velocities and angular velocities in space, and
        their power, ≤ 0 unless bodies are driven."""


def power(action: Action, v: Array, omega_i: Array, omega_j: Array) -> Array:
    """f·v + τ_i·ω_i + τ_j·ω_j, a scalar."""
    f, tau_i, tau_j = action
    return jnp.sum(f * v + tau_i * omega_i + tau_j * omega_j)


def pair_forces(law: Callable[..., Any], x: Array, v: Array, omega: Array) -> tuple[Array, Array]:
    """The forces and torques (N, 6) of a pair law, or of a function of two bodies, on N bodies, and the power
    dissipated.

    Args:
        law: see `PairLaw`.
        x, v, omega: positions, velocities and angular velocities in space, (N, 3).
    """
    forces, torques = ([jnp.zeros_like(row) for row in x] for _ in range(2))
    lost = jnp.zeros((), x.dtype)
    for j in range(len(forces)):
        for i in range(j):
            pair = law.between(i, j) if isinstance(law, PairLaw) else law
            moving = x[j] - x[i], v[j] - v[i], omega[i], omega[j]
            f, tau_i, tau_j = action = pair(*moving)
            forces[i], forces[j] = forces[i] - f, forces[j] + f
            torques[i], torques[j] = torques[i] + tau_i, torques[j] + tau_j
            lost = lost + (pair.loss(*moving) if isinstance(pair, PairLaw) else -power(action, *moving[1:]))
    return jnp.concatenate([jnp.stack(forces), jnp.stack(torques)], axis=1), lost
