"""Gauss collocation: symplectic, of any even order, in canonical coordinates of a flat space.

    Z_i = z_n + Δt Σ_j a_ij k_j,    k_i = f(Z_i),    z_{n+1} = z_n + Δt Σ b_i k_i

It keeps quadratic invariants: on T*SO(3), with the quaternion q and p = 2πq as unknowns (see `_canonical`), the length
|q|, q·p and the momentum π, as far as the potential leaves it. So the step is one on T*SO(3), and symplectic there. The
equations are solved by fixed-point iteration on the k_i, all at once: a sweep.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import collocation, kernel
from lieint_jax.schemes._canonical import Components, canonical, configurations, field, force, known, power
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

_MOST = 100  # sweeps
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
    def one_kernel(self) -> bool:
        return True

    @property
    def name(self) -> str:
        return f"gauss[{self.stages}]" if self.sweeps is None else f"gauss[{self.stages}, {self.sweeps} sweeps]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        equation = _Equation(self.system, state, canonical(state), jnp.asarray(dt, state.p.dtype), self.stages)
        k, change = _solved(equation, self.sweeps)
        end = equation.end(k)
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
    """The equations of one step, for the derivatives k of the coordinates at the stages: of each (s, …)."""

    system: System
    state: State
    start: Components
    dt: Array
    stages: int

    def field(self, Z: Components, nodes: np.ndarray) -> Components:
        return field(self.system, Z, self.times(nodes))

    def times(self, nodes: np.ndarray) -> Array | None:
        return None if self.state.t is None else self.state.t + self.dt * jnp.asarray(nodes, self.dt.dtype)

    def moved(self, k: Components, weights: np.ndarray) -> Components:
        """z + Δt Σ w_j k_j, of every row of weights."""
        return _summed(self.start, k, self.dt, weights)

    def swept(self, k: Components) -> Components:
        """f(Z) at Z_i = z_n + Δt Σ a_ij k_j."""
        c, A, _ = collocation.gauss(self.stages)
        return self.field(self.moved(k, A), c)

    def residual(self, k: Components) -> Components:
        return jax.tree.map(jnp.subtract, k, self.swept(k))

    def guess(self, fewest: int) -> Components:
        """Derivatives at the stages: those at the start, swept up at ever more nodes."""
        k, weights = self.field(self.start, np.zeros(1)), collocation.nodes(fewest)[:, None]
        for s in range(fewest, self.stages):
            k = self.field(self.moved(k, weights), collocation.nodes(s))
            weights = collocation.integrals(s, collocation.nodes(s + 1))
        return self.field(self.moved(k, weights), collocation.nodes(self.stages))

    def end(self, k: Components) -> State:
        """The state at n + 1. π moves by Δt Σ b_i τ_i, as any quadratic function of z does, without rounding p q̄."""
        c, A, b = collocation.gauss(self.stages)
        state, weights, t = self.state, b[None], self.times(c)
        Z = self.moved(k, A)
        q = configurations(self.moved(k, weights))[0]
        forces = force(self.system, Z, t)
        p = state.p + jnp.stack(_summed((0.0,) * len(forces), forces, self.dt, weights), axis=-1)[0]
        if isinstance(self.system, Driven) and state.work is not None and t is not None:
            [work] = _summed((state.work[None],), (power(self.system, Z, t),), self.dt, weights)
            return state._replace(q=q, p=p, work=work[0])
        return state._replace(q=q, p=p)

    def change(self, a: Components, b: Components) -> Array:
        """The largest difference of Δt k, in units of q, which are 1 at least, and of the largest of p."""
        half = len(a) // 2
        q, p = (jnp.max(jnp.abs(jnp.stack(self.start[part]))) for part in (slice(half), slice(half, None)))
        sizes = [jnp.maximum(1, q)] * half + [jnp.where(p > 0, p, 1)] * half
        moved = [jnp.max(jnp.abs(x - y)) / size for x, y, size in zip(a, b, sizes, strict=True)]
        return jnp.abs(self.dt) * functools.reduce(jnp.maximum, moved)


def _summed(z: Any, k: Components, dt: Array, weights: np.ndarray) -> Components:
    """z + Δt Σ w_j k_j."""

    @kernel.stage
    def sums(z: Any, k: Components, dt: Array) -> Components:
        columns = [w.reshape(-1, *[1] * (k[0].ndim - 1)) for w in weights.astype(dt.dtype).T]
        return tuple(
            x + dt * functools.reduce(jnp.add, [w * y[j : j + 1] for j, w in enumerate(columns)])
            for x, y in zip(z, k, strict=True)
        )

    return sums(z, k, dt)


def _solved(equation: _Equation, sweeps: int | None) -> tuple[Components, Array]:
    """The derivatives at the stages, and the last relative change of a sweep."""
    fewest = 1 if sweeps is None else max(1, equation.stages + 1 - sweeps)
    guess = equation.guess(fewest)
    eps = float(jnp.finfo(equation.dt.dtype).eps)

    def solve(_: Callable[[Components], Components], start: Components) -> tuple[Components, Array]:
        def improved(carry: tuple[Components, Array, Array, Array]) -> tuple[Components, Array, Array, Array]:
            k, change, _, n = carry
            new = equation.swept(k)
            return new, equation.change(new, k), change, n + 1

        def goes_on(carry: tuple[Components, Array, Array, Array]) -> Array:
            _, change, before, n = carry
            falls = (change > _STALLED * eps) | (change < before)
            return (n < _MOST) & (change > 2 * eps) & falls

        far = jnp.full_like(equation.dt, jnp.finfo(equation.dt.dtype).max)
        begin = (start, far / 2, far, jnp.zeros((), int))
        if sweeps is None:
            return lax.while_loop(goes_on, improved, begin)[:2]
        more = max(1, sweeps - equation.stages)
        return lax.fori_loop(0, more, lambda _, carry: improved(carry), begin)[:2]

    def tangent_solve(linear: Callable[[Components], Components], b: Components) -> Components:
        flat, components = ravel_pytree(b)  # one array: parts of b may depend on nothing that is differentiated

        def refined(matvec: Callable[[Array], Array], b: Array) -> Array:
            return lax.fori_loop(0, _REFINEMENTS, lambda _, v: v + b - matvec(v), b)

        x = lax.custom_linear_solve(lambda v: ravel_pytree(linear(components(v)))[0], flat, refined, refined)
        return components(x)

    k, change = lax.custom_root(equation.residual, guess, solve, tangent_solve, has_aux=True)
    return k, lax.stop_gradient(change)


def examples(system: Any) -> dict[str, Step]:
    """Order 8, for the systems that it takes."""
    if not (isinstance(system, _KINDS) and known(system.phase_space)):
        return {}
    return {"gauss[4]": gauss(system, 4)}
