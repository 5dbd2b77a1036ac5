"""Canonical coordinates of phase spaces in flat space, in which Gauss–Legendre methods are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It conserves |q|² and q·p, and the components of
π = ½ Im(p q̄) that the torque conserves: all quadratic. A potential Ṽ(Γ) of an axis γ is better extended from the
sphere as Ṽ(q̄γq), without |q|: its part of ṗ is then 2γq∇Ṽ. This changes q·p, which influences nothing else and is
reset after each step.

T*GL⁺(3) is flat already.

Each of the three phase spaces has a chart here, whose coordinates are components of q and as many of p. For several
bodies these are positions and quaternions, then linear momenta and p, each with an axis of bodies, (N,).
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.vectors import Matrix, Symmetric, Vector, cross, dot, vector
from lieint_jax.core import State, System, gradient
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, CotangentMatrices, CotangentMotions
from lieint_jax.schemes.charts._chart import Chart
from lieint_jax.schemes.charts.body_axes import axis_in_body, quat_times_vec, scalar_and_vector
from lieint_jax.systems._equations import (
    AbstractDrivenSystem,
    AbstractDrivenTop,
    AbstractForcedSystem,
    AbstractGyrostat,
    AbstractMechanicalSystem,
    AbstractTop,
)

Components = tuple[Array, ...]


class Coordinates(NamedTuple):
    """The unknowns of a canonical chart: the components of q, and those of the momenta conjugate to them."""

    q: Components
    p: Components


class Quadratures(NamedTuple):
    """Quantities that are integrated along the coordinates."""

    momenta: Components  # of the state itself: π, or (p, π)
    work: Array | None  # of a driven system, if it is tracked


class Increments(NamedTuple):
    """The increments of a step, or rates."""

    z: Coordinates
    quadratures: Quadratures | None  # of the quantities integrated along the coordinates; None in a chart without any


Moment = Array | None  # a time, or None of a state without one


class CanonicalChart(Chart):
    """Coordinates of a flat space in which the system is Hamiltonian, and quadratic invariants stay quadratic."""

    @abc.abstractmethod
    def configuration(self, z: Coordinates) -> Array:
        """The configuration of coordinates, with quaternions of unit length."""

    @abc.abstractmethod
    def force(self, system: Any) -> Callable[[Coordinates, Moment], Components] | None:
        """(z, t) ↦ the components of the rates of the state's momenta; None where the coordinates contain these."""

    def stage_times(self, system: Any, state: State, passed: Array) -> Moment:
        """The times, (n,), of a state that has one."""
        return None if state.t is None else state.t + passed

    def split_qp(self, z: Coordinates) -> tuple[Components, Components]:
        return z.q, z.p

    def quadratures(self, system: Any, state: State) -> Callable[[Coordinates, Moment], Quadratures | None]:
        """(z, t) ↦ the rates of the quantities that a step from `state` integrates along its coordinates."""
        force = self.force(system)
        counts = isinstance(system, AbstractDrivenSystem) and state.work is not None

        def rates(z: Coordinates, t: Moment) -> Quadratures | None:
            if force is None:
                return None
            work = None if t is None or not counts else system.power(self.configuration(z), t)
            return Quadratures(force(z, t), work)

        return rates

    def apply(self, system: Any, state: State, z: Coordinates, delta: Increments) -> State:
        """`state`, whose unknowns are z, after these increments."""
        before, done = self.unknowns(system, state), delta.quadratures  # z: but XLA rounds its sum with delta otherwise
        q = self.configuration(jax.tree.map(jnp.add, before, delta.z))
        p = state.p + jnp.stack(delta.z.p if done is None else done.momenta, axis=-1).reshape(state.p.shape)
        work = None if done is None else done.work
        work = state.work if work is None or state.work is None else state.work + work
        return state._replace(q=q, p=p, work=work)


class OneBody(CanonicalChart):
    """T*SO(3): q and p = 2πq of one body."""

    def supports(self, system: System) -> bool:
        space = system.phase_space
        return isinstance(space, CotangentGroup) and space.group is so3

    def unknowns(self, system: Any, state: State) -> Coordinates:
        q = _components(state.q)
        return Coordinates(q, _from_left(2 * vector(state.p), q))

    def configuration(self, z: Coordinates) -> Array:
        """The unit quaternion, (4,)."""
        return jnp.stack(_unit(z.q), axis=-1)

    def rate(self, system: Any) -> Callable[[Coordinates, Moment], Coordinates]:
        """½qΩ and ½pΩ, with the force of a potential."""
        inverse = vectors.inverse(system.metric if isinstance(system, AbstractMechanicalSystem) else system.inertia)
        rotor = system.rotor if isinstance(system, AbstractGyrostat) else None

        def field(z: Coordinates, t: Moment) -> Coordinates:
            q_dot, p_dot = _rotation_rates(rotor, inverse, z.q, z.p)
            if _is_forced(system):
                p_dot = tuple(map(jnp.add, p_dot, self._kick(system, z, t)))
            return Coordinates(q_dot, p_dot)

        return field

    def force(self, system: Any) -> Callable[[Coordinates, Moment], Vector]:
        """The torque in space."""

        def torque(z: Coordinates, t: Moment) -> Vector:
            if not _is_forced(system):
                return Vector((jnp.zeros_like(z.q[0]),) * 3)
            if _has_axis(system):
                axis, slope = _axis_and_gradient(system, z.q, t)
                return cross(axis, _times_conjugate(slope, z.q))
            q = self.configuration(z)
            at = (q,) if t is None or isinstance(system, AbstractForcedSystem) else (q, t)
            return vector(system.force(*at))

        return torque

    def _kick(self, system: Any, z: Coordinates, t: Moment) -> Components:
        """The contribution of a potential to ṗ: −∂V/∂q, 2γq∇Ṽ for V(q) = Ṽ(q̄γq), which is Ṽ(Γ) where |q| = 1."""
        if _has_axis(system):
            axis, slope = _axis_and_gradient(system, z.q, t)
            return _from_left(2 * axis, slope)
        return _from_left(2 * _inverse_square(z.q) * self.force(system)(z, t), z.q)


class ManyBodies(CanonicalChart):
    """Several bodies: positions and quaternions, linear momenta and p = 2πq."""

    def supports(self, system: System) -> bool:
        return isinstance(system.phase_space, CotangentMotions)

    def unknowns(self, system: Any, state: State) -> Coordinates:
        q, p = _components(state.q), _components(state.p)
        return Coordinates(q, (*p[:3], *_from_left(2 * Vector(p[3:]), q[3:])))

    def configuration(self, z: Coordinates) -> Array:
        """The positions and unit quaternions, (N, 7)."""
        return jnp.stack([*z.q[:3], *_unit(z.q[3:])], axis=-1)

    def rate(self, system: Any) -> Callable[[Coordinates, Moment], Coordinates]:
        """P/m, ½qΩ and ½pΩ, with the forces and torques."""
        inverse, masses = jax.vmap(vectors.inverse)(system.inertias), system.masses

        def field(z: Coordinates, _: Moment) -> Coordinates:
            P, q = z.p[:3], z.q[3:]
            q_dot, p_dot = _rotation_rates(None, inverse, q, z.p[3:])
            rates = (*(jnp.zeros_like(y) for y in P), *p_dot)
            if _is_forced(system):
                force, torque = _forces(system, Vector(z.q[:3]), _unit(q))
                kick = (*force, *quat_times_vec(q, 2 * _inverse_square(q) * torque))
                rates = tuple(map(jnp.add, rates, kick))
            return Coordinates((*(y / masses for y in P), *q_dot), rates)

        return field

    def force(self, system: Any) -> Callable[[Coordinates, Moment], Components]:
        """The forces on the bodies, and the torques in space."""

        def pull_and_torque(z: Coordinates, _: Moment) -> Components:
            if not _is_forced(system):
                return (jnp.zeros_like(z.q[0]),) * 6
            q = z.q[3:]
            force, torque = _forces(system, Vector(z.q[:3]), _unit(q))
            return (*force, *(_inverse_square(q) * _times_conjugate(quat_times_vec(q, torque), q)))

        return pull_and_torque


class Matrices(CanonicalChart):
    """T*GL⁺(3), which is flat: the entries of F and P."""

    def supports(self, system: System) -> bool:
        return isinstance(system.phase_space, CotangentMatrices)

    def unknowns(self, system: Any, state: State) -> Coordinates:
        return Coordinates(tuple(state.q.ravel()), tuple(state.p.ravel()))

    def configuration(self, z: Coordinates) -> Array:
        """F, (3, 3)."""
        return _matrix(z.q)

    def rate(self, system: Any) -> Callable[[Coordinates, Moment], Coordinates]:
        """The vector field."""
        return lambda z, _: self.unknowns(system, system.vector_field(State(_matrix(z.q), _matrix(z.p))))

    def force(self, system: Any) -> None:
        """None: P is a coordinate."""


_CHARTS = (OneBody(), ManyBodies(), Matrices())


def canonical_chart(system: System) -> CanonicalChart | None:
    """The canonical chart of a system; None if this module has none."""
    return next((chart for chart in _CHARTS if chart.supports(system)), None)


def _is_forced(system: Any) -> bool:
    return isinstance(system, AbstractForcedSystem | AbstractDrivenSystem)


def _forces(system: Any, x: Vector, q: Components) -> tuple[Vector, Vector]:
    """The forces on the bodies, and the torques in their axes. Quaternions are of unit length."""
    pull = tuple(jnp.moveaxis(system.force(jnp.stack([*x, *q], axis=-1)), -1, 0))
    return Vector(pull[:3]), Matrix(so3.matrix_of(*q)).T @ Vector(pull[3:])


def _matrix(components: Components) -> Array:
    return jnp.stack(components).reshape(3, 3)


def _unit(q: Components) -> Components:
    r = jnp.sqrt(_inverse_square(q))
    w, x, y, z = q
    return r * w, r * x, r * y, r * z


def _rotation_rates(rotor: Array | None, inverse: Symmetric, q: Components, p: Components) -> tuple[Any, Any]:
    """½qΩ and ½pΩ, with Ω of the momentum Π = ½ Im(q̄p)."""
    (w, v), (first, rest) = scalar_and_vector(q), scalar_and_vector(p)
    Pi = 0.5 * (w * rest - first * v - cross(v, rest))
    half = 0.5 * (inverse @ (Pi if rotor is None else Pi - rotor))
    return quat_times_vec(q, half), quat_times_vec(p, half)


def _has_axis(system: Any) -> bool:
    return isinstance(system, AbstractTop | AbstractDrivenTop) and system.axis is not None


def _axis_and_gradient(system: Any, q: Components, t: Any) -> tuple[Vector, Components]:
    """γ and q∇Ṽ."""
    axis, at = (system.axis_at(t), (t,)) if isinstance(system, AbstractDrivenTop) else (system.axis, ())
    return Vector(axis), quat_times_vec(q, vector(gradient(system.potential, jnp.stack(axis_in_body(q, axis)), *at)))


def _times_conjugate(x: Components, q: Components) -> Vector:
    """Im(x q̄)."""
    (w, v), (a, b) = scalar_and_vector(q), scalar_and_vector(x)
    return w * b - a * v + cross(v, b)


def _components(x: Array) -> Components:
    """The components along the last axis."""
    return tuple(x[..., i] for i in range(x.shape[-1]))


def _inverse_square(q: Components) -> Array:
    """1/|q|²."""
    w, v = scalar_and_vector(q)
    return 1 / (w * w + dot(v, v))


def _from_left(u: Vector, q: Components) -> Components:
    """(0, u)q."""
    w, v = scalar_and_vector(q)
    return (-dot(u, v), *(w * u + cross(u, v)))
