"""The energy-momentum schemes of the free rigid body (Sections 2.2 and 3), the symplectic one among them; gyrostats.

With Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}) and Θ = κ(|Θ̄|²) Θ̄, one step is

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n                                            (2.24), (3.3)

Put a = ½Δt Π_n. Then Θ̄ = 2y solves (3.4), which for a Cayley map loses its square roots:

    J y + κ y × J y = a,    κ = κ(4|y|²),    h = ½Θ = κ y                            (vector form)

For the symplectic κ = 1 + |h|² (3.16). Multiply by (1 + ĥ)⁻¹ = (1 − ĥ + h⊗h)/(1 + |h|²); what is left is linear in h
but for one scalar, m = a·h:

    J h = a + a × h + m h,    so  h = (J − m − â)⁻¹ a  and  m = a·(J − m − â)⁻¹ a     (scalar form)

a quartic for m, the same for every step of a trajectory.

In a gyrostat Θ̄ = Δt J⁻¹(½(Π_n + Π_{n+1}) − h̄_r), where h̄_r is the rotor's momentum, or the mean of it at the ends of
the step if a motor drives the rotor. With b = ½Δt h̄_r,

    J y + b + κ y × (J y + b) = a                                                    (vector form)

and from Π_{n+1} = cay(Θ)ᵀΠ_n, with cay(Θ)Θ̄ = Θ̄, follows H_{n+1} − H_n = −Ω̄·(h_{r,n+1} − h_{r,n}) with Ω̄ = Θ̄/Δt.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import newton, vec3
from lieint_jax._numerics.vec3 import Symmetric, Vector, add, apply, cross, dot, scale, subtract
from lieint_jax._xla import materialized
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_symplectic
from lieint_jax.schemes._shared.accepts import AcceptedSystems
from lieint_jax.schemes._shared.properties import SchemeProperties
from lieint_jax.types import (
    AbstractDrivenGyrostat,
    AbstractFreeBody,
    AbstractGyrostat,
    State,
    Step,
    StepInfo,
    clock,
    pytree,
    static,
)


def _motion(body: AbstractFreeBody | AbstractGyrostat, state: State) -> State:
    """(q̇, π̇) = (½ q Ω, 0) with JΩ = Π (2.12), or Π − h_r."""
    own = so3.Ad_star(state.q, state.p)
    if isinstance(body, AbstractGyrostat):
        own = own - body.rotor
    Omega = vec3.solve_symmetric(vec3.symmetric(body.inertia), own)
    return State(so3.tangent(state.q, jnp.stack(Omega)), jnp.zeros_like(state.p))


def _driven_motion(system: AbstractDrivenGyrostat, state: State) -> State:
    """That of the gyrostat whose rotor keeps the momentum that it has now, and ḣ_r = τ(t)."""
    turning = _motion(system.holding(system.rotor(state)), state)
    return turning._replace(extra={"rotor": system.torque(clock(state))})


ITERATIONS = {"scalar": 3, "vector": 4}  # Newton corrections per step, by the form of the equation
SLENDER = (
    "the inertia's moments differ so much that a full tensor does not hold the smallest one (to 1 : 3.5e4 in float64, "
    "1 : 1400 in float32): give principal moments (3,), and turn the attitude to the principal axes"
)
FREE_BODIES = AcceptedSystems(AbstractFreeBody, "free rigid bodies (systems.rigid_body)", _motion)
GYROSTATS = AcceptedSystems(AbstractGyrostat, "gyrostats (systems.gyrostat)", _motion)
DRIVEN_GYROSTATS = AcceptedSystems(AbstractDrivenGyrostat, "driven gyrostats (systems.driven_gyrostat)", _driven_motion)


def lost(dtype: Any) -> float:
    """The error of an attitude, by rounding of the state alone, above which a step is not to be trusted."""
    return max(1e-6, math.sqrt(jnp.finfo(dtype).eps))


@pytree
class SO3Midpoint(Step):
    """The step made by `so3_midpoint`.

    Attributes:
        system: a free rigid body or a gyrostat.
        kappa: the scaling κ.
        iterations: Newton corrections per step.
    """

    system: AbstractFreeBody | AbstractGyrostat | AbstractDrivenGyrostat
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def commuting(self) -> bool:
        return self.kappa.symplectic and isinstance(self.system, AbstractFreeBody)

    @property
    def name(self) -> str:
        return f"so3_midpoint[{self.kappa.name}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        if isinstance(self.system, AbstractDrivenGyrostat):
            return self._driven(self.system, state, jnp.asarray(dt))
        J, a = scaled(self.system, state, dt)
        h, info = half_turn(J, a, self.kappa, self.iterations, _bias(self.system, dt))
        return state._replace(q=so3.cayley_increment(state.q, h)), info

    def tangent(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        body = self.system
        if self.kappa.solve_by != "scalar" or not isinstance(body, AbstractFreeBody):
            return super().tangent(state, dt, T)
        J, a = scaled(body, state, dt)
        a = materialized(a)
        h, info = half_turn(J, jnp.stack(a), self.kappa, self.iterations)
        h = materialized(h)

        def carried(tangent: Array) -> Array:
            theta, p = tangent[:3], subtract(tangent[3:], cross(tangent[:3], state.p))
            da = materialized(scaled(body, state._replace(p=jnp.stack(p)), dt)[1])
            turn = materialized(so3.Ad(state.q, materialized(half_turn_derivative(J, a, h, da))))
            return jnp.stack([*add(theta, turn), *tangent[3:]])

        return state._replace(q=so3.cayley_increment(state.q, h)), info, jax.vmap(carried, -1, -1)(jnp.asarray(T))

    def _driven(self, system: AbstractDrivenGyrostat, state: State, dt: Array) -> tuple[State, StepInfo]:
        """The step of the gyrostat whose rotor keeps the mean momentum h̄_r, the rotor's change, and the work of it."""
        rotor, change = system.rotor(state), dt * system.torque(clock(state) + 0.5 * dt)
        mean = rotor + 0.5 * change
        end, info = dataclasses.replace(self, system=system.holding(mean))(state, dt)
        end = end._replace(extra=(state.extra or {}) | {"rotor": rotor + change})
        if state.work is None:
            return end, info
        own = 0.5 * (so3.Ad_star(state.q, state.p) + so3.Ad_star(end.q, end.p)) - mean  # JΩ̄
        Omega = vec3.solve_symmetric(vec3.symmetric(system.inertia), own)
        return end._replace(work=state.work - dot(Omega, change)), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        J = np.asarray(self.system.inertia)
        own = np.asarray(so3.Ad_star(state.q, state.p) - _rotor(self.system, state))
        turn = float(np.abs(dt) * np.linalg.norm(own / J if J.ndim == 1 else np.linalg.solve(J, own)))
        more = f", or more iterations than {self.iterations}" if turn < 1 else ""  # beyond, Newton may fail to converge
        rod = self.kappa.solve_by == "scalar" and turn < 0.9 * self.kappa.limit
        more += ", or for a slender body the vector form (see so3_midpoint)" if rod else ""
        if not vec3.well_conditioned(vec3.symmetric(self.system.inertia)):
            return f"{self.name}: {SLENDER}"
        return (
            f"{self.name} does not converge: |Δt Ω| = {turn:.3g} at dt = {dt}, the turn in a step, rad; the branch of "
            f"this κ {self.kappa.branch}. Take a smaller dt{more}"
        )


def so3_midpoint(
    system: AbstractFreeBody | AbstractGyrostat | AbstractDrivenGyrostat,
    kappa: Kappa | Callable[[Array], Array] = kappa_symplectic,
    iterations: int | None = None,
) -> SO3Midpoint:
    """The scheme (2.24), (2.28) = (3.3) for a free rigid body or a gyrostat, for any scaling κ.

    | κ | energy | spatial momentum | symplectic form |
    |---|---|---|---|
    | `maps.kappa_symplectic`, free body | exact | exact, bit for bit | exact (Result 5) |
    | any other, free body | exact (Result 3) | exact, bit for bit | defect O(Δt³) per step |
    | any, gyrostat | exact | exact, bit for bit | defect O(Δt³) per step: `splitting` is symplectic |
    | any, driven gyrostat | energy less work exact | exact, bit for bit | defect O(Δt³) per step |

    In a driven gyrostat each step changes the rotor's momentum by Δh_r = Δt τ(t_n + ½Δt), and the work, if it is
    counted, by −Ω̄·Δh_r.

    Second order, time-symmetric, |q| = 1 to round-off. Momentum is a Noether invariant of rotations in space; energy is
    ½ Π·J⁻¹Π. "Exact" is to round-off at a converged step; rounding errors add up, to 6e-12 of the energy in 10⁷ steps
    of J = (1, 2, 2.7) with Δt = 0.1 (`so3_explicit` takes them back).

    Args:
        system: `systems.rigid_body(...)`, `systems.gyrostat(...)`, `systems.driven_gyrostat(...)`.
        kappa: κ as a callable of x = |Θ̄|² with κ(0) = 1. A κ with parameters of its own is a `jax.tree_util.Partial`.
        iterations: Newton corrections per step; by default 3 for the scalar form (the symplectic κ of a free body), 4
            for the vector form. The scalar form reaches round-off with 2 for |Δt Ω| ≤ 0.7, with 3 for ≤ 0.95; the
            vector form with 2 for ≤ 0.2, 3 for ≤ 0.5, 4 for ≤ 0.8. A step that fell short says `converged=False`, and
            so does one whose iterations were not steady, as they may be for |Δt Ω| > 1.4: it could be at a root of
            another branch.

    A full tensor whose moments differ by more than 1 : 3.5e4 does not hold the smallest to enough digits; then every
    step says `converged=False`. Principal moments have no such limit.

    The scalar form loses digits on rods (J₁ ≪ J₂) at large |Δt Ω|, and says so by `converged`; there, take the slower
    vector form, `dataclasses.replace(maps.kappa_symplectic, solve_by="vector")`.

    The rotation of a step is at most 90° for the symplectic κ, which is real for |Θ̄| ≤ 1 only: on a principal axis the
    branch ends at |Δt Ω| = 1, off axis a little later (1.18 for J = (1, 2, 3)).

    Raises:
        ValueError: not a free rigid body or gyrostat, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 1–5; scalar form and quaternion increments: this package.
    """
    integrand = next((x for x in (GYROSTATS, DRIVEN_GYROSTATS) if x.declared(system)), FREE_BODIES)
    integrand.check("so3_midpoint", system)
    kappa = as_kappa(kappa)
    if iterations is None:
        iterations = ITERATIONS[kappa.solve_by if integrand is FREE_BODIES else "vector"]
    return SO3Midpoint(system, kappa, _checks.count("iterations", iterations, 1))


PROPERTIES = SchemeProperties(
    name="so3_midpoint",
    systems="free bodies, gyrostats",
    conserves=("energy", "momentum", "form (symplectic κ, free body)"),
    order=2,
    symmetric=True,
    limit="|ΔtΩ| ≈ 1 for the symplectic κ, 2 to 4 for others",
    aliases=("discrete Moser–Veselov (symplectic κ)", "RATTLE (symplectic κ)"),
    source="Lewis & Simo 1994, (2.24), (2.28), Results 1 to 5",
)


def examples(system: Any) -> dict[str, Step]:
    """The paper's three κ's, for free rigid bodies and gyrostats."""
    if not any(x.declared(system) for x in (FREE_BODIES, GYROSTATS, DRIVEN_GYROSTATS)):
        return {}
    return {step.name: step for step in (so3_midpoint(system, kappa) for kappa in KAPPAS)}


def half_turn(J: Symmetric, a: Array, kappa: Kappa, iterations: int, b: Array | None = None) -> tuple[Array, StepInfo]:
    """h = ½Θ of a step, shape (3,), from J and a as in `scaled` and b as in `_bias`, and its report."""
    if kappa.solve_by == "scalar" and b is None:
        h, residual, good = _solve_scalar(J, a, iterations)
    else:
        h, residual, good = _solve_vector(kappa, J, a, iterations, b)
        good &= jnp.finfo(a.dtype).eps * _size(a, b) * vec3.inverse_trace(J) <= lost(a.dtype)
    residual = lax.stop_gradient(vec3.max_abs(residual))
    small = residual <= 32 * jnp.finfo(a.dtype).eps * _size(a, b)
    return h, StepInfo(residual, small & good & vec3.well_conditioned(J))


def scaled(system: AbstractFreeBody | AbstractGyrostat, state: State, dt: ArrayLike) -> tuple[Symmetric, Array]:
    """J and a = ½Δt Π_n, both over tr J: then |a| is an angle, and no power of a large inertia overflows."""
    J, r = vec3.unit_trace(system.inertia)
    return J, (0.5 * r * dt) * so3.Ad_star(state.q, state.p)


def _bias(system: AbstractFreeBody | AbstractGyrostat, dt: ArrayLike) -> Array | None:
    """b = ½Δt h_r over tr J, None in a free body."""
    return (
        (0.5 * vec3.unit_trace(system.inertia)[1] * dt) * system.rotor if isinstance(system, AbstractGyrostat) else None
    )


def _size(a: Array, b: Array | None) -> Array:
    """The size of the terms of the vector form."""
    return vec3.max_abs(a) if b is None else jnp.maximum(vec3.max_abs(a), vec3.max_abs(b))


def _rotor(system: AbstractFreeBody | AbstractGyrostat | AbstractDrivenGyrostat, state: State) -> Array | float:
    """h_r, 0 in a free body."""
    if isinstance(system, AbstractDrivenGyrostat):
        return system.rotor(state)
    return system.rotor if isinstance(system, AbstractGyrostat) else 0.0


def _solve_scalar(J: Symmetric, a: Array, iterations: int) -> tuple[Vector, Vector, Array]:
    """h = ½Θ of the symplectic κ by the scalar form, its residual, and whether h is on the branch |h| ≤ 1.

    The scalar form gives the value; derivatives are those of the equation for h, which has far fewer terms.
    """
    h = half_cayley(J, a, scalar_root(J, a, iterations))
    h, residual, _ = newton.root(lambda h: jnp.stack(scalar_residual(J, a, h)), lambda _, f: f, h, iterations=0)
    return h, residual, dot(h, h) <= 1


def scalar_root(J: Symmetric, a: Array, iterations: int) -> Array:
    """m = a·(J − m − â)⁻¹a, constant along a trajectory, for tr J = 1."""
    C = vec3.adjugate(J)
    J3, J2 = vec3.determinant(J, C), vec3.trace(C)
    s, Ca = dot(a, a), apply(C, a)
    c0, c1, c2 = -(dot(a, Ca) + s * s), J3 + s, -(J2 + 2 * s)  # m det(J − m − â) − a·adj(J − m − â)a = c0 + c1 m + …

    def quartic(m: Array) -> Array:
        return c0 + m * (c1 + m * (c2 + m * (1 - m)))

    def correction(m: Array, f: Array) -> Array:
        """Newton's step on f/√f′ (Halley): the second derivative of a quartic costs nothing."""
        slope = c1 + m * (2 * c2 + m * (3 - 4 * m))
        bend = 2 * c2 + m * (6 - 12 * m)
        return 2 * f * slope / (2 * slope * slope - f * bend)

    r = 1 / J3
    u = tuple(r * x for x in Ca)  # J⁻¹a
    g = cross(a, u)
    m = r * dot(a, Ca) * (1 + dot(u, u)) - r * dot(g, apply(C, g))  # the root, but for O(Δt⁶)
    return newton.root(quartic, correction, m, iterations)[0]


def half_cayley(J: Symmetric, a: Array, m: Array, gain: Array | None = None) -> Array:
    """h = (J − m − â)⁻¹a, shape (3,), for tr J = 1.

    With adj(J − m − â)a = adj(J)a + (m² − m tr J + |a|²)a + m Ja − a×Ja everything is a polynomial in m. If m was
    solved for elsewhere on a trajectory, the quartic says by how much energy is off here; with a `gain`, a turn about
    a × J⁻¹a takes so much of it back.
    """
    C = vec3.adjugate(J)
    J3, J2 = vec3.determinant(J, C), vec3.trace(C)
    Ja, Ca, s = apply(J, a), apply(C, a), dot(a, a)
    k = s - m * (1 - m)
    w = J3 - m * (J2 + k)
    r = 1 / (w + dot(a, Ja))
    if gain is None:
        x = cross(a, Ja)
    else:
        t = gain * lax.stop_gradient(m * w - k * s - dot(a, Ca))  # 0 but for rounding, and so is its derivative
        x = cross(a, tuple(Ja[i] + t * Ca[i] for i in range(3)))
    return (r * k) * a + r * jnp.stack([Ca[i] + m * Ja[i] - x[i] for i in range(3)])


def scalar_residual(J: Symmetric, a: Array, h: Array) -> Vector:
    """Jh − a − a × h − (a·h)h: the scalar form itself, with m = a·h."""
    m, x, Jh = dot(a, h), cross(a, h), apply(J, h)
    return tuple(Jh[i] - m * h[i] - a[i] - x[i] for i in range(3))


def half_turn_derivative(J: Symmetric, a: Vector, h: Vector, da: Vector) -> Vector:
    """The turn of the body at the end of a step, in the axes of its beginning, that a change δa of a brings.

    (J − m − â − h⊗a) δh = δa + δa × h + (δa·h)h, m = a·h, the derivative of the scalar form; and cay 2h turns by
    2/(1 + |h|²) (δh + h × δh).
    """
    m, A, K = dot(a, h), vec3.hat(a), dense(J)
    K = [[K[i][j] - A[i][j] - h[i] * a[j] - (m if i == j else 0) for j in range(3)] for i in range(3)]
    right = add(da, add(cross(da, h), scale(dot(da, h), h)))
    dh = vec3.solve(K, right)
    return scale(2 / (1 + dot(h, h)), add(dh, cross(h, dh)))


def _solve_vector(
    kappa: Kappa, J: Symmetric, a: Array, iterations: int, b: Array | None = None
) -> tuple[Vector, Vector, Array]:
    """h = ½Θ for any κ by the vector form, its residual, and whether it is on the branch that starts at Δt = 0."""

    def residual(y: Vector) -> Vector:
        return subtract(gyration(kappa, J, y, b), a)

    def correction(y: Vector, f: Vector) -> Vector:
        return vec3.solve(gyration_matrix(kappa, J, y, b), f)

    u = vec3.solve_symmetric(J, a if b is None else a - b)
    guess = add(u, vec3.solve_symmetric(J, cross(a, u)))  # ½(ΔtΩ + ½Δt²J⁻¹(Π × Ω))
    y, f, steady = newton.root(residual, correction, guess, iterations)
    k = kappa(4 * dot(y, y))
    good = steady & on_branch(kappa, y, gyration_matrix(kappa, J, lax.stop_gradient(y), b))
    return (k * y[0], k * y[1], k * y[2]), f, good


def gyration(kappa: Kappa, J: Symmetric, y: Vector, b: Vector | None = None) -> Vector:
    """Jy + b + κ y × (Jy + b), the left side of the vector form; b = 0 if it is None."""
    still = apply(J, y) if b is None else add(apply(J, y), b)
    return add(still, scale(kappa(4 * dot(y, y)), cross_apply(y, J, b)))


def gyration_matrix(kappa: Kappa, J: Symmetric, y: Vector, b: Vector | None = None) -> vec3.Matrix:
    """The derivative of `gyration`, K = J + κ(ŷJ − (Jy + b)^) + 8κ′(y × (Jy + b))⊗y, as rows."""
    e, G = dense(J), gyroscopic(J, y, b)
    if kappa.constant:
        return vec3.combine(e, G)
    k, slope = jax.jvp(kappa, (4 * dot(y, y),), (jnp.full_like(y[0], 8),))
    g = scale(slope, cross_apply(y, J, b))
    return [[e[i][j] + k * G[i][j] + g[i] * y[j] for j in range(3)] for i in range(3)]


def on_branch(kappa: Kappa, y: Vector, K: vec3.Matrix) -> Array:
    """Whether y = ½Θ̄ lies where κ is real, and before the branch folds, where an eigenvalue of K vanishes."""
    return (4 * dot(y, y) <= kappa.limit**2) & vec3.no_negative_eigenvalue(K)


def cross_apply(y: Vector, J: Symmetric, b: Vector | None = None) -> Vector:
    """y × (Jy + b); b = 0 if it is None."""
    if b is not None:
        return add(cross_apply(y, J), cross(y, b))
    if len(J) == 3:
        return ((J[2] - J[1]) * (y[1] * y[2]), (J[0] - J[2]) * (y[2] * y[0]), (J[1] - J[0]) * (y[0] * y[1]))
    return cross(y, apply(J, y))


def gyroscopic(J: Symmetric, y: Vector, b: Vector | None = None) -> vec3.Matrix:
    """The derivative of y × (Jy + b): ŷJ − (Jy + b)^."""
    if b is not None:
        return vec3.combine(gyroscopic(J, y), vec3.hat(b), -1)
    if len(J) == 3:
        d = (J[2] - J[1], J[0] - J[2], J[1] - J[0])
        zero = jnp.zeros_like(d[0])
        return (
            (zero, d[0] * y[2], d[0] * y[1]),
            (d[1] * y[2], zero, d[1] * y[0]),
            (d[2] * y[1], d[2] * y[0], zero),
        )
    yJ = [cross(y, row) for row in vec3.rows(J)]  # columns of ŷJ, J being symmetric
    Jy = vec3.hat(apply(J, y))
    return [[yJ[j][i] - Jy[i][j] for j in range(3)] for i in range(3)]


def dense(J: Symmetric) -> vec3.Matrix:
    """J as rows."""
    if len(J) == 6:
        return vec3.rows(J)
    zero = jnp.zeros_like(J[0])
    return ((J[0], zero, zero), (zero, J[1], zero), (zero, zero, J[2]))
