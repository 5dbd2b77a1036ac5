"""Gauss–Legendre collocation: symplectic, of any even order, in canonical coordinates of a flat space.

    Y_i = z_n + Δt Σ_j a_ij k_j,    k_i = f(Y_i),    z_{n+1} = z_n + Δt Σ b_i k_i

It conserves quadratic invariants: on T*SO(3), with the quaternion q and p = 2πq as unknowns (see `charts.canonical`),
the length |q|, q·p and the components of π that the potential conserves. So the step maps T*SO(3) to itself, and is
symplectic there. The equations are solved by fixed-point iteration on all k_i together: a sweep.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import count, named
from lieint_jax._numerics import collocation
from lieint_jax.core import Converted, State, Step, StepInfo, System, argument, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.equation import FixedPointEquation
from lieint_jax.schemes.charts.canonical import CanonicalChart, Coordinates, Increments, canonical_chart
from lieint_jax.systems._equations import (
    AbstractDrivenTop,
    AbstractElasticBody,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractGyrostat,
    AbstractMechanicalSystem,
    AbstractRigidBodies,
    AbstractTop,
)

__all__ = ["Gauss", "gauss"]

_MOST = 100  # sweeps
_NODES = 4  # of the guess of a step with more, and its sweeps: each gains an order
_REFINEMENTS = 60  # sweeps of the linear equations for derivatives

PROPERTIES = SchemeProperties(
    name="gauss",
    systems="free and elastic bodies, gyrostats, tops, satellites, several bodies",
    conserves=("momentum", "form"),
    order=16,
    limit="about one radian of the fastest motion",
    aliases=("Gauss–Legendre collocation",),
    source="Hairer, Lubich & Wanner 2006, II.1.3, VI.4",
    accepts=(
        AbstractFreeBody,
        AbstractGyrostat,
        AbstractTop,
        AbstractDrivenTop,
        AbstractMechanicalSystem,
        AbstractFreeBodies,
        AbstractRigidBodies,
        AbstractElasticBody,
    ),
)


@pytree
class Gauss(Step):
    """Gauss–Legendre collocation of order 2s, in canonical coordinates.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off, once the sweeps have converged |
    | momentum, whole or γ·π | round-off |
    | energy | O(Δt²ˢ), bounded, no drift: below round-off at useful steps |

    The scheme is time-symmetric, and the best choice where accuracy matters: with 8 stages at |Δt Ω| = ½ the error is
    below 1e-10. A sweep evaluates the vector field at all stages; about 12 to 20 sweeps are needed.

    Args:
        system: a free body, a gyrostat, a top, driven or not, several bodies, or a pseudo-rigid body.
        stages: s ≥ 1.
        sweeps: a fixed number of sweeps; by default sweeps continue until convergence. With too few, form and momentum
            are conserved to the residual only, which the step reports, and `converged` is False above round-off.

    Raises:
        ValueError: the system is none of these, or overrides their equations of motion; stages or
            sweeps is not a positive int.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, II.1.3, VI.4; Antoñana, Makazaga & Murua 2017,
    Numer. Algorithms 76.
    """

    system: System = argument(converter=PROPERTIES.check)
    stages: Converted[int] = static(converter=named(count, "stages", 1), default=8)
    sweeps: Converted[int | None] = static(converter=named(count, "sweeps", 1, optional=True), default=None)
    order: float = static(init=False)
    symmetric: bool = static(default=True, init=False)
    loops = True

    def check_fields(self) -> dict[str, float]:
        if canonical_chart(self.system) is None:
            space = self.system.phase_space
            raise ValueError(f"gauss has canonical coordinates on T*SO(3) only, not on those of {space}")
        return {"order": 2.0 * self.stages}

    @property
    def approximate(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.sweeps is not None

    @property
    def name(self) -> str:
        return f"gauss[{self.stages}]" if self.sweeps is None else f"gauss[{self.stages}, {self.sweeps} sweeps]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt = jnp.asarray(dt, state.p.dtype)
        equation = _Equation.from_state(self, state, dt)
        guess = equation.without_derivative().guess()
        k, info = equation.solve(guess, _MOST, 4, _REFINEMENTS)
        return equation.end(k), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        limit = "its sweeps diverge" if self.sweeps is None else f"{self.sweeps} sweeps are too few"
        return (
            f"{self.name} does not converge at dt = {dt}: {limit}. Use a smaller dt: the fastest frequency of the "
            "motion times dt should be at most 1"
        )


@dataclass(frozen=True)
class _Equation(FixedPointEquation[Coordinates]):
    """The equations of one step, for the derivatives k of the coordinates at the stages."""

    chart: CanonicalChart
    system: System
    rate: Callable[[Any, Any], Coordinates]  # of the coordinates, (z, t) ↦ k
    state: State  # that the step begins at
    start: Coordinates  # of this state
    dt: Array
    stages: int
    sweeps: int | None  # their number if it is fixed

    @classmethod
    def from_state(cls, step: Gauss, state: State, dt: Array) -> _Equation:
        chart, system = canonical_chart(step.system), step.system
        assert chart is not None
        start = chart.unknowns(system, state)
        return cls(chart, system, chart.rate(system), state, start, dt, step.stages, step.sweeps)

    def without_derivative(self) -> _Equation:
        system, state, start, dt = lax.stop_gradient((self.system, self.state, self.start, self.dt))
        rate = self.chart.rate(system)
        return dataclasses.replace(self, system=system, rate=rate, state=state, start=start, dt=dt)

    def at_stages(self, function: Callable[[Any, Any], Any], Y: Coordinates, nodes: np.ndarray) -> Any:
        """`function(z, t)` at all stages."""
        passed = self.dt * jnp.asarray(nodes, self.dt.dtype)
        return jax.vmap(function)(Y, self.chart.stage_times(self.system, self.state, passed))

    def weighted_sum(self, k: Any, weights: np.ndarray) -> Any:
        """Δt Σ w_j k_j, for one row of weights or for each row."""
        w = self.dt * jnp.asarray(weights, self.dt.dtype)
        return jax.tree.map(lambda x: jnp.tensordot(w, x, 1, precision="highest"), k)

    def stage_values(self, k: Coordinates) -> Coordinates:
        """The coordinates at the stages, z_n + Δt Σ a_ij k_j."""
        return jax.tree.map(
            lambda z, x: z[None] + x, self.start, self.weighted_sum(k, collocation.gauss(self.stages)[1])
        )

    def sweep(self, k: Coordinates) -> Coordinates:
        """f(z_n + Δt Σ a_ij k_j)."""
        return self.at_stages(self.rate, self.stage_values(k), collocation.gauss(self.stages)[0])

    def residual(self, k: Coordinates) -> Coordinates:
        return jax.tree.map(jnp.subtract, k, self.sweep(k))

    @property
    def _begins_with_few(self) -> bool:
        """Whether the first sweeps have few nodes."""
        return self.stages > _NODES and (self.sweeps is None or self.sweeps > 2 * _NODES)

    def guess(self) -> Coordinates:
        """The k_i after the sweeps with few nodes."""
        if not self._begins_with_few:
            return self._zeros()
        few = dataclasses.replace(self, stages=_NODES)
        k = lax.fori_loop(0, _NODES, lambda _, k: few.sweep(k), few._zeros())
        return jax.tree.map(lambda x: _interpolate_nodes(x, _NODES, self.stages), k)

    def improve(self, k: Coordinates) -> tuple[Coordinates, Array]:
        new = self.sweep(k)
        return new, self.change(new, k)

    def iterate(self, x: Coordinates, most: int, enough: float) -> tuple[Coordinates, Array]:
        if self.sweeps is None:
            return super().iterate(x, most, enough)
        left = self.sweeps - _NODES * self._begins_with_few - 1
        return self.improve(lax.fori_loop(0, max(0, left), lambda _, k: self.sweep(k), x))

    def _zeros(self) -> Coordinates:
        return jax.tree.map(lambda x: jnp.zeros((self.stages, *x.shape), x.dtype), self.start)

    def end(self, k: Coordinates) -> State:
        """The state at n + 1. π, a quadratic function of z, changes by Δt Σ b_i τ_i, without the rounding of p q̄."""
        c, _, b = collocation.gauss(self.stages)
        rates = self.at_stages(self.chart.quadratures(self.system, self.state), self.stage_values(k), c)
        return self.chart.apply(self.system, self.state, self.start, Increments(*self.weighted_sum((k, rates), b)))

    def change(self, a: Coordinates, b: Coordinates) -> Array:
        """The largest difference of Δt k_i, in units of q, which are 1 at least, and of the largest of p."""
        q, p = (jnp.max(jnp.abs(jnp.stack(half))) for half in self.chart.split_qp(self.start))
        halves = zip(self.chart.split_qp(a), self.chart.split_qp(b), strict=True)
        sizes = (jnp.maximum(1, q), jnp.where(p > 0, p, 1))
        changes = [
            jnp.max(jnp.abs(x - y)) / size
            for half, size in zip(halves, sizes, strict=True)
            for x, y in zip(*half, strict=True)
        ]
        return jnp.abs(self.dt) * functools.reduce(jnp.maximum, changes)


def _interpolate_nodes(k: Array, few: int, many: int) -> Array:
    """The values at many nodes of the polynomial through those at few."""
    weights = collocation.values(few, collocation.nodes(many)).astype(k.dtype)
    columns = (w.reshape(-1, *[1] * (k.ndim - 1)) * x for w, x in zip(weights.T, k, strict=True))
    return functools.reduce(jnp.add, columns)


@PROPERTIES.by_name
def examples(system: System) -> list[Step]:
    """Order 8, for all systems except elastic bodies: for stiff ones, sweeps do not reach round-off."""
    taken = canonical_chart(system) is not None and not isinstance(system, AbstractElasticBody)
    return [gauss(system, 4)] if taken else []


gauss = Gauss
