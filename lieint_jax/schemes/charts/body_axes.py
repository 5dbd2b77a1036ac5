"""The motion of one body in its own axes: q̇ = ½ q Ω, Π̇ = Π × Ω + Γ × ∇Ṽ(Γ), component by component.

Explicit schemes of high order use these unknowns: they need half the operations of (q, π), and at equal steps have a
fiftieth of the error on tops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import PyTree
from lieint_jax._numerics.vectors import Symmetric, Vector, VectorLike, cross, dot, vector
from lieint_jax.core import State, System, clock, gradient
from lieint_jax.groups import so3
from lieint_jax.schemes.charts._chart import Chart
from lieint_jax.systems._equations import AbstractDrivenTop, AbstractFreeBody, AbstractGyrostat, AbstractTop

OneBody = AbstractFreeBody | AbstractGyrostat | AbstractTop | AbstractDrivenTop


class BodyAxesState(NamedTuple):
    """The unknowns: a quaternion, body momentum, and the work of a state that has it."""

    q: tuple[Array, ...]
    Pi: Vector
    work: Array | None


class Moment(NamedTuple):
    """A time, and the axis of a driven top then."""

    t: Array
    axis: Array


def _to_unit(q: tuple[Array, ...], dq: tuple[Array, ...]) -> tuple[Array, ...]:
    """The increments of q to (q + dq) / |q + dq|."""
    excess = so3.defect(jnp.stack(q)) + sum(d * (2 * x + d) for x, d in zip(q, dq, strict=True))
    s = jnp.sqrt(1 + excess)
    r = -excess / (s * (1 + s))  # 1 / |q + dq| − 1
    return tuple(d + r * (x + d) for x, d in zip(q, dq, strict=True))


def gyroscopic(inverse: Symmetric, Pi: Vector) -> Vector:
    """Π × J⁻¹Π."""
    if len(inverse) > 3:
        return cross(Pi, inverse @ Pi)
    (x, y, z), a, b, c = Pi, *inverse[:3]
    return Vector(((c - b) * (y * z), (a - c) * (z * x), (b - a) * (x * y)))


def _torque(system: OneBody) -> Callable[[BodyAxesState, PyTree], Vector] | None:
    """(z, moment) ↦ Γ × ∇Ṽ(Γ), with Γ = Λᵀγ."""

    def by_potential(z: BodyAxesState, axis: VectorLike, *t: Array) -> Vector:
        Gamma = axis_in_body(z.q, axis)
        return cross(Gamma, gradient(system.potential, jnp.stack(Gamma), *t))  # pyright: ignore

    if isinstance(system, AbstractDrivenTop):
        return lambda z, now: by_potential(z, now.axis, now.t)
    return (lambda z, _: by_potential(z, system.axis)) if isinstance(system, AbstractTop) else None


def scalar_and_vector(q: tuple[Array, ...]) -> tuple[Array, Vector]:
    """The two parts of a quaternion."""
    return q[0], Vector(q[1:])


def axis_in_body(q: tuple[Array, ...], axis: VectorLike) -> Vector:
    """|q|² Λᵀγ, the axis γ in the body: Im(q̄γq)."""
    (w, v), axis = scalar_and_vector(q), Vector(axis)
    return (w * w - dot(v, v)) * axis + (2 * dot(v, axis) * v + 2 * w * cross(axis, v))


def quat_times_vec(q: tuple[Array, ...], u: Vector) -> tuple[Array, ...]:
    """q(0, u)."""
    w, v = scalar_and_vector(q)
    return (-dot(v, u), *(w * u + cross(v, u)))


class BodyAxes(Chart[OneBody, BodyAxesState]):
    """One body with at most a potential that has an axis, in its own axes."""

    def supports(self, system: System) -> bool:
        if isinstance(system, AbstractTop | AbstractDrivenTop) and system.axis is None:
            return False
        kinds = AbstractTop, AbstractDrivenTop, AbstractFreeBody, AbstractGyrostat
        return any(kind.governs(system) for kind in kinds)

    def unknowns(self, system: OneBody, state: State) -> BodyAxesState:
        return BodyAxesState(vectors.components(state.q), vector(so3.Ad_star(state.q, state.p)), state.work)

    def apply(self, system: OneBody, state: State, z: BodyAxesState, delta: BodyAxesState) -> State:
        """π gets its own increment, for the last digits."""
        dq = _to_unit(z.q, delta.q)
        (w, u), (dw, du) = scalar_and_vector(z.q), scalar_and_vector(dq)
        Pi = z.Pi + delta.Pi
        end, part = cross(u + du, Pi), cross(du, Pi)
        half = (dw * end + w * part) + (cross(du, end) + cross(u, part))
        # twice the half is the rotation by q + dq less that by q
        p = state.p + jnp.stack(so3.Ad(state.q, jnp.stack(delta.Pi)) + 2 * half)
        work = None if state.work is None or delta.work is None else state.work + delta.work
        return state._replace(q=state.q + jnp.stack(dq), p=p, work=work)

    def split_qp(self, z: BodyAxesState) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        return z.q, z.Pi

    def stage_times(self, system: OneBody, state: State, passed: Array) -> Moment | None:
        """The times, (n,), after `state` for a driven top, and its axis at them, in one call."""
        if not isinstance(system, AbstractDrivenTop):
            return None
        t = clock(state) + passed
        return Moment(t, jax.vmap(system.axis_at)(t))

    def rate(self, system: OneBody) -> Callable[[BodyAxesState, PyTree], BodyAxesState]:
        """½qΩ and Π × Ω + Γ × ∇Ṽ(Γ), for |q| = 1 up to the error of a step."""
        inverse, rotor = vectors.inverse(system.inertia), system.rotor if isinstance(system, AbstractGyrostat) else None
        torque = _torque(system)

        def field(z: BodyAxesState, moment: PyTree) -> BodyAxesState:
            J_Omega = z.Pi if rotor is None else z.Pi - rotor
            Pi_dot = gyroscopic(inverse, z.Pi) if rotor is None else cross(z.Pi, inverse @ J_Omega)
            Pi_dot = Pi_dot + torque(z, moment) if torque else Pi_dot
            work = None if z.work is None else jnp.zeros_like(z.work)
            if work is not None and isinstance(system, AbstractDrivenTop):
                work = system.power(so3.normalize(jnp.stack(z.q)), moment.t)
            return BodyAxesState(quat_times_vec(z.q, (inverse / 2) @ J_Omega), Pi_dot, work)

        return field


BODY_AXES = BodyAxes()
