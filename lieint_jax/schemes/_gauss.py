"""Gauss collocation: symplectic, of any even order, in canonical coordinates of a flat space.

    Y_i = z_n + Δt Σ_j a_ij k_j,    k_i = f(Y_i),    z_{n+1} = z_n + Δt Σ b_i k_i

It keeps quadratic invariants: on T*SO(3), with the quaternion q and p = 2πq as unknowns (see `_canonical`), the length
|q|, q·p and the momentum π, as far as the potential leaves it. So the step is one on T*SO(3), and symplectic there. The
equations are solved by fixed-point iteration on the k_i, all at once: a sweep.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import collocation
from lieint_jax._xla import saved
from lieint_jax.schemes._shared.accepts import check_motion, hint
from lieint_jax.schemes._shared.properties import SchemeProperties
from lieint_jax.schemes.charts.canonical import (
    Components,
    canonical,
    ended,
    field,
    force,
    inverses,
    motion,
    power,
    supports,
)
from lieint_jax.types import (
    AbstractDrivenSystem,
    AbstractElasticBody,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractGyrostat,
    State,
    Step,
    StepInfo,
    System,
    pytree,
    static,
)

_MOST = 100  # sweeps
_NODES = 4  # of the guess of a step with more, and its sweeps: each gains an order
_STALLED = 2**16  # eps: a change below it that no longer falls is rounding
_CONVERGED = 32  # eps: the largest last change of a step that converged
_REFINEMENTS = 60  # sweeps of the linear equations for derivatives
_KINDS = (
    AbstractFreeBody,
    AbstractForcedSystem,
    AbstractDrivenSystem,
    AbstractGyrostat,
    AbstractFreeBodies,
    AbstractElasticBody,
)
_NOUN = "free bodies, gyrostats, tops, several bodies and pseudo-rigid bodies"


@pytree
class Gauss(Step):
    """The step made by `gauss`.

    Attributes:
        system: a Hamiltonian system on T*SO(3), of several bodies, or on T*GL⁺(3).
        stages: s.
        sweeps: their number, or None for as many as it takes.
    """

    system: System
    stages: int = static()
    sweeps: int | None = static()
    order: float = static()
    symmetric: bool = static(default=True)

    @property
    def approximate(self) -> bool:
        return self.sweeps is not None

    @property
    def name(self) -> str:
        return f"gauss[{self.stages}]" if self.sweeps is None else f"gauss[{self.stages}, {self.sweeps} sweeps]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt = jnp.asarray(dt, state.p.dtype)
        equation = _Equation.from_state(self, state, dt)
        k, change = _solved(equation, self.sweeps)
        end, change = equation.end(k), lax.stop_gradient(change)
        return end, StepInfo(change, change <= _CONVERGED * float(jnp.finfo(change.dtype).eps))

    def advice(self, state: State, dt: ArrayLike) -> str:
        limit = "its sweeps diverge" if self.sweeps is None else f"{self.sweeps} sweeps are too few"
        return (
            f"{self.name} does not converge at dt = {dt}: {limit}. Take a smaller dt: the fastest frequency of the "
            "motion times dt should be at most 1"
        )


def gauss(system: System, stages: int = 8, sweeps: int | None = None) -> Gauss:
    """Gauss–Legendre collocation of order 2s, in canonical coordinates.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off, once the sweeps have converged |
    | momentum, whole or γ·π | round-off |
    | energy | O(Δt²ˢ), bounded, no drift: below round-off at useful steps |

    Time-symmetric. The step of choice where accuracy counts: 8 stages at |Δt Ω| = ½ err by less than 1e-10. A sweep
    evaluates the vector field at all stages; some 12 to 20 are needed.

    Args:
        system: a free body, a gyrostat, a top, driven or not, several bodies, a pseudo-rigid body.
        stages: s ≥ 1.
        sweeps: a number of sweeps in place of as many as it takes; with too few the form and momentum are kept to their
            residual only, which the step reports, and `converged` is false above round-off.

    Raises:
        ValueError: another system, or one that moves otherwise; stages or sweeps that are no positive int.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, II.1.3, VI.4; Antoñana, Makazaga & Murua 2017,
    Numer. Algorithms 76.
    """
    if not (isinstance(system, _KINDS) and supports(system.phase_space)):
        raise ValueError(f"gauss integrates {_NOUN}, got {type(system).__name__}{hint('gauss', system)}")
    check_motion("gauss", _NOUN, motion, system, system)
    s = _checks.count("stages", stages, 1)
    return Gauss(system, s, None if sweeps is None else _checks.count("sweeps", sweeps, 1), 2.0 * s)


class _Equation(NamedTuple):
    """The equations of one step, for the derivatives k of the coordinates at the stages."""

    system: System
    inverse: Components | None
    state: State
    start: Components
    dt: Array
    stages: int

    @classmethod
    def from_state(cls, step: Gauss, state: State, dt: Array) -> _Equation:
        return cls(step.system, inverses(step.system), state, canonical(step.system, state), dt, step.stages)

    def without_derivative(self) -> _Equation:
        still = lax.stop_gradient((self.system, self.inverse, self.state, self.start, self.dt))
        return _Equation(*still, self.stages)

    def at_stages(self, function: Callable[..., Components], Y: Components, nodes: np.ndarray) -> Components:
        """`function(system, inverse, z, t)` of one stage, at all."""
        t = self.state.t
        times = None if t is None else t + self.dt * jnp.asarray(nodes, self.dt.dtype)
        return jax.vmap(function, (None, None, 0, 0))(self.system, self.inverse, Y, times)

    def over(self, k: Components, weights: np.ndarray) -> Components:
        """Δt Σ w_j k_j, of one row of weights or of each."""
        w = self.dt * jnp.asarray(weights, self.dt.dtype)
        return tuple(jnp.tensordot(w, x, 1, precision="highest") for x in k)

    def stage_values(self, k: Components) -> Components:
        """The coordinates at the stages, z_n + Δt Σ a_ij k_j."""
        return tuple(map(jnp.add, self.start, self.over(k, collocation.gauss(self.stages)[1])))

    def swept(self, k: Components) -> Components:
        """f(z_n + Δt Σ a_ij k_j)."""
        return self.at_stages(field, self.stage_values(k), collocation.gauss(self.stages)[0])

    def residual(self, k: Components) -> Components:
        return jax.tree.map(jnp.subtract, k, self.swept(k))

    def guess(self, most: int) -> tuple[Components, int]:
        """The k_i after at most so many sweeps, at few nodes, and the number of those sweeps."""
        if self.stages <= _NODES or most <= 2 * _NODES:
            return self._zeros(), 0
        few = self._replace(stages=_NODES)
        k = lax.fori_loop(0, _NODES, lambda _, k: few.swept(k), few._zeros())
        return tuple(_between(x, _NODES, self.stages) for x in k), _NODES

    def _zeros(self) -> Components:
        return tuple(jnp.zeros((self.stages, *x.shape), x.dtype) for x in self.start)

    def end(self, k: Components) -> State:
        """The state at n + 1. π moves by Δt Σ b_i τ_i, as any quadratic function of z does, without rounding p q̄."""
        c, _, b = collocation.gauss(self.stages)
        Y, state = self.stage_values(k), self.state
        moves, work = self.over(k, b), None
        impulse = (
            moves[9:] if isinstance(self.system, AbstractElasticBody) else self.over(self.at_stages(force, Y, c), b)
        )
        if isinstance(self.system, AbstractDrivenSystem) and state.work is not None and state.t is not None:
            [work] = self.over(self.at_stages(power, Y, c), b)
        return ended(self.system, state, moves, impulse, work)

    def change(self, a: Components, b: Components) -> Array:
        """The largest difference of Δt k_i, in units of q, which are 1 at least, and of the largest of p."""
        half = len(a) // 2
        q, p = (jnp.max(jnp.abs(jnp.stack(self.start[part]))) for part in (slice(half), slice(half, None)))
        sizes = [jnp.maximum(1, q)] * half + [jnp.where(p > 0, p, 1)] * half
        moved = [jnp.max(jnp.abs(x - y)) / size for x, y, size in zip(a, b, sizes, strict=True)]
        return jnp.abs(self.dt) * functools.reduce(jnp.maximum, moved)


def _between(k: Array, few: int, many: int) -> Array:
    """The values at many nodes of the polynomial through those at few."""
    weights = collocation.values(few, collocation.nodes(many)).astype(k.dtype)
    columns = (w.reshape(-1, *[1] * (k.ndim - 1)) * x for w, x in zip(weights.T, k, strict=True))
    return functools.reduce(jnp.add, columns)


def _solved(equation: _Equation, sweeps: int | None) -> tuple[Components, Array]:
    """The k_i, and their last change."""
    guess, taken = equation.without_derivative().guess(_MOST if sweeps is None else sweeps)

    def solve(_: Callable[[Components], Components], k: Components) -> tuple[Components, Array]:
        if sweeps is None:
            k, change = _iterated(equation, k)
            return saved(k), change
        last = lax.fori_loop(0, max(0, sweeps - taken - 1), lambda _, k: equation.swept(k), k)
        k = saved(equation.swept(last))
        return k, equation.change(k, last)

    def tangent_solve(linear: Callable[[Components], Components], b: Components) -> Components:
        flat, components = ravel_pytree(b)  # one array: parts of b may depend on nothing that is differentiated

        def refined(matvec: Callable[[Array], Array], b: Array) -> Array:
            return lax.fori_loop(0, _REFINEMENTS, lambda _, v: v + b - matvec(v), b)

        x = lax.custom_linear_solve(lambda v: ravel_pytree(linear(components(v)))[0], flat, refined, refined)
        return components(x)

    return lax.custom_root(equation.residual, guess, solve, tangent_solve, has_aux=True)


_Carry = tuple[Components, Array, Array, Array]  # k, its last change, the one before, the number of sweeps


def _iterated(equation: _Equation, k: Components) -> tuple[Components, Array]:
    """Sweeps until they change nothing."""
    eps = float(jnp.finfo(equation.dt.dtype).eps)

    def goes_on(carry: _Carry) -> Array:
        _, change, before, n = carry
        falls = (change > _STALLED * eps) | (change < before)
        return (n < _MOST) & (change > 4 * eps) & falls

    def improved(carry: _Carry) -> _Carry:
        k, change, _, n = carry
        new = equation.swept(k)
        return new, equation.change(new, k), change, n + 1

    far = jnp.full((), jnp.finfo(equation.dt.dtype).max, equation.dt.dtype)
    begin = (k, far / 2, far, jnp.zeros((), int))
    return lax.while_loop(goes_on, improved, begin)[:2]


PROPERTIES = SchemeProperties(
    name="gauss",
    systems="free and elastic bodies, gyrostats, tops, satellites, several bodies",
    conserves=("momentum", "form"),
    order=16,
    symmetric=True,
    limit="about one radian of the fastest motion",
    aliases=("Gauss–Legendre collocation",),
    source="Hairer, Lubich & Wanner 2006, II.1.3, VI.4",
)


def examples(system: System) -> dict[str, Step]:
    """Order 8, for the systems that it takes but elastic bodies: sweeps do not reach round-off on stiff ones."""
    if not (isinstance(system, _KINDS) and supports(system.phase_space)) or isinstance(system, AbstractElasticBody):
        return {}
    return {"gauss[4]": gauss(system, 4)}
