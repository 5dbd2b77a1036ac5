"""The energy-momentum schemes of a rigid body with torques or with internal friction: an exact balance of power.

With Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}) = 2y, h = ½Θ = κ(|Θ̄|²) y, a = ½ΔtΠ_n, s = ¼Δt², one step is

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt Στ̄_k,    τ̄_k = Λ̄T̄_k,  Λ̄ = ½(Λ_n + Λ_{n+1})
    J y + κ y × J y = a + s ΣT̄_k                                                     (vector form)

for mean torques T̄_k given in the body. For a torque given in space, τ̄ = Λ_nT, T̄ = T − h × T. Since cay Θ Θ̄ = Θ̄,
for any torques and any κ

    ½ Π·J⁻¹Π |_n^{n+1} = Δt Ω̄·ΣT̄_k = Δt ω̄·Στ̄_k,    Ω̄ = Θ̄/Δt,  ω̄ = Λ_nΩ̄ = Λ_{n+1}Ω̄

so that with the work W_k = Δt Ω̄·T̄_k + ΔE_k of each law, E_k its energy, ½ Π·J⁻¹Π + ΣE_k − ΣW_k is constant.

Internal friction adds a rotation, but no torque. With Π̄ = ½(Π_n + Π_{n+1}), Ω̄ = J⁻¹Π̄,

    Θ̄ = Δt(Ω̄ + α Π̄ × Ω̄),    Π̄ + h × Π̄ = Π_n,    ½ Π·J⁻¹Π |_n^{n+1} = −κΔtα|Π̄ × Ω̄|²
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.equation import ImplicitEquation
from lieint_jax.capabilities import AbstractDampedBody, AbstractTorquedBody, AbstractTorquedBodyInTime
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.half_rotation import gyration, gyration_matrix, on_branch
from lieint_jax.schemes._shared.inertia_in_time import advice_in_time, step_in_time
from lieint_jax.torques import internal_friction
from lieint_jax.types import Function, Law, Rotation, State, Step, StepInfo, clock, labels, pytree, static
from lieint_jax.types.vectors import (
    Matrix,
    Symmetric,
    Vector,
    components,
    cross,
    dot,
    max_abs,
    norm,
    unit_trace,
    vector,
)

__all__ = ["DampedMidpoint", "TorquedMidpoint", "torqued_midpoint"]


@pytree
class TorquedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with a torque."""

    system: AbstractTorquedBody | AbstractTorquedBodyInTime
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state, fits = self.system.sampled(state, jnp.asarray(dt))
        if isinstance(self.system, AbstractTorquedBodyInTime):
            end, info = step_in_time(self.system, state, dt, lambda body, z: self._advance(body, z, dt))
        else:
            end, info = self._advance(self.system, state, dt)
        return end, info if fits is True else info._replace(converged=info.converged & fits)

    def _advance(self, system: AbstractTorquedBody, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """The step of a body of constant inertia."""
        equation = _Equation.from_state(self.kappa, system, state, dt)
        guess, limit = equation.guess()
        x, info = equation.solve(guess, self.iterations, done=newton.quadratic, first=limit)
        y, z = Vector(x[:3]), Vector(x[3:])
        rotation = equation.rotation(y)
        torques = equation.torques(rotation, z)
        q = state.q + jnp.stack(so3.cayley_difference(state.q, rotation.h))
        rotation = rotation._replace(q_next=q)
        impulses = [] if torques.space is None else [torques.space]
        if torques.body is not None:
            impulses.append((so3.Ad(state.q, torques.body) + so3.Ad(q, torques.body)) / 2)
        end = state._replace(q=q, p=state.p + jnp.asarray(dt) * functools.reduce(jnp.add, impulses))
        works = [law.work(rotation, *found) for law, found in zip(equation.laws, torques.each, strict=True)]
        if state.work is not None:
            end = end._replace(work=state.work + sum(works))
        return end._replace(extra=_extra_after(state.extra, equation.laws, torques.each, works)), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        if not self.system.sampled(state, jnp.asarray(dt))[1]:
            return next(law.refusal(clock(state), dt) for law in self.system.laws if law.held)
        dtype = state.p.dtype
        number, q, vector = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (4,), (3,)))
        for name, law in zip(labels(self.system), self.system.laws, strict=True):
            found = jax.eval_shape(law, number, q, vector).dtype if isinstance(law, Function) else dtype
            if jnp.issubdtype(found, jnp.floating) and found.itemsize < dtype.itemsize:
                return (
                    f"the torque {name} returns {found}, so that no step converges to round-off of {dtype}, the type "
                    "of the state: compute it in the type of its arguments"
                )
        in_time = isinstance(self.system, AbstractTorquedBodyInTime) and advice_in_time(self.system, state, dt)
        return in_time or _advice(self, dt, "the torque is too stiff")


@pytree
class DampedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with internal friction."""

    system: AbstractDampedBody
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt, (J, r) = jnp.asarray(dt), unit_trace(self.system.inertia)
        alpha, unit = self.system.friction / r, r * vector(so3.Ad_star(state.q, state.p))  # αΠ, Π/tr J

        def turn(P: Vector) -> tuple[Vector, Vector]:
            """Ω̄ and y = ½Θ̄ for P = Π̄/tr J."""
            Omega = J.solve(P)
            return Omega, 0.5 * dt * (Omega + internal_friction(alpha, P, Omega))

        def balance(P: Vector) -> Vector:
            """Π̄ + h × Π̄, over tr J."""
            y = turn(P)[1]
            return P + self.kappa(4 * dot(y, y)) * cross(y, P)

        def correction(P: Vector, f: Vector) -> Vector:
            return _jacobian(balance, P).solve(f)

        size = lax.stop_gradient(max_abs(unit))
        per = 1 / jnp.where(size > 0, size, 1)
        P, f, steady = newton.root(
            lambda P: balance(P) - unit,
            correction,
            unit,
            self.iterations,
            unroll=False,
            length=lambda step: per * lax.stop_gradient(max_abs(step)),
        )
        Omega, y = turn(P)
        k = self.kappa(4 * dot(y, y))
        at = lax.stop_gradient
        good = steady & J.well_conditioned
        good &= on_branch(self.kappa, at(y), _jacobian(balance, at(P)))
        info = StepInfo.of_root(norm(f), good, size)
        q = so3.cayley_increment(state.q, jnp.stack(k * y))
        slip = cross(P, Omega)
        work = None if state.work is None else state.work - k * dt * alpha / r * dot(slip, slip)
        return state._replace(q=q, work=work), info._replace(residual=info.residual * jnp.abs(0.5 * dt))

    def advice(self, state: State, dt: ArrayLike) -> str:
        return _advice(self, dt, "the friction is too strong")


def _advice(step: TorquedMidpoint | DampedMidpoint, dt: ArrayLike, reason: str) -> str:
    return (
        f"{step.name} does not converge at dt = {dt}: the branch of this κ {step.kappa.branch}, or {reason}. "
        f"Use a smaller dt, or more than {step.iterations} iterations if |Δt Ω| < 1"
    )


def torqued_midpoint(
    system: AbstractTorquedBody | AbstractTorquedBodyInTime | AbstractDampedBody,
    kappa: Kappa | Callable[[Array], Array] = kappa_cayley,
    iterations: int | None = None,
) -> TorquedMidpoint | DampedMidpoint:
    """The energy-momentum scheme of a rigid body with any torques, or with internal friction; for any κ.

    | balance of a step | to |
    |---|---|
    | ΔH = ΣW_k: the energy changes by the works of the laws, which `State.work` counts; H − W is constant | round-off |
    | Δπ = Δt Στ̄_k; with internal friction, π is constant | the impulse's rounding; bit for bit |
    | π plus the momenta of wheels and dampers is constant, where no other law acts | round-off |
    | drag, dampers, torquers, PD laws and friction dissipate energy in every step with Δt > 0 | exactly |

    The scheme is of second order and time-symmetric, also with dissipation, unless a law is not symmetric
    (`torques.hysteresis`, wheels with a limit of momentum). `schemes.compose` raises the order; its negative sub-steps
    add energy, so energy decreases over its whole steps only, while H − W is constant in each sub-step.
    `State.extra["works"]`, if it exists, counts the work of each law.

    The torque of a function is evaluated at t + ½Δt, at the attitude half-way, (q_n + q_{n+1})/|…|, and at ω̄. A law
    defines its own mean torque, such as that of a potential, whose balance is then exact too. A body whose inertia is a
    function of time moves in each step with J(t + ½Δt); `State.work` counts the changes of J at both ends too.

    Args:
        system: `systems.torqued_body(...)`, `systems.damped_body(...)`, or `systems.inertia_in_time(..., torque=...)`.
        kappa: κ as in `so3_midpoint`. The symplectic κ ends at |ΔtΩ| ≈ 1, the Cayley κ at 2 to 4.
        iterations: the most Newton corrections per step, by default 5. A step that does not converge reports
            `converged=False`.

    Raises:
        ValueError: the system is none of these, κ is not callable, iterations is not a positive int; at the start of a
            run, the state has no time, or the torque is not finite.

    Source: the identities of Lewis & Simo 1994, Results 1 to 3, with a torque: this package.
    """
    PROPERTIES.check(system)
    kappa = as_kappa(kappa)
    count = _checks.count("iterations", 5 if iterations is None else iterations, 1)
    if isinstance(system, AbstractDampedBody):
        return DampedMidpoint(system, kappa, count)
    return TorquedMidpoint(system, kappa, count, symmetric=all(law.symmetric for law in system.laws))


PROPERTIES = SchemeProperties(
    name="torqued_midpoint",
    systems="bodies with torques, also with J(t), or internal friction",
    conserves=("energy less work",),
    limit="|ΔtΩ| ≈ 1 for the symplectic κ, 2 to 4 for others",
    aliases=("energy–momentum midpoint rule",),
    source="Lewis & Simo 1994, Results 1 to 3, with torques: this package",
    accepts=(AbstractTorquedBody, AbstractDampedBody, AbstractTorquedBodyInTime),
)


@PROPERTIES.by_name
def examples(system: AbstractTorquedBody | AbstractTorquedBodyInTime | AbstractDampedBody) -> list[Step]:
    """The paper's three κ's, for bodies with a torque or with internal friction."""
    return [torqued_midpoint(system, kappa) for kappa in KAPPAS]


_SHORT = 0.25  # the cheap first correction (J for the Jacobian) is used if shorter than this part of |½ΔtΩ_n|
_Each = list[tuple[Array, Any, Any]]


class _Torques(NamedTuple):
    """The mean torques of a step."""

    body: Array | None  # the sum of those given in the body, (3,), if any
    space: Array | None  # the sum of those given in space, (3,), if any
    each: _Each  # for each law its torque, and its internal state before and after


def _extra_after(
    extra: dict[str, Array] | None, laws: Sequence[Law], each: _Each, works: list[Array]
) -> dict[str, Array] | None:
    """`extra` with the internal states of the laws after a step, and with their works if they are counted."""
    if extra is None:
        return None
    after = {law.key: end for law, (_, _, end) in zip(laws, each, strict=True) if law.key is not None}
    counted = {"works": extra["works"] + jnp.stack(works)} if "works" in extra else {}
    return extra | after | counted


@dataclass(frozen=True)
class _Equation(ImplicitEquation[Vector]):
    """The equation of one step from a state; J and Π_n are divided by tr J, so that the unknowns are angles.

    The unknowns x are y and, for each internal state η that a law leaves to the step, z = ½Δt(η_{n+1} − η_n)/tr J.
    """

    kappa: Kappa
    laws: tuple[Law, ...]
    inner: tuple[Array | None, ...]  # the internal states of the laws
    J: Symmetric
    Pi: Vector  # Π_n
    half_dt: Array  # ½Δt/tr J
    q: Array  # q_n
    t: Array  # t_n
    dt: Array

    @classmethod
    def from_state(cls, kappa: Kappa, system: AbstractTorquedBody, state: State, dt: Any) -> _Equation:
        """The equation of a step from a state."""
        J, r = unit_trace(system.inertia)
        Pi = vector(r * so3.Ad_star(state.q, state.p))
        inner = tuple(system.inner(state, law) for law in system.laws)
        laws = tuple(system.holding(state, law) for law in system.laws)
        return cls(kappa, laws, inner, J, Pi, 0.5 * r * dt, state.q, clock(state), dt)

    @property
    def a(self) -> Vector:
        """½ΔtΠ_n."""
        return 0.5 * self.dt * self.Pi

    @property
    def implicit_states(self) -> Vector:
        """The internal states η_n that belong to the unknowns, one after the other."""
        return _flat(jnp.asarray(inner) for law, inner in zip(self.laws, self.inner, strict=True) if law.implicit)

    def rotation(self, y: Vector) -> Rotation:
        """The rotation of a step, the argument of the laws."""
        q, k = self.q, self.kappa(4 * dot(y, y))
        h = jnp.stack(k * y)
        moves = self.dt != 0
        per = 2 / jnp.where(moves, self.dt, 1)
        Omega = jnp.stack([jnp.where(moves, *rates) for rates in zip(per * y, self.J.solve(self.Pi), strict=True)])
        half = so3.cayley_increment(q, h / (1 + jnp.sqrt(1 + dot(h, h))))
        return Rotation(self.t, self.dt, q, half, so3.cayley_increment(q, h), h, k, Omega, so3.Ad(q, Omega))

    def torques(self, rotation: Rotation, z: Vector) -> _Torques:
        """The mean torques of all laws. A law that reads an internal state receives its mean over the step."""
        sums, each, means, unknown = {}, {}, {}, iter(z)
        for k, law in sorted(enumerate(self.laws), key=lambda numbered: numbered[1].reads is not None):
            inner = self.inner[k] if law.reads is None else means[law.reads]
            if law.implicit:
                inner = jnp.asarray(inner)
                torque, after = law.implicit_mean(rotation, inner, self._state_after(inner, unknown))
            else:
                torque, after = law.mean(rotation, inner)
            torque = jnp.asarray(torque).astype(self.q.dtype)
            sums[law.frame] = sums[law.frame] + torque if law.frame in sums else torque
            each[k] = (torque, inner, after)
            if law.key is not None:
                means[law.key] = jax.tree.map(lambda a, b: (a + b) / 2, inner, after)
        return _Torques(sums.get("body"), sums.get("space"), [each[k] for k in range(len(each))])

    def _state_after(self, inner: Array, z: Iterator[Array]) -> Array:
        """η_{n+1} by the unknowns."""
        moves = self.half_dt != 0
        change = jnp.stack([next(z) for _ in range(inner.size)]).reshape(inner.shape)
        return inner + jnp.where(moves, change / jnp.where(moves, self.half_dt, 1), 0)

    def scaled_torques(self, rotation: Rotation, z: Vector) -> Vector:
        """sT̄, with T̄ = ΣT̄_k in the body; and what the laws make of z."""
        found = self.torques(rotation, z)
        terms = [] if found.body is None else [vector(found.body)]
        if found.space is not None:
            T = vector(so3.Ad_star(rotation.q_n, found.space))
            terms.append(T - cross(rotation.h, T))
        sT = 0.5 * self.dt * self.half_dt * sum(terms)
        changes = (
            self.half_dt * (after - before)
            for law, (_, before, after) in zip(self.laws, found.each, strict=True)
            if law.implicit
        )
        return Vector((*sT, *_flat(changes)))

    def scaled_torques_at(self, x: Vector) -> Vector:
        """`scaled_torques` as a function of the unknowns."""
        return self.scaled_torques(self.rotation(Vector(x[:3])), Vector(x[3:]))

    def residual(self, x: Vector) -> Vector:
        """Jy + κ y × Jy − a − sT̄, and z less what the laws make of it."""
        free = gyration(self.kappa, self.J, Vector(x[:3])) - self.a
        return Vector((*free, *x[3:])) - self.scaled_torques_at(x)

    def correction(self, x: Vector, f: Vector) -> Vector:
        return la.solve(self._matrix(x, _jacobian(self.scaled_torques_at, x)), f)

    def _matrix(self, x: Vector, *of_sides: Matrix) -> Matrix:
        """The derivative of the residual, that of `scaled_torques` being the sum of matrices."""
        K, n = gyration_matrix(self.kappa, self.J, Vector(x[:3])), len(x)
        free = Matrix((K[i][j] if max(i, j) < 3 else float(i == j) for j in range(n)) for i in range(n))
        return functools.reduce(operator.sub, of_sides, free)

    def guess(self) -> tuple[Vector, Array]:
        """y and z to begin with, and the length that a steady solve may give its first correction."""
        u = self.J.solve(self.a)  # ½ΔtΩ_n
        f = self.residual(Vector((*u, *(jnp.zeros_like(u[0]) for _ in self.implicit_states))))
        push = self.J.solve(f[:3])
        limit = lax.stop_gradient(max_abs(u, f[3:]) + max_abs(push))
        short = max_abs(push) <= _SHORT * max_abs(u)
        return Vector((*(u - Vector(jnp.where(short, x, 0) for x in push)), *(-x for x in f[3:]))), limit

    def report(self, x: Vector, f: Vector, steady: Array) -> StepInfo:
        at = lax.stop_gradient
        branch, sizes = self.branch_and_sizes(at(x))
        good = steady & branch & self.J.well_conditioned & jnp.isfinite(at(self.t))
        errors = [norm(rows) for rows in (f[:3], f[3:]) if rows]
        infos = [StepInfo.of_root(error, good, size) for error, size in zip(errors, sizes, strict=True)]
        return functools.reduce(StepInfo.merge, infos)

    def branch_and_sizes(self, x: Vector) -> tuple[Array, list[Array]]:
        """Whether x is on the branch from Δt = 0, and the sizes of the terms, which measure their rounding errors.

        Attitudes, velocities and internal states have rounding errors of their own size, so the laws contribute their
        own size and those of their derivatives by all of these. There is a size for y and, if it exists, one for z.
        """
        y, z = Vector(x[:3]), Vector(x[3:])
        now = self.rotation(y)

        def by_attitude(x: Vector) -> Vector:
            """`scaled_torques` at a constant velocity and constant internal states."""
            return self.scaled_torques(self.rotation(Vector(x[:3]))._replace(Omega=now.Omega, omega=now.omega), z)

        def by_velocity(x: Vector) -> Vector:
            """`scaled_torques` at a constant attitude and constant internal states."""
            moved = self.rotation(Vector(x[:3]))
            return self.scaled_torques(now._replace(Omega=moved.Omega, omega=moved.omega), z)

        def by_states(x: Vector) -> Vector:
            """`scaled_torques` for one rotation."""
            return self.scaled_torques(now, Vector(x[3:]))

        speed = max_abs(y) / jnp.maximum(1, max_abs(vector(now.h)))  # h may enlarge h × T at will
        here, A = _value_and_jacobian(by_attitude, x)
        changes = [(1, A), (speed, _jacobian(by_velocity, x))]
        states = max_abs([self.half_dt * state for state in self.implicit_states], z) if z else speed
        if z:
            changes.append((states, _jacobian(by_states, x)))
        K = self._matrix(x, *(A for _, A in changes))

        def size(rows: slice, own: Array) -> Array:
            terms = [weight * max_abs(*A[rows]) for weight, A in changes]
            return own + functools.reduce(jnp.maximum, terms, max_abs(here[rows]))

        first, last = slice(3), slice(3, None)
        if not z:
            return on_branch(self.kappa, y, K), [size(first, max_abs(self.a))]
        inner = la.factored(Matrix(row[3:] for row in K[3:]))
        columns = [inner.solve(Vector(row[j] for row in K[3:])) for j in range(3)]  # of K_zz⁻¹ K_zy
        rest = Matrix((K[i][j] - dot(K[i][3:], columns[j]) for j in range(3)) for i in range(3))
        branch = on_branch(self.kappa, y, rest) & inner.positive
        return branch, [size(first, max_abs(self.a)), size(last, states)]


def _flat(arrays: Iterable[Array]) -> Vector:
    """The entries of arrays, one after the other."""
    return Vector(x for array in arrays for x in components(array.reshape(-1)))


def _jacobian(function: Callable[[Vector], Vector], x: Vector) -> Matrix:
    """The derivative of a function of components, as rows."""
    return _value_and_jacobian(function, x)[1]


def _value_and_jacobian(function: Callable[[Vector], Vector], x: Vector) -> tuple[Vector, Matrix]:
    """A function of components, and its derivative as rows."""

    def derivative(axis: Array) -> tuple[Vector, Vector]:
        return jax.jvp(function, (x,), (vector(axis),))

    value, rows = jax.vmap(derivative, out_axes=(None, 0))(jnp.eye(len(x), dtype=x[0].dtype))
    return value, Matrix(components(row) for row in rows)
