"""The energy-momentum schemes for a rigid body in an axisymmetric potential (Section 4.1).

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt γ × e                                     (4.3)
    Θ = κ(|Θ̄|²) Θ̄,         Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1})                                (4.4)
    e = κ ½(Λ_n + Λ_{n+1}) D̄,    D̄·(Γ_{n+1} − Γ_n) = Ṽ(Γ_{n+1}) − Ṽ(Γ_n)               (4.6), corrected

with Γ = Λᵀγ and D̄ any symmetric discrete gradient of Ṽ. With y = ½Θ̄, h = κy = ½Θ, a = ½ΔtΠ_n, and (4.4) multiplied by
1 + ĥ, what is to be solved for y is the free body's equation with a force:

    Jy + h × Jy − a = ¼Δt²κ [w − h (h·w)/(1 + |h|²)],    w = (Γ_n − h × Γ_n) × D̄
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import checks, newton, small
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes.so3_midpoint import gyration, gyration_matrix, on_branch
from lieint_jax.small import apply, cross, dot
from lieint_jax.types import State, Step, StepInfo, System, pytree, static

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_APART = 1e-4  # |ΔΓ|² from where on the quadrature of D̄ is corrected to give the difference of Ṽ


class Top(System, Protocol):
    """A rigid body in a potential Ṽ(Λᵀγ)."""

    @property
    def inertia(self) -> Array: ...
    @property
    def potential(self) -> Callable[[Array], Array]: ...
    @property
    def axis(self) -> Array: ...


@pytree
class TopEnergyMomentum(Step):
    """The step made by `top_energy_momentum`.

    Attributes:
        system: a rigid body in a potential with an axis.
        kappa: the scaling κ.
        iterations: Newton corrections a step.
    """

    system: Top
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"top_energy_momentum[{self.kappa.name}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt, q = checks.step_size(dt), state.q
        y, D, info = self._solve(state, dt)
        k = self.kappa(4 * dot(y, y))
        e = k * so3.Ad(q, _half_turn(k * y, D))
        return State(so3.cayley_increment(q, k * y), state.p + dt * jnp.stack(cross(self.system.axis, e))), info

    def _solve(self, state: State, dt: ArrayLike) -> tuple[Array, Array, StepInfo]:
        """y, the discrete gradient, and the report. J, a and s = ¼Δt² are divided by tr J: then |a| is an angle."""
        kappa, potential, J = self.kappa, self.system.potential, small.symmetric(self.system.inertia)
        r = 1 / small.trace(J)
        J, s = tuple(r * x for x in J), 0.25 * r * dt * dt
        a, Gamma = (0.5 * r * dt) * so3.Ad_star(state.q, state.p), so3.Ad_star(state.q, self.system.axis)

        def gradient(y: Array) -> Array:
            return discrete_gradient(potential, Gamma, _turned(kappa(4 * dot(y, y)) * y, Gamma))

        def residual(y: Array) -> Array:
            k = kappa(4 * dot(y, y))
            return gyration(kappa, J, y) - a - (s * k) * _force(k * y, Gamma, gradient(y))

        def correction(y: Array, f: Array) -> Array:
            return jnp.stack(small.solve(matrix(y), f))

        def matrix(y: Array) -> small.Matrix:
            """K less sκ²[(Γ·D̄)1 − Γ⊗D̄ + Γ^ S Γ^], S the slope of D̄: what the force adds, but for O(Δt³)."""
            k, D, K = kappa(4 * dot(y, y)), gradient(y), gyration_matrix(kappa, J, y)
            m, d = s * k * k, dot(Gamma, D)
            if not _is_linear(potential):  # S = 2∂D̄/∂Γ_{n+1}, up to O(ΔΓ²)
                S = small.symmetric(jax.hessian(potential)((Gamma + 2 * _turned(k * y, Gamma)) / 3))
                bend = [cross(Gamma, apply(S, cross(Gamma, e))) for e in np.eye(3)]
                K = [[K[i][j] - m * bend[j][i] for j in range(3)] for i in range(3)]
            return [[K[i][j] - m * ((d if i == j else 0) - Gamma[i] * D[j]) for j in range(3)] for i in range(3)]

        u = jnp.stack(small.solve_symmetric(J, a))
        at_rest = s * jnp.stack(cross(Gamma, discrete_gradient(potential, Gamma, Gamma)))
        guess = u + jnp.stack(small.solve_symmetric(J, jnp.stack(cross(a, u)) + at_rest))
        y, f = newton.root(residual, correction, guess, self.iterations, unroll=_is_linear(potential))
        D, at = gradient(y), lax.stop_gradient(y)
        size = lax.stop_gradient(small.max_abs(a) + s * _size(potential, Gamma, D, y))
        f = lax.stop_gradient(jnp.sqrt(dot(f, f)))
        converged = (f <= 32 * jnp.finfo(a.dtype).eps * size) & on_branch(kappa, at, matrix(at))
        return y, D, StepInfo(f, converged)

    def advice(self, state: State, dt: ArrayLike) -> str:
        branch = "ends where |Δt Ω| ≈ 1" if self.kappa.limit == 1 else "folds where |Δt Ω| is 2 to 4"
        return (
            f"{self.name} does not converge at dt = {dt}: the branch of this κ {branch}, or the potential is too stiff "
            f"for {self.iterations} iterations. Take a smaller dt, or more iterations"
        )


def top_energy_momentum(
    system: Top, kappa: Kappa | Callable[[Array], Array] = kappa_cayley, iterations: int | None = None
) -> TopEnergyMomentum:
    """The energy-momentum scheme (4.3), (4.4) with (4.6) corrected, for a rigid body in a potential with an axis.

    | conserved | to |
    |---|---|
    | energy | round-off, for any κ and any Ṽ (Result 7) |
    | γ·π | round-off (Result 6) |
    | the symplectic form | no: defect O(Δt³) a step, for any κ (Result 8); `splitting` keeps it |

    Second order, time-symmetric. D̄ is the potential's own `discrete_gradient` if it has one, else the average of the
    gradient between Γ_n and Γ_{n+1} by 4 Gauss nodes, corrected along ΔΓ where |ΔΓ| > .01.

    Args:
        system: `systems.heavy_top(...)` or `systems.potential_top(...)` with an axis.
        kappa: κ as of `so3_midpoint`.
        iterations: Newton corrections a step; by default 4 for a linear Ṽ and 6 for any other. A step that fell short
            says `converged=False`.

    Raises:
        ValueError: no potential or no axis, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 6–8, with the factor κ that (4.6) lacks; the discrete gradient: Gonzalez 1996,
    J. Nonlinear Sci. 6.
    """
    if not _is_top(system):
        raise ValueError(
            "top_energy_momentum integrates rigid bodies in a potential with an axis (systems.heavy_top, "
            f"systems.potential_top), got {type(system).__name__}"
            + (" without an axis; take splitting" if _is_top(system, axis=False) else "")
        )
    if iterations is None:
        iterations = 4 if _is_linear(system.potential) else 6
    return TopEnergyMomentum(system, as_kappa(kappa), checks.count("iterations", iterations, 1))


def discrete_gradient(potential: Callable[[Array], Array], a: Array, b: Array) -> Array:
    """D̄ with D̄·(b − a) = Ṽ(b) − Ṽ(a) and D̄(a, b) = D̄(b, a), shape (3,); the gradient where a = b."""
    own = getattr(potential, "discrete_gradient", None)
    if own is not None:
        return own(a, b)
    step = b - a
    at = (a + b) / 2 + jnp.asarray(_NODES, a.dtype)[:, None] * (step / 2)
    mean = jnp.tensordot(jnp.asarray(_WEIGHTS / 2, a.dtype), jax.vmap(jax.grad(potential))(at), 1)
    square = dot(step, step)
    apart = square > _APART
    missing = potential(b) - potential(a) - dot(mean, step)
    return mean + jnp.where(apart, missing / jnp.where(apart, square, 1), 0) * step


def _is_linear(potential: Callable[[Array], Array]) -> bool:
    return getattr(potential, "linear", False)


def _size(potential: Callable[[Array], Array], Gamma: Array, D: Array, y: Array) -> Array:
    """What the force's rounding errors are measured by: |D̄|, and |Ṽ|/|ΔΓ| where D̄ is corrected."""
    step = 2 * jnp.stack(cross(Gamma, y))
    square = dot(step, step)
    corrected = (square > _APART / 4) & (not hasattr(potential, "discrete_gradient"))
    noise = jnp.abs(potential(Gamma)) / jnp.sqrt(jnp.where(corrected, square, 1))
    return small.max_abs(Gamma) * (small.max_abs(D) + jnp.where(corrected, noise, 0))


def _turned(h: Array, Gamma: Array) -> Array:
    """Γ_{n+1} = cay(2h)ᵀΓ = Γ + 2(h × (h × Γ) − h × Γ)/(1 + |h|²)."""
    x = jnp.stack(cross(h, Gamma))
    return Gamma + (2 / (1 + dot(h, h))) * (jnp.stack(cross(h, x)) - x)


def _half_turn(h: Array, D: Array) -> Array:
    """½(1 + cay(2h))D = (D + h × D + h(h·D))/(1 + |h|²)."""
    return (1 / (1 + dot(h, h))) * (D + jnp.stack(cross(h, D)) + dot(h, D) * h)


def _force(h: Array, Gamma: Array, D: Array) -> Array:
    """w − h(h·w)/(1 + |h|²), with w = (Γ − h × Γ) × D̄ = Γ × D̄ + (Γ·D̄)h − (h·D̄)Γ."""
    w = jnp.stack(cross(Gamma, D)) + dot(Gamma, D) * h - dot(h, D) * Gamma
    return w - (dot(h, w) / (1 + dot(h, h))) * h


def examples(system: Any) -> dict[str, Step]:
    """The paper's three κ's, for rigid bodies in a potential with an axis."""
    if not _is_top(system):
        return {}
    return {step.name: step for step in (top_energy_momentum(system, kappa) for kappa in KAPPAS)}


def _is_top(system: Any, axis: bool = True) -> bool:
    """Whether it is a rigid body in a potential, with an axis; or, if not `axis`, whether it has all but that."""
    needed = ("inertia", "potential", "kinetic_energy", *(("axis",) if axis else ()))
    return all(getattr(system, name, None) is not None for name in needed)
