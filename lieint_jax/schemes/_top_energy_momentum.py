"""The energy-momentum schemes for a rigid body in an axisymmetric potential (Section 4.1), which may depend on time.

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt γ × e                                     (4.3)
    Θ = κ(|Θ̄|²) Θ̄,         Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1})                                (4.4)
    e = κ ½(Λ_n + Λ_{n+1}) D̄,    D̄·(Γ_{n+1} − Γ_n) = Ṽ(Γ_{n+1}) − Ṽ(Γ_n)               (4.6), corrected

with Γ = Λᵀγ and D̄ any symmetric discrete gradient of Ṽ. With y = ½Θ̄, h = κy = ½Θ, a = ½ΔtΠ_n, s = ¼Δt², and (4.4)
multiplied by 1 + ĥ, the equation for y is the free body's with a moment w, here times 1 + |h|²:

    (1 + |h|²)(Jy + h × Jy − a − w) + (h·w) h = 0,    w = sκ (Γ_n − h × Γ_n) × D̄

A step of a driven top uses half of the field frozen at t_n and half of the field frozen at t_{n+1}: the mean of the two
moments replaces γ × e and w. Result 7 at each frozen time gives, exactly and for any κ,

    H_{n+1} − H_n = ½[V(Λ_n, t_{n+1}) − V(Λ_n, t_n)] + ½[V(Λ_{n+1}, t_{n+1}) − V(Λ_{n+1}, t_n)] =: ΔW
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import count, named
from lieint_jax._numerics.vectors import (
    Matrix,
    Symmetric,
    Vector,
    cross,
    dot,
    max_abs,
    norm,
    outer,
    symmetric,
    unit_trace,
    vector,
)
from lieint_jax.core import Converted, PotentialWithGradient, State, Step, StepInfo, argument, clock, pytree, static
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.equation import ImplicitEquation
from lieint_jax.schemes._shared.half_rotation import gyration, gyration_matrix, on_branch
from lieint_jax.systems._equations import AbstractDrivenTop, AbstractTop, discrete_gradient

__all__ = ["top_energy_momentum"]

_APART = 1e-4  # above this |ΔΓ|²/|Γ|² the quadrature is corrected so that D̄·ΔΓ = ΔṼ exactly

PROPERTIES = SchemeProperties(
    name="top_energy_momentum",
    systems="tops, satellites",
    conserves=("energy less work", "momentum"),
    limit="|ΔtΩ| of 2 to 4 for the Cayley κ",
    aliases=("energy–momentum method",),
    source="Lewis & Simo 1994, (4.3), (4.4), Results 6 and 7, corrected",
    accepts=(AbstractTop, AbstractDrivenTop),
)


@pytree
class TopEnergyMomentum(Step):
    """The energy-momentum scheme (4.3), (4.4) with (4.6) corrected, for a rigid body in a potential with an axis.

    | conserved | to |
    |---|---|
    | energy; for a driven top, energy less work | round-off, for any κ and any Ṽ (Result 7) |
    | γ·π | round-off (Result 6), where γ does not move |
    | the symplectic form | no: defect O(Δt³) per step, for any κ (Result 8); `splitting` conserves it |

    The paper calls the scheme unconditionally stable. Energy is conserved at any Δt for which the step converges: for
    heavy tops and κ = 1 up to |ΔtΩ| of 0.15 to 0.3 with 3 iterations and of 1 to 2 with 50, smaller for larger torques.

    The scheme is of second order and time-symmetric. D̄ is the potential's own `discrete_gradient` if it has one,
    otherwise the average of the gradient between Γ_n and Γ_{n+1} by 4 Gauss nodes, corrected along ΔΓ where
    |ΔΓ| > 0.01.

    Args:
        system: `systems.heavy_top(...)` or `systems.potential_top(...)` with an axis; or a driven one with an axis,
            `systems.driven_top(...)`, `systems.gravity_gradient(...)`. The work of a driven potential is computed from
            differences of V, without ∂V/∂t or a quadrature.
        kappa: κ as in `so3_midpoint`.
        iterations: Newton corrections per step; by default 3 for a linear Ṽ and κ = 1, 5 for a linear Ṽ and any other
            κ, 6 for any other Ṽ. With κ = 1, J = (1, 2, 2.5) and Δt²|E| = 0.008, 3 reach round-off for |Δt Ω| ≤ 0.3, 4
            for ≤ 0.8. A step that does not converge reports `converged=False`.

    Raises:
        ValueError: no potential or no axis, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 6–8, with the factor κ that (4.6) lacks; the discrete gradient: Gonzalez 1996,
    J. Nonlinear Sci. 6.
    """

    system: AbstractTop | AbstractDrivenTop = argument(converter=PROPERTIES.check)
    kappa: Converted[Kappa] = argument(converter=as_kappa, default=kappa_cayley)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1, optional=True), default=None)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)

    def check_fields(self) -> dict[str, int]:
        if self.system.axis is None:
            raise ValueError(
                f"top_energy_momentum integrates {AbstractTop.noun}, got {type(self.system).__name__} without an axis; "
                "use splitting"
            )
        default = (3 if self.kappa.constant else 5) if _is_linear(self.system.potential) else 6
        return {"iterations": default if self.iterations is None else self.iterations}

    @property
    def name(self) -> str:
        return f"top_energy_momentum[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        q = state.q
        fields = _fields(self.system, state, dt)
        equation = _Equation.from_state(self, fields, state, dt)
        y, info = equation.solve(equation.guess(), self.iterations, unroll=_is_linear(self.system.potential))
        k, h = equation.turn(y)
        p = vector(state.p)
        for field, D in zip(fields, equation.gradients(h), strict=True):
            half_rotated = 1 / (1 + dot(h, h)) * (D + cross(h, D) + dot(h, D) * h)  # ½(1 + cay(2h))D̄
            e = so3.Ad(q, k * half_rotated)
            p = p + field.share * dt * cross(field.axis, e)
        # stacked last: many kernels read them, number by number
        after = state._replace(q=jnp.stack(vector(q) + so3.cayley_difference(q, h)), p=jnp.stack(p))
        return after if state.work is None else after._replace(work=state.work + self._work(fields, h)), info

    def _work(self, fields: tuple[_Field, ...], h: Vector) -> Array | float:
        """½[V(Λ_n, t_{n+1}) − V(Λ_n, t_n)] + ½[V(Λ_{n+1}, t_{n+1}) − V(Λ_{n+1}, t_n)]; 0 of a field at rest."""
        if len(fields) == 1:
            return 0.0
        ends = [(field.value(field.Gamma), field.value(_rotated_axis(h, field.Gamma))) for field in fields]
        (at_start, turned), (at_end, both) = ends
        return (at_end - at_start) / 2 + (both - turned) / 2

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} does not converge at dt = {dt}: the branch of this κ {self.kappa.branch}, or the potential "
            f"is too stiff. Use a smaller dt, or more than {self.iterations} iterations if |Δt Ω| < 1"
        )


class _Field(NamedTuple):
    """The field of a top at one time: all of a constant field, or half of a driven one."""

    potential: Callable[..., Array]  # Ṽ
    axis: Array  # γ in space
    Gamma: Vector  # γ in the body at the start of the step, Γ_n
    at: tuple[Array, ...]  # the time, for a driven top, or nothing
    share: float  # 1, or ½

    def value(self, Gamma: Vector) -> Array:
        """Ṽ(Γ) at this time."""
        return self.potential(jnp.stack(Gamma), *self.at)

    def gradient(self, h: Vector) -> Vector:
        """D̄ between Γ_n and Γ_{n+1} at this time."""
        ends = (jnp.stack(Gamma) for Gamma in (self.Gamma, _rotated_axis(h, self.Gamma)))
        return vector(discrete_gradient(self.potential, *ends, apart=_APART, at=self.at))

    def force_jacobian(self, h: Vector) -> Matrix:
        """The columns Γ × S(Γ × eᵢ), with S = 2∂D̄/∂Γ_{n+1} up to O(ΔΓ²)."""
        at = jnp.stack(self.Gamma + 2 * _rotated_axis(h, self.Gamma)) / 3
        S = symmetric(jax.hessian(self.potential)(at, *self.at))
        axes = np.eye(3).tolist()  # Python's numbers have no type of their own
        return Matrix(cross(self.Gamma, S @ cross(self.Gamma, e)) for e in axes)


def _fields(system: AbstractTop | AbstractDrivenTop, state: State, dt: ArrayLike) -> tuple[_Field, ...]:
    """The fields that act in a step from a state: one field, or half of the field at each of two times."""

    def field(axis: Array, at: tuple[Array, ...], share: float) -> _Field:
        return _Field(system.potential, axis, vector(so3.Ad_star(state.q, axis)), at, share)

    if isinstance(system, AbstractDrivenTop):
        t = clock(state)
        return tuple(field(system.axis_at(at), (at,), 0.5) for at in (t, t + dt))
    assert system.axis is not None
    return (field(system.axis, (), 1),)


@dataclass(frozen=True)
class _Equation(ImplicitEquation[Vector]):
    """The equation for y of one step from a state; J, a and s are divided by tr J, so that |a| is an angle."""

    kappa: Kappa
    J: Symmetric
    a: Vector  # ½ΔtΠ_n
    fields: tuple[tuple[_Field, Array], ...]  # each with its share of s = ¼Δt²

    @classmethod
    def from_state(cls, step: TopEnergyMomentum, fields: tuple[_Field, ...], state: State, dt: ArrayLike) -> _Equation:
        """The equation of a step from a state."""
        J, r = unit_trace(step.system.inertia)
        a = 0.5 * r * dt * vector(so3.Ad_star(state.q, state.p))
        return cls(step.kappa, J, a, tuple((field, field.share * 0.25 * r * dt * dt) for field in fields))

    def turn(self, y: Vector) -> tuple[Array, Vector]:
        """κ and h."""
        k = self.kappa(4 * dot(y, y))
        return k, k * y

    def gradients(self, h: Vector) -> list[Vector]:
        """D̄ of each field."""
        return [field.gradient(h) for field, _ in self.fields]

    def residual(self, y: Vector) -> Vector:
        """(1 + |h|²)(Jy + h × Jy − a − w) + (h·w) h."""
        k, h = self.turn(y)
        w = sum(_moment(h, field.Gamma, k * (s * field.gradient(h))) for field, s in self.fields)
        return (1 + dot(h, h)) * (gyration(self.kappa, self.J, y) - self.a - w) + dot(h, w) * h

    def matrix(self, y: Vector) -> Matrix:
        """∂/∂y over 1 + |h|², without κ′ in the moment and O(Δt⁴); the last two terms are those of (h·w) h."""
        (k, h), K = self.turn(y), gyration_matrix(self.kappa, self.J, y)
        for field, s in self.fields:
            Gamma, F = field.Gamma, k * k * (s * field.gradient(h))  # sκ²D̄
            w = _moment(h, Gamma, F)
            d = dot(Gamma, F) - dot(h, w)
            if not _is_linear(field.potential):
                K = K - s * k * k * field.force_jacobian(h)
            K = K - Symmetric((d, d, d)) + outer(Gamma, F) + outer(h, w)
        return K

    def correction(self, y: Vector, f: Vector) -> Vector:
        _, h = self.turn(y)
        return self.matrix(y).solve(f, 1 + dot(h, h))

    def guess(self) -> Vector:
        """½(ΔtΩ + ½Δt²Ω̇): second order."""
        u = self.J.solve(self.a)
        still = Vector(map(jnp.zeros_like, u))
        torque = sum(s * cross(field.Gamma, field.gradient(still)) for field, s in self.fields)
        return u + self.J.solve(cross(self.a, u) + torque)

    def report(self, y: Vector, f: Vector, steady: Array) -> StepInfo:
        at = lax.stop_gradient(y)
        good = steady & self.J.well_conditioned & on_branch(self.kappa, at, self.matrix(at))
        return StepInfo.of_root(norm(f), good, self.size(y))

    def size(self, y: Vector) -> Array:
        """The size of the terms of the equation, by which its rounding errors are measured.

        The size of the force is |D̄|, and |Ṽ|/|ΔΓ| where D̄ is corrected.
        """
        total = max_abs(self.a)
        for (field, s), D in zip(self.fields, self.gradients(self.turn(y)[1]), strict=True):
            step = 2 * cross(field.Gamma, y)
            square = dot(step, step)
            near = _APART / 4 * dot(field.Gamma, field.Gamma)
            corrected = (square > near) & (not hasattr(field.potential, "discrete_gradient"))
            noise = jnp.abs(field.value(field.Gamma)) / jnp.sqrt(jnp.where(corrected, square, 1))
            total = total + s * max_abs(field.Gamma) * (max_abs(D) + jnp.where(corrected, noise, 0))
        return total


def _is_linear(potential: Callable[..., Array]) -> bool:
    return isinstance(potential, PotentialWithGradient) and potential.linear


def _rotated_axis(h: Vector, Gamma: Vector) -> Vector:
    """Γ_{n+1} = cay(2h)ᵀΓ = Γ + 2(h × (h × Γ) − h × Γ)/(1 + |h|²)."""
    x = cross(h, Gamma)
    return Gamma + 2 / (1 + dot(h, h)) * (cross(h, x) - x)


def _moment(h: Vector, Gamma: Vector, D: Vector) -> Vector:
    """w = (Γ − h × Γ) × D = Γ × D + (Γ·D)h − (h·D)Γ."""
    return cross(Gamma, D) + dot(Gamma, D) * h - dot(h, D) * Gamma


@PROPERTIES.by_name
def examples(system: AbstractTop | AbstractDrivenTop) -> list[Step]:
    """The paper's three κ's, for rigid bodies in a potential with an axis."""
    return [] if system.axis is None else [top_energy_momentum(system, kappa) for kappa in KAPPAS]


top_energy_momentum = TopEnergyMomentum
