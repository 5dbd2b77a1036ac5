"""Invariants along a trajectory, as series in time. For a batch of trajectories, vmap."""

from __future__ import annotations

import jax
from jax import Array

from lieint_jax.types import System, Trajectory


def energy_error(system: System, trajectory: Trajectory) -> Array:
    """H(z_n) − H(z₀), shape (n+1,), in units of energy."""
    energy = jax.vmap(system.energy)(trajectory.state)
    return energy - energy[0]


def momentum_error(system: System, trajectory: Trajectory) -> Array:
    """Φ(z_n) − Φ(z₀), shape (n+1, k), of the momentum map Φ."""
    momentum = jax.vmap(system.momentum)(trajectory.state)
    return momentum - momentum[0]


def constraint_error(system: System, trajectory: Trajectory) -> Array:
    """By how much q leaves the configuration space: |q|² − 1, shape (n+1,), for unit quaternions."""
    return jax.vmap(system.phase_space.defect)(trajectory.state)
