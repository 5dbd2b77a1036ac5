"""Gauss collocation: symplectic, of any even order, in canonical coordinates of a flat space.

    Z_i = z_n + Δt Σ_j a_ij k_j,    k_i = f(Z_i),    z_{n+1} = z_n + Δt Σ b_i k_i

It keeps quadratic invariants: on T*SO(3), with the quaternion q and p = 2πq as unknowns (see `_canonical`), the length
|q|, q·p and the momentum π, as far as the potential leaves it. So the step is one on T*SO(3), and symplectic there. The
equations are solved by fixed-point iteration on the k_i, all at once: a sweep.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import collocation
from lieint_jax.schemes._canonical import canonical, canonical_rate, known, rate, unit_configuration
from lieint_jax.schemes._capability import hint
from lieint_jax.types import (
    Driven,
    Forced,
    FreeBodies,
    FreeBody,
    Gyrostat,
    State,
    Step,
    StepInfo,
    System,
    all_finite,
    pytree,
    static,
)

_LEAST, _MOST = 6, 100  # sweeps
_STALLED = 2**16  # eps: a change below it that no longer falls is rounding
_CONVERGED = 32  # eps: the largest last change of a step that converged
_REFINEMENTS = 60  # sweeps of the linear equations for derivatives
_KINDS = (FreeBody, Forced, Driven, Gyrostat, FreeBodies)


@pytree
class Gauss(Step):
    """The step made by `gauss`.

    Attributes:
        system: a Hamiltonian system on T*SO(3), or of several bodies.
        stages: s.
        sweeps: their number, or None for as many as it takes.
    """

    system: System
    stages: int = static()
    sweeps: int | None = static()
    order: float = static()
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"gauss[{self.stages}]" if self.sweeps is None else f"gauss[{self.stages}, {self.sweeps} sweeps]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        start = canonical(self.system.phase_space, state)
        equation = _Equation(self.system, start, jnp.asarray(dt, state.p.dtype), self.stages)
        k, change = _solved(equation, self.sweeps)
        end = equation.end(state, k)
        return end, StepInfo(change, all_finite(end) & (change <= _CONVERGED * float(jnp.finfo(change.dtype).eps)))

    def advice(self, state: State, dt: ArrayLike) -> str:
        limit = "its sweeps diverge" if self.sweeps is None else f"{self.sweeps} sweeps are too few"
        return f"{self.name} does not converge at dt = {dt}: {limit}. Take a smaller dt, such that |Δt Ω| ≤ 1"


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
        system: a free body, a gyrostat, a top, driven or not, several bodies.
        stages: s ≥ 1.
        sweeps: a number of sweeps in place of as many as it takes; with too few the form and momentum are kept to their
            residual only, which the step reports, and `converged` is false above round-off.

    Raises:
        ValueError: another system; stages or sweeps that are no positive int.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, II.1.3, VI.4; Antoñana, Makazaga & Murua 2017,
    Numer. Algorithms 76.
    """
    if not (isinstance(system, _KINDS) and known(system.phase_space)):
        raise ValueError(
            "gauss integrates free bodies, gyrostats, tops and several bodies, got "
            f"{type(system).__name__}{hint('gauss', system)}"
        )
    s = _checks.count("stages", stages, 1)
    return Gauss(system, s, None if sweeps is None else _checks.count("sweeps", sweeps, 1), 2.0 * s)


class _Equation(NamedTuple):
    """The equations of one step, for the derivatives k at the stages: a State whose leaves have a stage axis."""

    system: System
    start: State
    dt: Array
    stages: int

    def at_stages(self, k: State) -> State:
        """Z_i = z_n + Δt Σ a_ij k_j."""
        return self.moved(self.start, k, collocation.gauss(self.stages)[1])

    def moved(self, z: State, k: State, weights: np.ndarray) -> State:
        """z + Δt Σ w_j k_j, of every row of weights."""
        return jax.tree.map(lambda z, x: z + self.dt * jnp.tensordot(jnp.asarray(weights, z.dtype), x, 1), z, k)

    def residual(self, k: State) -> State:
        """k − f(Z)."""
        rates = jax.vmap(lambda z: canonical_rate(self.system, z))(self.at_stages(k))
        return jax.tree.map(jnp.subtract, k, rates)

    def guess(self) -> State:
        """The derivative at the start, at all stages."""
        rate = canonical_rate(self.system, self.start)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (self.stages, *x.shape)), rate)

    def end(self, state: State, k: State) -> State:
        """The state at n + 1. π moves by Δt Σ b_i τ_i, as any quadratic function of z does, without rounding p q̄."""
        torques = jax.vmap(lambda z: rate(self.system, z).p)(self.at_stages(k))
        end = self.moved(state, k._replace(p=torques), collocation.gauss(self.stages)[2])
        return end._replace(q=unit_configuration(self.system.phase_space, end.q))

    def change(self, a: State, b: State) -> Array:
        """The largest difference of Δt k, in units of q, which are 1 at least, and of the largest of p."""
        q, p = jnp.maximum(1, jnp.max(jnp.abs(self.start.q))), jnp.max(jnp.abs(self.start.p))
        sizes = (q, jnp.where(p > 0, p, 1))
        moved = (jnp.max(jnp.abs(self.dt * (x - y))) for x, y in ((a.q, b.q), (a.p, b.p)))
        return jnp.max(jnp.stack([x / size for x, size in zip(moved, sizes, strict=True)]))


def _solved(equation: _Equation, sweeps: int | None) -> tuple[State, Array]:
    """The derivatives at the stages, and the last relative change of a sweep."""
    guess = equation.guess()
    eps = float(jnp.finfo(equation.dt.dtype).eps)

    def solve(residual: Callable[[State], State], start: State) -> tuple[State, Array]:
        def improved(carry: tuple[State, Array, Array, Array]) -> tuple[State, Array, Array, Array]:
            k, change, _, n = carry
            new = jax.tree.map(jnp.subtract, k, residual(k))
            return new, equation.change(new, k), change, n + 1

        def goes_on(carry: tuple[State, Array, Array, Array]) -> Array:
            _, change, before, n = carry
            falls = (n < _LEAST) | (change > _STALLED * eps) | (change < before)
            return (n < _MOST) & (change > 2 * eps) & falls

        far = jnp.full_like(equation.dt, jnp.finfo(equation.dt.dtype).max)
        begin = (start, far / 2, far, jnp.zeros((), int))
        if sweeps is None:
            return lax.while_loop(goes_on, improved, begin)[:2]
        return lax.fori_loop(0, sweeps, lambda _, carry: improved(carry), begin)[:2]

    def tangent_solve(linear: Callable[[State], State], b: State) -> State:
        def refined(matvec: Callable[[State], State], b: State) -> State:
            def one(_: int, v: State) -> State:
                return jax.tree.map(lambda v, b, w: v + b - w, v, b, matvec(v))

            return lax.fori_loop(0, _REFINEMENTS, one, b)

        return lax.custom_linear_solve(linear, b, refined, refined)

    k, change = lax.custom_root(equation.residual, guess, solve, tangent_solve, has_aux=True)
    return k, lax.stop_gradient(change)


def examples(system: Any) -> dict[str, Step]:
    """Order 8, for the systems that it takes."""
    if not (isinstance(system, _KINDS) and known(system.phase_space)):
        return {}
    return {"gauss[4]": gauss(system, 4)}
