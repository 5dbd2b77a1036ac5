"""The equation of a step of a rigid body with laws of torque, and its solution: see `schemes._torqued_midpoint`.

    J y + κ y × J y = a + s ΣT̄_k,    z = ½Δt(η_{n+1} − η_n)/tr J

for y = ½Θ̄, and for z of each internal state η that a law leaves to the step, such as the momentum of a driven wheel.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.vectors import (
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
from lieint_jax.core import Law, Rotation, State, StepInfo, clock
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa
from lieint_jax.schemes._shared.equation import ImplicitEquation
from lieint_jax.schemes._shared.half_rotation import gyration, gyration_matrix, on_branch
from lieint_jax.systems._equations import AbstractTorquedBody

_SHORT = 0.25  # the cheap first correction (J for the Jacobian) is used if shorter than this part of |½ΔtΩ_n|
_Each = list[tuple[Array, Any, Any]]


class Torques(NamedTuple):
    """The mean torques of a step."""

    body: Array | None  # the sum of those given in the body, (3,), if any
    space: Array | None  # the sum of those given in space, (3,), if any
    each: _Each  # for each law its torque, and its internal state before and after


@dataclass(frozen=True)
class TorqueEquation(ImplicitEquation[Vector]):
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
    def from_state(cls, kappa: Kappa, system: AbstractTorquedBody, state: State, dt: Any) -> TorqueEquation:
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

    def solution(self, iterations: int) -> tuple[Rotation, Torques, StepInfo]:
        """The rotation of the step, the mean torques, and the report."""
        guess, limit = self.guess()
        x, info = self.solve(guess, iterations, done=newton.quadratic, first=limit)
        rotation = self.rotation(Vector(x[:3]))
        return rotation, self.torques(rotation, Vector(x[3:])), info

    def rotation(self, y: Vector) -> Rotation:
        """The rotation of a step, the argument of the laws."""
        q, k = self.q, self.kappa(4 * dot(y, y))
        h = jnp.stack(k * y)
        moves = self.dt != 0
        per = 2 / jnp.where(moves, self.dt, 1)
        Omega = jnp.stack([jnp.where(moves, *rates) for rates in zip(per * y, self.J.solve(self.Pi), strict=True)])
        half = so3.cayley_increment(q, h / (1 + jnp.sqrt(1 + dot(h, h))))
        return Rotation(self.t, self.dt, q, half, so3.cayley_increment(q, h), h, k, Omega, so3.Ad(q, Omega))

    def torques(self, rotation: Rotation, z: Vector) -> Torques:
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
        return Torques(sums.get("body"), sums.get("space"), [each[k] for k in range(len(each))])

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
        return la.solve(self._matrix(x, jacobian(self.scaled_torques_at, x)), f)

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
        changes = [(1, A), (speed, jacobian(by_velocity, x))]
        states = max_abs([self.half_dt * state for state in self.implicit_states], z) if z else speed
        if z:
            changes.append((states, jacobian(by_states, x)))
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


def jacobian(function: Callable[[Vector], Vector], x: Vector) -> Matrix:
    """The derivative of a function of components, as rows."""
    return _value_and_jacobian(function, x)[1]


def _value_and_jacobian(function: Callable[[Vector], Vector], x: Vector) -> tuple[Vector, Matrix]:
    """A function of components, and its derivative as rows."""

    def derivative(axis: Array) -> tuple[Vector, Vector]:
        return jax.jvp(function, (x,), (vector(axis),))

    value, rows = jax.vmap(derivative, out_axes=(None, 0))(jnp.eye(len(x), dtype=x[0].dtype))
    return value, Matrix(components(row) for row in rows)
