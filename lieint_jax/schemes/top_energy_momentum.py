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
from lieint_jax.maps import Kappa, as_kappa, kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.schemes.so3_midpoint import gyration, gyration_matrix, on_branch
from lieint_jax.small import Symmetric, apply, cross, dot
from lieint_jax.types import State, Step, StepInfo, System, pytree, static

_NODES, _WEIGHTS = (x.tolist() for x in np.polynomial.legendre.leggauss(4))
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

    def _solve(self, state: State, dt: Array) -> tuple[Array, Array, StepInfo]:
        """y, the discrete gradient, and the report. J, a and s = ¼Δt² are over tr J: then |a| is an angle."""
        kappa, potential, J = self.kappa, self.system.potential, small.symmetric(self.system.inertia)
        r = 1 / small.trace(J)
        J, s = tuple(r * x for x in J), 0.25 * r * dt * dt
        a, Gamma = (0.5 * r * dt) * so3.Ad_star(state.q, state.p), so3.Ad_star(state.q, self.system.axis)

        def gradient(y: Array) -> Array:
            h = kappa(4 * dot(y, y)) * y
            return discrete_gradient(potential, Gamma, Gamma + _turned(h, Gamma))

        def residual(y: Array) -> Array:
            k = kappa(4 * dot(y, y))
            return gyration(kappa, J, y) - a - (s * k) * _torque(k * y, Gamma, gradient(y))

        def correction(y: Array, f: Array) -> Array:
            return jnp.stack(small.solve(matrix(y), f))

        def matrix(y: Array) -> small.Matrix:
            """K less sκ²[(D̄·Γ)1 − Γ⊗D̄ + Γ^(∂D̄/∂Γ_{n+1})2Γ^], what the force adds but for O(Δt³)."""
            k, D = kappa(4 * dot(y, y)), gradient(y)
            K, S = gyration_matrix(kappa, J, y), _slope(potential, Gamma + (2 / 3) * _turned(k * y, Gamma))
            columns = [cross(Gamma, apply(S, cross(Gamma, e))) for e in np.eye(3)]
            m, d = s * k * k, dot(D, Gamma)
            return [
                [K[i][j] - m * ((d if i == j else 0) - Gamma[i] * D[j] + columns[j][i]) for j in range(3)]
                for i in range(3)
            ]

        u = jnp.stack(small.solve_symmetric(J, a))
        force = s * jnp.stack(cross(Gamma, discrete_gradient(potential, Gamma, Gamma)))
        guess = u + jnp.stack(small.solve_symmetric(J, jnp.stack(cross(a, u)) + force))
        y, f = newton.root(residual, correction, guess, self.iterations)
        at = lax.stop_gradient(y)
        size = lax.stop_gradient(small.max_abs(a) + s * _size(potential, Gamma, gradient(y), y))
        f = lax.stop_gradient(jnp.sqrt(dot(f, f)))
        converged = (f <= 32 * jnp.finfo(a.dtype).eps * size) & on_branch(kappa, at, matrix(at))
        return y, gradient(y), StepInfo(f, converged)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} does not converge at dt = {dt}: the branch of this κ ends where the body turns by "
            f"{'90°' if self.kappa.limit == 1 else 'more than 120°'} a step, or the potential is too stiff for it. "
            f"Take a smaller dt, or more iterations than {self.iterations}"
        )


def top_energy_momentum(
    system: Top, kappa: Kappa | Callable[[Array], Array] = kappa_cayley, iterations: int = 5
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
        iterations: Newton corrections a step; 5 reach round-off for |Δt Ω| ≤ .8. A step that fell short says
            `converged=False`.

    Raises:
        ValueError: no potential or no axis, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 6–8, with the factor κ that (4.6) lacks; the discrete gradient: Gonzalez 1996,
    J. Nonlinear Sci. 6.
    """
    if getattr(system, "potential", None) is None or getattr(system, "axis", None) is None:
        raise ValueError(
            "top_energy_momentum integrates rigid bodies in a potential with an axis (systems.heavy_top, "
            f"systems.potential_top), got {type(system).__name__}"
            + (" without an axis; take splitting" if getattr(system, "potential", None) is not None else "")
        )
    return TopEnergyMomentum(system, as_kappa(kappa), checks.count("iterations", iterations, 1))


def discrete_gradient(potential: Callable[[Array], Array], a: Array, b: Array) -> Array:
    """D̄ with D̄·(b − a) = Ṽ(b) − Ṽ(a) and D̄(a, b) = D̄(b, a), shape (3,); the gradient where a = b."""
    own = getattr(potential, "discrete_gradient", None)
    if own is not None:
        return own(a, b)
    step = b - a
    nodes = [jax.grad(potential)((a + b) / 2 + (x / 2) * step) for x in _NODES]
    mean = sum(w / 2 * g for w, g in zip(_WEIGHTS, nodes, strict=True)) + jnp.zeros_like(a)
    square = dot(step, step)
    apart = square > _APART
    missing = potential(b) - potential(a) - dot(mean, step)
    return mean + jnp.where(apart, missing / jnp.where(apart, square, 1), 0) * step


def _slope(potential: Callable[[Array], Array], Gamma: Array) -> Symmetric:
    """∂D̄/∂Γ_{n+1}, twice: the second derivative of Ṽ two thirds of the way, up to O(ΔΓ²)."""
    return small.symmetric(jax.hessian(potential)(Gamma))


def _size(potential: Callable[[Array], Array], Gamma: Array, D: Array, y: Array) -> Array:
    """What the force's rounding errors are measured by: |D̄|, and |Ṽ|/|ΔΓ| where D̄ is corrected."""
    step = 2 * jnp.stack(cross(Gamma, y))
    square = dot(step, step)
    corrected = (square > _APART / 4) & (not hasattr(potential, "discrete_gradient"))
    noise = jnp.abs(potential(Gamma)) / jnp.sqrt(jnp.where(corrected, square, 1))
    return small.max_abs(Gamma) * (small.max_abs(D) + jnp.where(corrected, noise, 0))


def _turned(h: Array, Gamma: Array) -> Array:
    """ΔΓ = (cay(2h)ᵀ − 1)Γ = 2(h × (h × Γ) − h × Γ)/(1 + |h|²)."""
    x = cross(h, Gamma)
    xx = cross(h, x)
    r = 2 / (1 + dot(h, h))
    return jnp.stack([r * (xx[i] - x[i]) for i in range(3)])


def _half_turn(h: Array, D: Array) -> Array:
    """½(1 + cay(2h))D = (D + h × D + h(h·D))/(1 + |h|²)."""
    x, g, r = cross(h, D), dot(h, D), 1 / (1 + dot(h, h))
    return jnp.stack([r * (D[i] + x[i] + g * h[i]) for i in range(3)])


def _torque(h: Array, Gamma: Array, D: Array) -> Array:
    """w − h(h·w)/(1 + |h|²) with w = (Γ − h × Γ) × D̄."""
    x = cross(h, Gamma)
    w = cross(tuple(Gamma[i] - x[i] for i in range(3)), D)
    g = dot(h, w) / (1 + dot(h, h))
    return jnp.stack([w[i] - g * h[i] for i in range(3)])


def examples(system: Any) -> dict[str, Step]:
    """The paper's three κ's, for rigid bodies in a potential with an axis."""
    if getattr(system, "potential", None) is None or getattr(system, "axis", None) is None:
        return {}
    kappas = (kappa_cayley, kappa_exponential, kappa_symplectic)
    return {step.name: step for step in (top_energy_momentum(system, kappa) for kappa in kappas)}
