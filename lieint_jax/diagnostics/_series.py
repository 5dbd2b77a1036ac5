"""Invariants along a trajectory, or along those of a batch, as series in time."""

from __future__ import annotations

import jax.numpy as jnp

from lieint_jax import _checks
from lieint_jax._numerics.arrays import DelayPlot, InvariantSeries, MomentumSeries, TimeSeries
from lieint_jax.core import System, Trajectory, energy_less_work
from lieint_jax.runs import Run
from lieint_jax.runs.members import Axis, map_over_run


def energy_error(
    system: System | Run, trajectory: Trajectory | None = None, system_axis: Axis = "auto"
) -> InvariantSeries:
    """H(z_n) − W_n − H(z₀) + W₀ in units of energy; W is `state.work`, 0 if it is not counted.

    Args:
        system: a run, and nothing else; or the system of a trajectory.
        trajectory: a trajectory of one body, or of a batch with the axes (time, member) of `li.run`.
        system_axis: for a batch, None if all members have one system, 0 if there is one per member, on the leading axis
            of the leaves (`own_step=True` of `li.run`). With "auto" it is None if the arrays have the shapes of one
            system; a square one must then be a tensor, symmetric and positive definite. A run needs no axis.

    Returns:
        Shape (n+1,), or (n+1, members).

    Raises:
        ValueError: the shapes contradict `system_axis`; the axes are (member, time).
    """
    if isinstance(system, Run):
        return system.energy_error()
    kept = map_over_run(energy_less_work, system, _required(trajectory), system_axis)
    return kept - kept[:1]


def momentum_error(
    system: System | Run, trajectory: Trajectory | None = None, system_axis: Axis = "auto"
) -> MomentumSeries:
    """Φ(z_n) − Φ(z₀) of the momentum map Φ, (n+1, k) or (n+1, members, k); arguments as in `energy_error`."""
    if isinstance(system, Run):
        return system.momentum_error()
    momentum = map_over_run(lambda own, z: own.momentum(z), system, _required(trajectory), system_axis)
    return momentum - momentum[:1]


def constraint_error(
    system: System | Run, trajectory: Trajectory | None = None, system_axis: Axis = "auto"
) -> InvariantSeries:
    """The distance of q from the configuration space, (n+1,) or (n+1, members): |q|² − 1 for unit quaternions.

    Arguments as in `energy_error`.
    """
    if isinstance(system, Run):
        return system.constraint_error()
    return map_over_run(lambda own, z: own.phase_space.defect(z), system, _required(trajectory), system_axis)


def _required(trajectory: Trajectory | None) -> Trajectory:
    if trajectory is None:
        raise ValueError("give a li.Run, or a system and its trajectory")
    return trajectory


def delay(series: TimeSeries, lag: int) -> DelayPlot:
    """The points of the delay plot of a series, (x_n, x_{n+lag}, x_{n+2lag}), shape (len − 2·lag, 3)."""
    lag = _checks.count("lag", lag, 1)
    if series.ndim != 1 or len(series) <= 2 * lag:
        raise ValueError(f"a delay plot of lag {lag} needs a series of more than {2 * lag} numbers, got {series.shape}")
    n = len(series) - 2 * lag
    return jnp.stack([series[k * lag : k * lag + n] for k in range(3)], axis=1)
