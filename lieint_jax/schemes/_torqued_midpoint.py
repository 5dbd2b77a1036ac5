"""The energy-momentum schemes of a rigid body with a torque or with internal friction: an exact balance of power.

With Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}) = 2y, h = ½Θ = κ(|Θ̄|²) y, a = ½ΔtΠ_n, s = ¼Δt², one step is

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt τ̄,    τ̄ = Λ̄T̄,  Λ̄ = ½(Λ_n + Λ_{n+1})
    J y + κ y × J y = a + s T̄                                                        (vector form)

for a torque T̄ given in the body. One given in space, τ̄ = Λ_nT, has T̄ = T − h × T. Since cay Θ Θ̄ = Θ̄, for any torque
and any κ

    ½ Π·J⁻¹Π |_n^{n+1} = Δt Ω̄·T̄ = Δt ω̄·τ̄,    Ω̄ = Θ̄/Δt,  ω̄ = Λ_nΩ̄ = Λ_{n+1}Ω̄

Internal friction turns the body by more, and no torque acts on it. With Π̄ = ½(Π_n + Π_{n+1}), Ω̄ = J⁻¹Π̄,

    Θ̄ = Δt(Ω̄ + α Π̄ × Ω̄),    Π̄ + h × Π̄ = Π_n,    ½ Π·J⁻¹Π |_n^{n+1} = −κΔtα|Π̄ × Ω̄|²
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import newton, vec3
from lieint_jax._numerics.vec3 import Symmetric, Vector, add, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._shared.accepts import AcceptedSystems
from lieint_jax.schemes._so3_midpoint import FREE_BODIES, gyration, gyration_matrix, on_branch
from lieint_jax.torques import internal_friction
from lieint_jax.types import AbstractDampedBody, AbstractTorquedBody, State, Step, StepInfo, clock, pytree, static


def _torqued_motion(body: AbstractTorquedBody, state: State) -> State:
    """(q̇, π̇) = (½ q Ω, τ), or π̇ = ΛT; and −τ for a momentum that the torque is taken from."""
    turning = FREE_BODIES.vector_field(body, state)
    Omega = so3.body_velocity(state.q, turning.q)
    law: Any = body.law(jnp.zeros_like(clock(state)), state.extra)
    if body.frame == "space":
        torque = law(state.t, state.q, so3.Ad(state.q, Omega))
    else:
        torque = so3.Ad(state.q, law(state.t, state.q, Omega))
    return State(turning.q, torque, extra=_taken(body, jax.tree.map(jnp.zeros_like, state.extra), torque))


def _damped_motion(body: AbstractDampedBody, state: State) -> State:
    """(q̇, π̇) = (½ q (Ω + αΠ × Ω), 0)."""
    turning = FREE_BODIES.vector_field(body, state)
    Omega = so3.body_velocity(state.q, turning.q)
    more = internal_friction(body.friction, so3.Ad_star(state.q, state.p), Omega)
    return turning._replace(q=turning.q + so3.tangent(state.q, jnp.stack(more)))


TORQUED_BODIES = AcceptedSystems(
    AbstractTorquedBody, "rigid bodies with a torque (systems.torqued_body)", _torqued_motion
)
DAMPED_BODIES = AcceptedSystems(
    AbstractDampedBody, "rigid bodies with internal friction (systems.damped_body)", _damped_motion
)


def _taken(body: AbstractTorquedBody, extra: dict[str, Array] | None, impulse: Array) -> dict[str, Array] | None:
    """`extra` less an impulse in space, if the torque is taken from a momentum in it."""
    key = getattr(body.torque, "key", None)
    return extra if key is None or extra is None else extra | {key: extra[key] - impulse}


@pytree
class TorquedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with a torque.

    Attributes:
        system: a rigid body with a torque.
        kappa: the scaling κ.
        iterations: Newton corrections per step.
    """

    system: AbstractTorquedBody
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        equation = _Equation.of(self, state, dt)
        y, info = equation.solve(self.iterations)
        h = equation.turn(y)[1]
        q = state.q + jnp.stack(so3.cayley_difference(state.q, h))
        omega, torque, _ = equation.torque(y)
        mean = torque if equation.space else (so3.Ad(state.q, torque) + so3.Ad(q, torque)) / 2
        impulse = jnp.asarray(dt) * mean
        work = None if state.work is None else state.work + equation.work(q, omega, torque)
        end = state._replace(q=q, p=state.p + impulse, work=work, extra=_taken(self.system, state.extra, impulse))
        return end, info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return _advice(self, dt, "the torque is too stiff")


@pytree
class DampedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with internal friction.

    Attributes:
        system: a rigid body with internal friction.
        kappa: the scaling κ.
        iterations: Newton corrections per step.
    """

    system: AbstractDampedBody
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        J, r = vec3.unit_trace(self.system.inertia)
        alpha, unit = self.system.friction / r, scale(r, so3.Ad_star(state.q, state.p))  # αΠ, Π/tr J

        def turn(P: Vector) -> tuple[Vector, Vector]:
            """Ω̄ and y = ½Θ̄ for P = Π̄/tr J."""
            Omega = vec3.solve_symmetric(J, P)
            return Omega, scale(0.5 * dt, add(Omega, internal_friction(alpha, P, Omega)))

        def balance(P: Vector) -> Vector:
            """Π̄ + h × Π̄, over tr J."""
            y = turn(P)[1]
            return add(P, scale(self.kappa(4 * dot(y, y)), cross(y, P)))

        def correction(P: Vector, f: Vector) -> Vector:
            return vec3.solve(_jacobian(balance, P), f)

        size = lax.stop_gradient(vec3.max_abs(unit))
        per = 1 / jnp.where(size > 0, size, 1)
        P, f, steady = newton.root(
            lambda P: subtract(balance(P), unit),
            correction,
            tuple(unit),
            self.iterations,
            unroll=False,
            length=lambda step: per * lax.stop_gradient(vec3.max_abs(step)),
        )
        Omega, y = turn(P)
        k = self.kappa(4 * dot(y, y))
        at = lax.stop_gradient
        good = steady & vec3.well_conditioned(J)
        good &= on_branch(self.kappa, at(y), _jacobian(balance, tuple(at(x) for x in P)))
        f = at(jnp.sqrt(dot(f, f)))
        q = so3.cayley_increment(state.q, jnp.stack(scale(k, y)))
        slip = cross(P, Omega)
        work = None if state.work is None else state.work - k * dt * alpha / r * dot(slip, slip)
        info = StepInfo(f * jnp.abs(0.5 * dt), (f <= 32 * jnp.finfo(f.dtype).eps * size) & good)
        return state._replace(q=q, work=work), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return _advice(self, dt, "the friction is too strong")


def _advice(step: Any, dt: ArrayLike, reason: str) -> str:
    return (
        f"{step.name} does not converge at dt = {dt}: the branch of this κ {step.kappa.branch}, or {reason}. "
        f"Take a smaller dt, or more than {step.iterations} iterations if |Δt Ω| < 1"
    )


def torqued_midpoint(
    system: AbstractTorquedBody | AbstractDampedBody,
    kappa: Kappa | Callable[[Array], Array] = kappa_cayley,
    iterations: int | None = None,
) -> TorquedMidpoint | DampedMidpoint:
    """The energy-momentum scheme of a rigid body with any torque τ(t, q, ω), or with internal friction; for any κ.

    | law of a step | to |
    |---|---|
    | ΔH = Δt ω̄·τ̄: the energy changes by the work, which `State.work` adds up; H − W is constant | round-off |
    | Δπ = Δt τ̄; with internal friction π itself | the impulse's rounding; bit for bit |
    | dissipation: a viscous law, a damper, a PD law, friction takes energy in each step with Δt > 0 | exactly |

    Second order, time-symmetric: a step of −Δt undoes one of Δt, dissipation too. `schemes.compose` raises the order;
    its negative sub-steps give energy back, so only whole steps of it lose energy, while H − W stays constant in each.

    τ̄ is the torque at t + ½Δt, at the attitude half-way, (q_n + q_{n+1})/|…|, and at ω̄; or the law's own `mean`, as
    of a PD law, whose potential is then exact too.

    Args:
        system: `systems.torqued_body(...)` or `systems.damped_body(...)`.
        kappa: κ as in `so3_midpoint`. The symplectic κ ends at |ΔtΩ| ≈ 1, the Cayley κ at 2 to 4.
        iterations: the most Newton corrections per step, by default 5. A step that fell short says `converged=False`.

    Raises:
        ValueError: another system, κ is not callable, iterations is not a positive int; when a run starts, a state
            without a time, and a torque that is not finite there.

    Source: the identities of Lewis & Simo 1994, Results 1 to 3, with a torque: this package.
    """
    kappa = as_kappa(kappa)
    count = _checks.count("iterations", 5 if iterations is None else iterations, 1)
    if isinstance(system, AbstractDampedBody):
        DAMPED_BODIES.check("torqued_midpoint", system)
        return DampedMidpoint(system, kappa, count)
    TORQUED_BODIES.check("torqued_midpoint", system, "; for internal friction take systems.damped_body")
    return TorquedMidpoint(system, kappa, count)


def examples(system: Any) -> dict[str, Step]:
    """The paper's three κ's, for bodies with a torque or with internal friction."""
    if not (TORQUED_BODIES.declared(system) or DAMPED_BODIES.declared(system)):
        return {}
    return {step.name: step for step in (torqued_midpoint(system, kappa) for kappa in KAPPAS)}


class _Equation(NamedTuple):
    """The equation for y of one step from a state; J, Π_n, a and s are divided by tr J, so that |a| is an angle.

    Attributes:
        kappa: κ.
        law: the torque of this step.
        space: whether it is given in space, else in the body.
        J: the inertia.
        Pi: Π_n.
        s: ¼Δt².
        q: q_n.
        t: t + ½Δt.
        dt: Δt.
    """

    kappa: Kappa
    law: Any
    space: bool
    J: Symmetric
    Pi: Vector
    s: Array
    q: Array
    t: Array
    dt: Array

    @classmethod
    def of(cls, step: TorquedMidpoint, state: State, dt: Any) -> _Equation:
        """The equation of a step from a state."""
        system = step.system
        J, r = vec3.unit_trace(system.inertia)
        Pi = vec3.components(r * so3.Ad_star(state.q, state.p))
        law, t = system.law(dt, state.extra), clock(state) + 0.5 * dt
        return cls(step.kappa, law, system.frame == "space", J, Pi, 0.25 * r * dt * dt, state.q, t, dt)

    @property
    def a(self) -> Vector:
        """½ΔtΠ_n."""
        return scale(0.5 * self.dt, self.Pi)

    def turn(self, y: Vector) -> tuple[Array, Vector]:
        """κ and h."""
        k = self.kappa(4 * dot(y, y))
        return k, scale(k, y)

    def torque(self, y: Vector, q: Array | None = None) -> tuple[Array, Array, Vector]:
        """ω̄, the mean torque given in the axes of the law, and T̄ in the body; from another q_n if it is given."""
        (k, h), q = self.turn(y), self.q if q is None else q
        moves = self.dt != 0
        per = 2 / jnp.where(moves, self.dt, 1)
        at_once = vec3.solve_symmetric(self.J, self.Pi)
        Omega = jnp.stack([jnp.where(moves, per * y[i], at_once[i]) for i in range(3)])
        omega = so3.Ad(q, Omega) if self.space else Omega
        if hasattr(self.law, "mean"):
            mean = self.law.mean(self.t, q, so3.cayley_increment(q, jnp.stack(h)), jnp.stack(h), k, omega)
        else:
            half = scale(1 / (1 + jnp.sqrt(1 + dot(h, h))), h)
            mean = self.law(self.t, so3.cayley_increment(q, jnp.stack(half)), omega)
        mean = jnp.asarray(mean).astype(self.q.dtype)
        if not self.space:
            return omega, mean, vec3.components(mean)
        T = so3.Ad_star(q, mean)
        return omega, mean, subtract(T, cross(h, T))

    def side(self, y: Vector) -> Vector:
        """sT̄."""
        return scale(self.s, self.torque(y)[2])

    def residual(self, y: Vector) -> Vector:
        """Jy + κ y × Jy − a − sT̄."""
        return subtract(subtract(gyration(self.kappa, self.J, y), self.a), self.side(y))

    def correction(self, y: Vector, f: Vector) -> Vector:
        """Newton's step."""
        K = vec3.combine(gyration_matrix(self.kappa, self.J, y), _jacobian(self.side, y), -1)
        return vec3.solve(K, f)

    def solve(self, iterations: int) -> tuple[Vector, StepInfo]:
        """y, and the report."""
        at = lax.stop_gradient
        u = vec3.solve_symmetric(self.J, self.a)  # ½ΔtΩ_n
        push = vec3.solve_symmetric(self.J, self.side(u))
        granted = at(vec3.max_abs(u) + vec3.max_abs(push))
        y, f, steady = newton.root(self.residual, self.correction, u, iterations, done=newton.quadratic, first=granted)
        branch, size = self.judge(tuple(at(x) for x in y))
        good = steady & branch & vec3.well_conditioned(self.J) & jnp.isfinite(at(self.t))
        f = at(jnp.sqrt(dot(f, f)))
        return y, StepInfo(f, (f <= 32 * jnp.finfo(f.dtype).eps * at(size)) & good)

    def judge(self, y: Vector) -> tuple[Array, Array]:
        """Whether y is on the branch from Δt = 0, and the size of the terms, which measures their rounding errors.

        q is known to round-off only, so the torque's part is its own size and that of its derivative by the attitude.
        """

        def side(y: Vector, angle: Vector) -> Vector:
            """sT̄ from an attitude turned in space."""
            q = [a + b for a, b in zip(self.q, so3.spatial_tangent(self.q, jnp.stack(angle)), strict=True)]
            return scale(self.s, self.torque(y, jnp.stack(q))[2])

        none = (jnp.zeros_like(y[0]),) * 3
        here, slope = jax.linearize(side, y, none)
        rows = jax.vmap(lambda e: slope(vec3.components(e[:3]), vec3.components(e[3:])))(jnp.eye(6, dtype=y[0].dtype))
        K = vec3.combine(gyration_matrix(self.kappa, self.J, y), [vec3.components(row[:3]) for row in rows], -1)
        force = jnp.maximum(vec3.max_abs(here), jnp.max(jnp.abs(jnp.stack(rows)[:, 3:])))
        return on_branch(self.kappa, y, K), vec3.max_abs(self.a) + force

    def work(self, q_next: Array, omega: Array, torque: Array) -> Array:
        """The work of the torque, but for that of its potential."""
        if hasattr(self.law, "power"):
            return self.dt * self.law.power(self.t, self.q, omega)
        done = self.dt * dot(omega, torque)
        if hasattr(self.law, "potential"):
            done = done + self.law.potential(q_next) - self.law.potential(self.q)
        return done


def _jacobian(function: Callable[[Vector], Vector], x: Vector) -> vec3.Matrix:
    """The derivative of a function of three components, as rows."""

    def along(axis: Array) -> Vector:
        return jax.jvp(function, (tuple(x),), (vec3.components(axis),))[1]

    return [vec3.components(row) for row in jax.vmap(along)(jnp.eye(3, dtype=x[0].dtype))]
