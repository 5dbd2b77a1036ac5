"""The energy-momentum schemes for a rigid body in an axisymmetric potential (Section 4.1).

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt γ × e                                     (4.3)
    Θ = κ(|Θ̄|²) Θ̄,         Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1})                                (4.4)
    e = κ ½(Λ_n + Λ_{n+1}) D̄,    D̄·(Γ_{n+1} − Γ_n) = Ṽ(Γ_{n+1}) − Ṽ(Γ_n)               (4.6), corrected

with Γ = Λᵀγ and D̄ any symmetric discrete gradient of Ṽ. With y = ½Θ̄, h = κy = ½Θ, a = ½ΔtΠ_n, s = ¼Δt², and (4.4)
multiplied by 1 + ĥ, what is to be solved for y is the free body's equation with a moment w, here times 1 + |h|²:

    (1 + |h|²)(Jy + h × Jy − a − w) + (h·w) h = 0,    w = sκ (Γ_n − h × Γ_n) × D̄
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
from lieint_jax._numerics import newton, three
from lieint_jax._numerics.three import Symmetric, Vector, add, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._capability import Integrand
from lieint_jax.schemes.so3_midpoint import FREE_BODIES, gyration, gyration_matrix, on_branch
from lieint_jax.types import State, Step, StepInfo, Top, pytree, static

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_APART = 1e-4  # |ΔΓ|² from where on the quadrature of D̄ is corrected to give the difference of Ṽ


def _motion(top: Top, state: State) -> State:
    """(q̇, π̇) = (½ q Ω, γ × Λ∇Ṽ(Γ)) (4.2)."""
    gradient = jax.grad(top.potential)(so3.Ad_star(state.q, top.axis))
    turning = FREE_BODIES.vector_field(top, state)
    return State(turning.q, jnp.stack(cross(top.axis, so3.Ad(state.q, gradient))))


TOPS = Integrand(Top, "rigid bodies in a potential with an axis (systems.heavy_top, systems.potential_top)", _motion)


@pytree
class TopEnergyMomentum(Step):
    """The step made by `top_energy_momentum`.

    Attributes:
        system: a rigid body in a potential with an axis.
        kappa: the scaling κ.
        iterations: Newton corrections per step.
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
        q = state.q
        y, D, info = self._solve(state, dt)
        k = self.kappa(4 * dot(y, y))
        h = scale(k, y)
        e = so3.Ad(q, scale(k, _half_turn(h, D)))
        p = add(state.p, scale(dt, cross(self.system.axis, e)))
        q = [x + d for x, d in zip(q, so3.cayley_difference(q, h), strict=True)]
        # stacked last: many kernels read them, number by number
        return state._replace(q=jnp.stack(q), p=jnp.stack(p)), info

    def _solve(self, state: State, dt: ArrayLike) -> tuple[Vector, Vector, StepInfo]:
        """y, the discrete gradient, and the report."""
        equation, linear = _Equation.of(self, state, dt), _is_linear(self.system.potential)
        guess, count = equation.guess(), self.iterations
        y, f, steady = newton.root(equation.residual, equation.correction, guess, count, unroll=linear)
        good = three.well_conditioned(equation.J) & steady
        D, at = equation.gradient(equation.turn(y)[1]), lax.stop_gradient(y)
        f = lax.stop_gradient(jnp.sqrt(dot(f, f)))
        good &= on_branch(self.kappa, at, equation.matrix(at))
        small_enough = f <= 32 * jnp.finfo(f.dtype).eps * lax.stop_gradient(equation.size(D, y))
        return y, D, StepInfo(f, small_enough & good)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} does not converge at dt = {dt}: the branch of this κ {self.kappa.branch}, or the potential "
            f"is too stiff. Take a smaller dt, or more than {self.iterations} iterations if |Δt Ω| < 1"
        )


def top_energy_momentum(
    system: Top, kappa: Kappa | Callable[[Array], Array] = kappa_cayley, iterations: int | None = None
) -> TopEnergyMomentum:
    """The energy-momentum scheme (4.3), (4.4) with (4.6) corrected, for a rigid body in a potential with an axis.

    | conserved | to |
    |---|---|
    | energy | round-off, for any κ and any Ṽ (Result 7) |
    | γ·π | round-off (Result 6) |
    | the symplectic form | no: defect O(Δt³) per step, for any κ (Result 8); `splitting` keeps it |

    Second order, time-symmetric. D̄ is the potential's own `discrete_gradient` if it has one, else the average of the
    gradient between Γ_n and Γ_{n+1} by 4 Gauss nodes, corrected along ΔΓ where |ΔΓ| > .01.

    Args:
        system: `systems.heavy_top(...)` or `systems.potential_top(...)` with an axis.
        kappa: κ as of `so3_midpoint`.
        iterations: Newton corrections per step; by default 3 for a linear Ṽ and κ = 1, 5 for a linear Ṽ and any other
            κ, 6 for any other Ṽ. With κ = 1, J = (1, 2, 2.5) and Δt²|E| = .008, 3 reach round-off for |Δt Ω| ≤ .3, 4
            for ≤ .8. A step that fell short says `converged=False`.

    Raises:
        ValueError: no potential or no axis, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 6–8, with the factor κ that (4.6) lacks; the discrete gradient: Gonzalez 1996,
    J. Nonlinear Sci. 6.
    """
    if TOPS.declared(system) and system.axis is None:
        raise ValueError(
            f"top_energy_momentum integrates {TOPS.noun}, got {type(system).__name__} without an axis; take splitting"
        )
    TOPS.check("top_energy_momentum", system)
    kappa = as_kappa(kappa)
    if iterations is None:
        iterations = (3 if kappa.constant else 5) if _is_linear(system.potential) else 6
    return TopEnergyMomentum(system, kappa, _checks.count("iterations", iterations, 1))


class _Equation(NamedTuple):
    """The equation for y of one step from a state; J, a and s are divided by tr J, so that |a| is an angle.

    Attributes:
        kappa: κ.
        potential: Ṽ.
        J: the inertia.
        a: ½ΔtΠ_n.
        s: ¼Δt².
        Gamma: Γ_n.
    """

    kappa: Kappa
    potential: Callable[[Array], Array]
    J: Symmetric
    a: Vector
    s: Array
    Gamma: Vector

    @classmethod
    def of(cls, step: TopEnergyMomentum, state: State, dt: ArrayLike) -> _Equation:
        """The equation of a step from a state."""
        J, r = three.unit_trace(step.system.inertia)
        a = scale(0.5 * r * dt, so3.Ad_star(state.q, state.p))
        Gamma = three.components(so3.Ad_star(state.q, step.system.axis))
        return cls(step.kappa, step.system.potential, J, a, 0.25 * r * dt * dt, Gamma)

    def turn(self, y: Vector) -> tuple[Array, Vector]:
        """κ and h."""
        k = self.kappa(4 * dot(y, y))
        return k, scale(k, y)

    def gradient(self, h: Vector) -> Array:
        """D̄ between Γ_n and Γ_{n+1}."""
        return discrete_gradient(self.potential, jnp.stack(self.Gamma), jnp.stack(_turned(h, self.Gamma)))

    def residual(self, y: Vector) -> Vector:
        """(1 + |h|²)(Jy + h × Jy − a − w) + (h·w) h."""
        k, h = self.turn(y)
        w = _moment(h, self.Gamma, scale(k, scale(self.s, self.gradient(h))))
        balance = subtract(subtract(gyration(self.kappa, self.J, y), self.a), w)
        return add(scale(1 + dot(h, h), balance), scale(dot(h, w), h))

    def matrix(self, y: Vector) -> three.Matrix:
        """∂/∂y over 1 + |h|², but for κ′ in the moment and O(Δt⁴): the last two terms are those of (h·w) h."""
        (k, h), K, Gamma = self.turn(y), gyration_matrix(self.kappa, self.J, y), self.Gamma
        F = scale(k * k, scale(self.s, self.gradient(h)))  # sκ²D̄
        w = _moment(h, Gamma, F)
        d = dot(Gamma, F) - dot(h, w)
        if not _is_linear(self.potential):  # S = 2∂D̄/∂Γ_{n+1}, up to O(ΔΓ²)
            at = jnp.stack(add(Gamma, scale(2, _turned(h, Gamma)))) / 3
            S = three.symmetric(jax.hessian(self.potential)(at))
            bend = [cross(Gamma, three.apply(S, cross(Gamma, e))) for e in np.eye(3)]
            K = three.combine(K, bend, -self.s * k * k)
        return [[K[i][j] - (d if i == j else 0) + Gamma[i] * F[j] + h[i] * w[j] for j in range(3)] for i in range(3)]

    def correction(self, y: Vector, f: Vector) -> Vector:
        """Newton's step."""
        _, h = self.turn(y)
        return three.solve(self.matrix(y), f, 1 + dot(h, h))

    def guess(self) -> Vector:
        """½(ΔtΩ + ½Δt²Ω̇): second order."""
        u = three.solve_symmetric(self.J, self.a)
        torque = scale(self.s, cross(self.Gamma, self.gradient(jnp.zeros_like(jnp.stack(self.a)))))
        return add(u, three.solve_symmetric(self.J, add(cross(self.a, u), torque)))

    def size(self, D: Vector, y: Vector) -> Array:
        """The size of the terms of the equation, by which its rounding errors are measured.

        The force's is |D̄|, and |Ṽ|/|ΔΓ| where D̄ is corrected.
        """
        step = scale(2, cross(self.Gamma, y))
        square = dot(step, step)
        corrected = (square > _APART / 4) & (not hasattr(self.potential, "discrete_gradient"))
        noise = jnp.abs(self.potential(jnp.stack(self.Gamma))) / jnp.sqrt(jnp.where(corrected, square, 1))
        force = three.max_abs(self.Gamma) * (three.max_abs(D) + jnp.where(corrected, noise, 0))
        return three.max_abs(self.a) + self.s * force


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


def _turned(h: Vector, Gamma: Vector) -> Vector:
    """Γ_{n+1} = cay(2h)ᵀΓ = Γ + 2(h × (h × Γ) − h × Γ)/(1 + |h|²)."""
    x = cross(h, Gamma)
    return add(Gamma, scale(2 / (1 + dot(h, h)), subtract(cross(h, x), x)))


def _half_turn(h: Vector, D: Vector) -> Vector:
    """½(1 + cay(2h))D = (D + h × D + h(h·D))/(1 + |h|²)."""
    return scale(1 / (1 + dot(h, h)), add(add(D, cross(h, D)), scale(dot(h, D), h)))


def _moment(h: Vector, Gamma: Vector, D: Vector) -> Vector:
    """w = (Γ − h × Γ) × D = Γ × D + (Γ·D)h − (h·D)Γ."""
    return subtract(add(cross(Gamma, D), scale(dot(Gamma, D), h)), scale(dot(h, D), Gamma))


def examples(system: Any) -> dict[str, Step]:
    """The paper's three κ's, for rigid bodies in a potential with an axis."""
    if not TOPS.declared(system) or system.axis is None:
        return {}
    return {step.name: step for step in (top_energy_momentum(system, kappa) for kappa in KAPPAS)}
