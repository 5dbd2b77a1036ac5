"""Invariants along a trajectory, as series in time. For a batch of trajectories, vmap."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax import _checks
from lieint_jax.types import System, Trajectory, energy_less_work


def energy_error(system: System, trajectory: Trajectory) -> Array:
    """H(z_n) − W_n − H(z₀) + W₀, shape (n+1,), in units of energy; W is `state.work`, 0 if it is not counted."""
    kept = jax.vmap(partial(energy_less_work, system))(trajectory.state)
    return kept - kept[0]


def momentum_error(system: System, trajectory: Trajectory) -> Array:
    """Φ(z_n) − Φ(z₀), shape (n+1, k), of the momentum map Φ."""
    momentum = jax.vmap(system.momentum)(trajectory.state)
    return momentum - momentum[0]


def constraint_error(system: System, trajectory: Trajectory) -> Array:
    """The distance of q from the configuration space, shape (n+1,): |q|² − 1 for unit quaternions."""
    return jax.vmap(system.phase_space.defect)(trajectory.state)


def delay(series: Array, lag: int) -> Array:
    """The delay plot of a series: points (x_n, x_{n+lag}, x_{n+2lag}), shape (len − 2·lag, 3)."""
    lag = _checks.count("lag", lag, 1)
    if series.ndim != 1 or len(series) <= 2 * lag:
        raise ValueError(f"a delay plot of lag {lag} needs a series of more than {2 * lag} numbers, got {series.shape}")
    n = len(series) - 2 * lag
    return jnp.stack([series[k * lag : k * lag + n] for k in range(3)], axis=1)
