"""A certificate: one report of all conservation properties of a step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._xla import compiled, shapes_now
from lieint_jax.core import State, Step, System, Trajectory, energy_less_work, start_time, time_derivative
from lieint_jax.core.tangent import swinging
from lieint_jax.diagnostics import _measure
from lieint_jax.diagnostics._order import fitted_order, reversibility_of_run
from lieint_jax.diagnostics._symplectic import dimensionless_defect
from lieint_jax.diagnostics._thermal import ThermalCertificate, certify_thermostat
from lieint_jax.groups import MatrixGroup, matrix
from lieint_jax.runs import RunError, estimate

if TYPE_CHECKING:
    from lieint_jax.schemes import Langevin

_ROUNDING = 64  # eps: an energy below this part of the kinetic energy is 0
_SPAN = 8  # the number of steps of size dt over which the order is measured


class Certificate(NamedTuple):
    """The error of a run and the conservation properties of its step; `print` shows them with verdicts.

    Up to 16 ε√n after n steps an error is called round-off, with ε that of the precision. Up to nε it is at most one
    rounding per step: where each step adds nearly the same small number, as tides do to a momentum, all sums are
    rounded in the same direction.

    Attributes:
        scheme: name of the step.
        system: name of the system.
        precision: "float64" or "float32".
        dt: step size.
        num_steps: length of the run that gives energy, momentum, constraint, residual and converged.
        energy: max|H_n − H₀| / |H₀|; for H less work if the state counts work. Where H₀ is 0 to round-off it is over
            the greatest kinetic energy.
        momentum: max|Φ_n − Φ₀| / max|Φ₀| over the components of the momentum map; nan if there is none. Where Φ₀ is 0
            it is over the sum of its absolute terms.
        constraint: largest defect of the configuration, such as ||q|² − 1|.
        symplectic_defect: max|Lᵀω(z₁)L − ω(z₀)| of the first step, momenta measured in max|π|.
        symplectic_order: r of a defect O(Δtʳ) per step, from dt and dt/2; inf if the defect is round-off. If r is below
            order + 1, the motion itself is not symplectic (dissipation, or torques without a potential), or the steps
            vary with the state.
        order: measured order of accuracy; inf if exact to round-off.
        reversibility: max|z − step(step(z, dt), −dt)|, momenta measured in max|π|; inf if the step of −dt does not
            converge, as those of a sampled law.
        residual: largest residual of the run.
        converged: whether every step converged.
        work: whether the state counts work.
        clock: the relative error of energy less work that rounding of the time causes, √n·ulp(t)·max|power| / |H₀|.
        own_time: whether the steps vary with the state.
        cancellation: the sum of the absolute terms of the momentum map over max|Φ₀|, the factor by which its rounding
            error is larger.
        momentum_map: whether the system has a momentum map.
        hamiltonian: whether the system has an energy and a symplectic form, whose fields are nan otherwise.
        scheme_order: the order that the scheme declares.
        error: how far the run is from the exact motion, by runs with dt/2 and dt/4; None if a step of them did not
            converge. Where steps vary with the state, the runs are compared at equal times.
    """

    scheme: str
    system: str
    precision: str
    dt: float
    num_steps: int
    energy: float
    momentum: float
    constraint: float
    symplectic_defect: float
    symplectic_order: float
    order: float
    reversibility: float
    residual: float
    converged: bool
    work: bool = False
    clock: float = 0.0
    own_time: bool = False
    cancellation: float = 1.0
    momentum_map: bool = True
    hamiltonian: bool = True
    scheme_order: float = math.nan
    error: RunError | None = None

    def __str__(self) -> str:
        eps = float(jnp.finfo(self.precision).eps)
        bounds = eps * np.array([16 * math.sqrt(max(self.num_steps, 1)), self.num_steps])
        rows = [
            (
                "energy less work" if self.work else "energy",
                self.energy,
                _verdict(self.energy, bounds + self.clock, eps),
            ),
            ("momentum", self.momentum, _verdict(self.momentum, bounds * self.cancellation, eps)),
            ("constraint", self.constraint, _verdict(self.constraint, bounds, eps)),
            ("symplectic form", self.symplectic_defect, self._form()),
            ("reversibility", self.reversibility, self._reversible(bounds, eps)),
            ("residual", self.residual, "every step converged" if self.converged else "NOT every step converged"),
            ("order", self.order, self._measured_order()),
        ]
        head = f"{self.scheme} · {self.system} · dt = {self.dt:g}, {self.num_steps} steps, {self.precision}"
        lines = [f"  {name:<16} {value:>9.2g}   {verdict}" for name, value, verdict in rows]
        if not self.momentum_map:
            lines[1] = f"  {'momentum':<16} {'—':>9}   no momentum map"
        if not self.hamiltonian:  # neither energy, momentum nor a form
            del lines[3], lines[:2]
        return "\n".join([self._error_line(), head, *lines])

    def _error_line(self) -> str:
        """How wrong the run is: what its conserved energy does not show."""
        if self.error is None:
            return "how far off it is was not measured: not every step of the runs with dt, dt/2 and dt/4 converged"
        return self.error.summary

    def _reversible(self, bounds: np.ndarray, eps: float) -> str:
        """The verdict on a step and one back."""
        if math.isinf(self.reversibility):
            return "not reversible: a step of −dt is refused, or does not converge"
        return _verdict(self.reversibility, bounds, eps, "reversible")

    def _measured_order(self) -> str:
        """The verdict on the order; a measured one that differs by more than ½ is not that of small steps."""
        if math.isinf(self.order):
            return "exact flow"
        if abs(self.order - self.scheme_order) > 0.5:
            return f"measured {self.order:.2f}: the scheme's {self.scheme_order:g} does not show near this dt"
        return f"measured {self.order:.2f}"

    def _form(self) -> str:
        """The verdict on the form. A step of order r has a defect O(dt^(r+1)); a larger one is that of the motion."""
        if math.isinf(self.symplectic_order):
            return "exact to round-off a step"
        law = f"as dt^{self.symplectic_order:.2f} a step"
        if self.symplectic_order < self.order + 0.5 and not self.own_time:
            return f"not conserved by the motion itself: it changes {law}"
        return f"broken {law}"


@overload
def certify(step: Langevin, state: State, dt: float, num_steps: int) -> ThermalCertificate: ...  # pyright: ignore[reportOverlappingOverload]
@overload
def certify(step: Step, state: State, dt: float, num_steps: int) -> Certificate: ...
def certify(step: Step, state: State, dt: float, num_steps: int) -> Certificate | ThermalCertificate:
    """Measure how wrong a run from `state` is and what `step` conserves: energy, momentum, form, order, reversibility.

    For a step with noise (`schemes.langevin`) it measures whether the heat is exact, the change of energy less heat,
    and whether the canonical measure has a bias.

    Args:
        step: a scheme's step.
        state: the initial state of one body.
        dt: step size.
        num_steps: length of the run along which the invariants and the error are measured; the error requires six
            times as many steps.

    Returns:
        A `Certificate`, or a `ThermalCertificate` for a step with noise; `print` shows the verdicts.

    Raises:
        ValueError: as in `integrate`.
    """
    if isinstance(step, Step) and step.deterministic is not None:
        return certify_thermostat(step, state, dt, num_steps)
    num_steps = _checks.count("num_steps", num_steps, 0)
    most = max(num_steps, 4 * _SPAN)  # one program for all runs
    step, state, h = _measure.checked(step, state, dt, most)
    _checks.time_resolution(start_time(step, state), h, num_steps)
    run = _measure.run(step, state, h, num_steps, most)
    seen = jax.device_get(_measure_invariants(step.system, run))
    form, coarse, fine = _on_arrays(step), math.nan, math.nan
    if step.system.hamiltonian:
        halves = h, _checks.as_array(np.asarray(h) / 2)
        coarse, fine = (float(dimensionless_defect(form, state, x, seen.scale)) for x in halves)
    floor = 32 * float(jnp.finfo(h.dtype).eps) * max(1, step.system.phase_space.dim / 6)
    power = math.log2(coarse / fine) if coarse > floor and fine > 0 else math.inf
    rounding = power < 1 and coarse < 10 * floor  # which does not fall with dt
    return Certificate(
        scheme=step.name,
        system=type(step.system).__name__,
        precision=str(h.dtype),
        dt=float(dt),
        num_steps=num_steps,
        energy=_relative(seen.energy, seen.size),
        momentum=_relative(seen.momentum, seen.total or seen.terms),
        constraint=float(seen.constraint),
        symplectic_defect=coarse,
        symplectic_order=math.inf if rounding else power,
        order=fitted_order(step, state, dt, _SPAN, most),
        reversibility=float(reversibility_of_run(step, state, h, most, seen.scale)),
        residual=float(run.info.residual.max()),
        converged=bool(run.info.converged.all()),
        work=state.work is not None,
        clock=_relative(_clock_error(run.state, dt), seen.size),
        own_time=step.own_time,
        cancellation=max(1.0, _relative(seen.terms, seen.total)),
        momentum_map=shapes_now(step.system.momentum, state).size > 0,
        hamiltonian=step.system.hamiltonian,
        scheme_order=step.order,
        error=_error(step, state, h, num_steps, most, run),
    )


def _error(step: Step, state: State, h: Array, num_steps: int, most: int, run: Trajectory) -> RunError | None:
    """The error of a run at all its steps, by the program that made it; None if a step did not converge."""
    finer = [
        _measure.run(step, state, _checks.as_array(np.asarray(h) / parts), num_steps, most, save_every=parts)
        for parts in (2, 4)
    ]
    if not (step.approximate or all(x.info.converged.all() for x in (run, *finer))):
        return None
    half, quarter = (
        jax.device_get(_at_times(step.system, x.state, run.t)) if step.own_time else x.state for x in finer
    )
    return estimate(np.asarray(run.t), None, step.order, run.state, half, quarter, num_steps)


@partial(compiled, once=True)
def _at_times(system: System, states: State, t: Array) -> State:
    """States moved to times that are near their own, to first order."""

    def shift(state: State, t: Array) -> State:
        assert state.t is not None  # a step with its own time advances it
        rate = time_derivative(system, state)
        return state._replace(q=state.q + (t - state.t) * rate.q, p=state.p + (t - state.t) * rate.p)

    return jax.vmap(shift)(states, t)


class MeasuredInvariants(NamedTuple):
    """The largest errors of invariants in a run, and the sizes to which they are relative.

    Attributes:
        energy, size: max|H_n − H₀|, for H less work if the state counts work, and |H₀|, or the greatest kinetic energy
            where H₀ is 0 to round-off.
        momentum, total, terms: max|Φ_n − Φ₀|, max|Φ₀|, and the largest sum of absolute terms of a component of Φ₀;
            nan, 0 and 0 where there is no momentum map.
        constraint: the largest defect of the configuration.
        scale: the state that gives the units of momenta, see `tangent.swinging`.
    """

    energy: ArrayLike
    size: ArrayLike
    momentum: ArrayLike
    total: ArrayLike
    terms: ArrayLike
    constraint: ArrayLike
    scale: State


@partial(compiled, once=True)
def _measure_invariants(system: System, run: Trajectory) -> MeasuredInvariants:
    start = jax.tree.map(lambda x: x[0], run.state)

    def largest_change(function: Callable[[State], Array]) -> Array:
        x = jax.vmap(function)(run.state)
        return jnp.max(jnp.abs(x - x[:1]))

    total, p = system.momentum(start), run.state.p
    none = not total.size
    fastest = jnp.argmax(jnp.max(jnp.abs(p), axis=range(1, p.ndim), initial=0))
    moving = jax.tree.map(lambda x: x[jnp.where(jnp.any(total != 0), 0, fastest)], run.state)
    return MeasuredInvariants(
        energy=largest_change(partial(energy_less_work, system)),
        size=_energy_size(system, run.state),
        momentum=jnp.nan if none else largest_change(system.momentum),
        total=0.0 if none else jnp.max(jnp.abs(total)),
        terms=0.0 if none else jnp.max(_terms(system, moving)),
        constraint=jnp.max(jnp.abs(jax.vmap(system.phase_space.defect)(run.state))),
        scale=swinging(system, start),
    )


def _energy_size(system: System, states: State) -> Array:
    """|H₀|, or the greatest kinetic energy where H₀ is 0 to round-off."""
    first = jnp.abs(system.energy(jax.tree.map(lambda x: x[0], states)))
    kinetic = jax.vmap(lambda z: system.energy(z) - system.energy(z._replace(p=jnp.zeros_like(z.p))))(states)
    greatest = jnp.max(jnp.abs(kinetic))
    return jnp.where(first <= _ROUNDING * jnp.finfo(first.dtype).eps * greatest, greatest, first)


def _terms(system: System, state: State) -> Array:
    """The sum of the absolute terms of each component of the momentum map, which is linear in p."""
    slope = jax.jacfwd(lambda p: system.momentum(state._replace(p=p)))(state.p)
    return jnp.sum(jnp.abs(slope.reshape(-1, state.p.size) * state.p.reshape(1, -1)), axis=1)


def _on_arrays(step: Step) -> Step:
    """The step with the arithmetic of its group on whole arrays, if it has both, which compiles faster.

    The derivative of a step on SO(4) written out in scalars has 28 000 operations.
    """
    match step.system:
        case object(group=MatrixGroup(unrolled=True) as G) if dataclasses.is_dataclass(step) and "system" in vars(step):
            group = matrix(G.basis, G.name, unrolled=False)
            return dataclasses.replace(step, system=dataclasses.replace(cast("Any", step.system), group=group))
    return step


def _clock_error(states: State, dt: float) -> float:
    """√n·ulp(t)·max|power| of a run that saved every step, with the power of the work; 0 if no work is tracked."""
    if states.work is None or states.t is None or len(states.work) < 2:
        return 0.0
    power = np.abs(np.diff(np.asarray(states.work))).max() / abs(dt)
    return float(math.sqrt(len(states.work)) * np.spacing(np.abs(np.asarray(states.t)).max()) * power)


def _relative(error: float, size: float) -> float:
    return float(error / size) if size else float(error)


def _verdict(error: float, bounds: np.ndarray, eps: float, verb: str = "conserved") -> str:
    """The verdict on an error, by the bounds of rounding errors that are random and that are all of one sign."""
    if math.isnan(error):
        return "not a number"
    if error == 0:
        return f"{verb} bit for bit"
    random, biased = bounds
    digits = f"{-math.log10(max(error, eps)):.1f} digits" if error < 1 else "no digit"
    if error <= random:
        return f"{verb} to round-off, {digits}"
    return f"{verb} to one rounding per step, {digits}" if error <= biased else f"not {verb}, {digits}"
