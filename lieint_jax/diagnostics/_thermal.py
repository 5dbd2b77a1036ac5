"""Certificates of steps with noise: the heat, the splitting without noise, and the drift of energy less heat."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, Trajectory
from lieint_jax.core.tangent import scale_at
from lieint_jax.diagnostics import _measure
from lieint_jax.diagnostics._order import reversibility_of_run
from lieint_jax.diagnostics._symplectic import dimensionless_defect

_BLOCKS = 20  # of a run, for the standard error of a mean


class ThermalCertificate(NamedTuple):
    """Measured properties of a thermostat, from one state; `print` shows them. Energies are in units of kT.

    Attributes:
        scheme, system, precision: the names of the step and of the system, "float64" or "float32".
        dt: step size.
        num_steps: length of the run.
        heat: max|Δ(H − Q)| over a run of the same bodies without their potential, relative to the kinetic energy: the
            heat is exact if this is round-off.
        step_energy: the largest |Δ(H − Q)| in a step.
        step_order: r of |ΔH| = O(Δtʳ) of the step without noise, from dt and dt/2; inf if it conserves energy.
        slope, slope_error: the mean of d(H − Q)/dt in the run, and its standard error by blocks.
        symplectic_defect: the defect of the step without noise, momenta in max|π|, which bounds that of the volume.
        reversibility: that of the step without noise.
        unbiased: whether the step samples the canonical measure without a bias: it is Metropolized, and
            symplectic_defect and reversibility are round-off; or there is no potential.
        rejected: the fraction of steps that were rejected; 0 for a step that rejects none.
        converged: whether every step converged.
    """

    scheme: str
    system: str
    precision: str
    dt: float
    num_steps: int
    heat: float
    step_energy: float
    step_order: float
    slope: float
    slope_error: float
    symplectic_defect: float
    reversibility: float
    unbiased: bool
    rejected: float
    converged: bool

    def __str__(self) -> str:
        bias = "exact for any dt" if self.unbiased else "with a bias O(dt^2)"
        rows = [
            ("heat", self.heat, "exact to round-off" if self.exact_heat else "NOT exact"),
            ("energy less heat", self.step_energy, f"the most in a step, {_power(self.step_order)}"),
            ("its mean slope", self.slope, f"± {self.slope_error:.2g} (kT per unit of time)"),
            ("symplectic form", self.symplectic_defect, "of the step without noise"),
            ("reversibility", self.reversibility, "of the step without noise"),
            ("canonical measure", self.rejected, f"{bias}; the number is the share of rejected steps"),
        ]
        head = f"{self.scheme} · {self.system} · dt = {self.dt:g}, {self.num_steps} steps, {self.precision}"
        more = [] if self.converged else ["  NOT every step converged"]
        return "\n".join([head, *(f"  {name:<17} {value:>9.2g}   {verdict}" for name, value, verdict in rows), *more])

    @property
    def exact_heat(self) -> bool:
        """Whether the heat is exact to round-off."""
        return self.heat <= 16 * float(jnp.finfo(self.precision).eps) * math.sqrt(max(self.num_steps, 1))


def _power(order: float) -> str:
    return "round-off" if math.isinf(order) else f"as dt^{order:.2f} without noise"


def certify_thermostat(step: Any, state: State, dt: float, num_steps: int) -> ThermalCertificate:
    """Measure the properties of a step with noise, from one state; see `ThermalCertificate`."""
    num_steps = _checks.count("num_steps", num_steps, 0)
    most = max(num_steps, 2 * _BLOCKS)
    step, state, h = _measure.checked(step, state, dt, most)
    run, free = (_measure.run(x, state, h, num_steps, most) for x in (step, step.free))
    kT, quiet = float(step.temperature), step.deterministic
    paths = (step, run), (step.free, free)
    less, alone = (np.asarray(_energies(x.system, path.state)) - _extra_series(path, "heat") for x, path in paths)
    kinetic = float(np.abs(alone).max()) + float(np.abs(_extra_series(free, "heat")).max())
    sizes = [float(_largest_change(quiet, run.state, x)) for x in (h, h / 2)]
    eps = float(jnp.finfo(h.dtype).eps)
    exact = sizes[0] <= 64 * eps * (abs(float(less[0])) + kT) or sizes[1] == 0
    slope, slope_error = _slope(less, float(dt))
    scale = scale_at(quiet.system, state)
    form = float(dimensionless_defect(quiet, state, h, scale))
    back = float(reversibility_of_run(quiet, state, h, 1, scale))
    floor = 32 * eps * step.system.phase_space.dim
    accepted = not step.metropolis or (form <= floor and back <= floor)
    rejected = _extra_series(run, "rejections") if step.metropolis else np.zeros(1)
    return ThermalCertificate(
        scheme=step.name,
        system=type(step.system).__name__,
        precision=str(h.dtype),
        dt=float(dt),
        num_steps=num_steps,
        heat=float(np.abs(alone - alone[0]).max()) / (kinetic or 1.0),
        step_energy=float(np.abs(np.diff(less)).max(initial=0.0)) / kT,
        step_order=math.inf if exact else math.log2(sizes[0] / sizes[1]),
        slope=slope / kT,
        slope_error=slope_error / kT,
        symplectic_defect=form,
        reversibility=back,
        unbiased=accepted and (step.metropolis or step.system is step.free.system),
        rejected=float(rejected[-1] - rejected[0]) / max(num_steps, 1),
        converged=bool(run.info.converged.all()),
    )


def _extra_series(run: Trajectory, name: str) -> np.ndarray:
    return np.asarray((run.state.extra or {})[name])


@partial(compiled, once=True)
def _energies(system: Any, states: State) -> Array:
    return jax.vmap(lambda z: system.energy(z))(states)


@partial(compiled, once=True)
def _largest_change(step: Step, states: State, h: Array) -> Array:
    """max|ΔH| in a step, from each of these states."""
    return jnp.max(jnp.abs(jax.vmap(lambda z: step.system.energy(step(z, h)[0]) - step.system.energy(z))(states)))


def _slope(x: np.ndarray, dt: float) -> tuple[float, float]:
    """The mean rate of a series and its standard error, by the means of blocks of it."""
    if len(x) <= _BLOCKS:
        return math.nan, math.nan
    ends = x[np.linspace(0, len(x) - 1, _BLOCKS + 1).astype(int)]
    rates = np.diff(ends) / (dt * (len(x) - 1) / _BLOCKS)
    return float(rates.mean()), float(rates.std(ddof=1) / math.sqrt(_BLOCKS))
