"""The motion of one body in its own axes: q̇ = ½ q Ω, Π̇ = Π × Ω + Γ × ∇Ṽ(Γ), component by component.

Explicit schemes of high order use these unknowns: they need half the operations of (q, π), and at equal steps have a
fiftieth of the error on tops. For a top with a fixed axis, q is the attitude in a frame where the axis is ±e₃, which
needs a third of the operations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.capabilities import AbstractDrivenTop, AbstractFreeBody, AbstractGyrostat, AbstractTop
from lieint_jax.groups import so3
from lieint_jax.schemes.charts._chart import Chart
from lieint_jax.types import State, System, clock, gradient, vectors
from lieint_jax.types.shapes import PyTree
from lieint_jax.types.vectors import Symmetric, Vector, VectorLike, cross, dot, norm, vector

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


def body_axes_state(state: State) -> BodyAxesState:
    """The unknowns of a body whose q is its attitude."""
    Pi = so3.Ad_star(state.q, state.p)
    return BodyAxesState(vectors.components(state.q), vector(Pi), state.work)


def advance_body(state: State, z: BodyAxesState, delta: BodyAxesState) -> State:
    """The state whose unknowns are z, after their increments. π gets its own increment, for the last digits."""
    dq = _to_unit(z.q, delta.q)
    (w, u), (dw, du) = scalar_and_vector(z.q), scalar_and_vector(dq)
    Pi = z.Pi + delta.Pi
    end, part = cross(u + du, Pi), cross(du, Pi)
    half = (dw * end + w * part) + (cross(du, end) + cross(u, part))
    p = state.p + jnp.stack(so3.Ad(state.q, jnp.stack(delta.Pi)) + 2 * half)  # the rotation by q + dq less that by q
    work = None if state.work is None or delta.work is None else state.work + delta.work
    return state._replace(q=state.q + jnp.stack(dq), p=p, work=work)


def _to_unit(q: tuple[Array, ...], dq: tuple[Array, ...]) -> tuple[Array, ...]:
    """The increments of q to (q + dq) / |q + dq|."""
    r = _length_correction(q, dq)
    return tuple(d + r * (x + d) for x, d in zip(q, dq, strict=True))


def _length_correction(q: tuple[Array, ...], dq: tuple[Array, ...]) -> Array:
    """1 / |q + dq| − 1."""
    excess = so3.defect(jnp.stack(q)) + sum(d * (2 * x + d) for x, d in zip(q, dq, strict=True))
    s = jnp.sqrt(1 + excess)
    return -excess / (s * (1 + s))


def free_rates(
    inverse: Symmetric, rotor: Array | None, q: tuple[Array, ...], Pi: Vector
) -> tuple[tuple[Array, ...], Vector]:
    """q̇ and Π̇ without a torque."""
    J_Omega = Pi if rotor is None else Pi - rotor
    Pi_dot = gyroscopic(inverse, Pi) if rotor is None else cross(Pi, inverse @ J_Omega)
    return quat_times_vec(q, (inverse / 2) @ J_Omega), Pi_dot


def gyroscopic(inverse: Symmetric, Pi: Vector) -> Vector:
    """Π × J⁻¹Π."""
    if len(inverse) > 3:
        return cross(Pi, inverse @ Pi)
    (x, y, z), a, b, c = Pi, *inverse[:3]
    return Vector(((c - b) * (y * z), (a - c) * (z * x), (b - a) * (x * y)))


def axis_frame(axis: Any) -> tuple[Array, Array]:
    """A rotation that maps γ to ±|γ| e₃, and ±|γ|."""
    sign, size = jnp.where(axis[2] < 0, -1, 1), norm(axis)
    g = jnp.stack([size + sign * axis[2], sign * axis[1], -sign * axis[0], jnp.zeros_like(size)])
    return so3.normalize(g), sign * size


def to_axis_frame(axis: Any, q: tuple[Array, ...]) -> tuple[Array, ...]:
    """A quaternion in the frame where an axis is ±e₃."""
    return vectors.components(so3.multiply(axis_frame(axis)[0], jnp.stack(q)))


def from_axis_frame(axis: Any, q: tuple[Array, ...]) -> tuple[Array, ...]:
    """A quaternion of the frame where an axis is ±e₃, in space."""
    return vectors.components(so3.multiply(so3.inverse(axis_frame(axis)[0]), jnp.stack(q)))


def _in_space(system: System, delta: BodyAxesState) -> BodyAxesState:
    """Increments of the unknowns, with those of q converted to increments of the attitude."""
    return delta._replace(q=from_axis_frame(system.axis, delta.q)) if isinstance(system, AbstractTop) else delta


def _power(system: OneBody, z: PyTree, moment: PyTree) -> Array:
    if not isinstance(system, AbstractDrivenTop):
        return jnp.zeros_like(z.work)
    return system.power(so3.normalize(jnp.stack(z.q)), moment.t)


def _torque(system: OneBody) -> Callable[[BodyAxesState, PyTree], Vector] | None:
    """(z, moment) ↦ Γ × ∇Ṽ(Γ), with Γ = Λᵀγ."""
    if isinstance(system, AbstractDrivenTop):
        return lambda z, now: _by_potential(system.potential, _axis_in_body(z.q, now.axis), now.t)
    if isinstance(system, AbstractTop):
        height = axis_frame(system.axis)[1]
        return lambda z, _: _by_potential(system.potential, _third_axis(2 * height, z.q))
    return None


def _by_potential(potential: Callable[..., Array], Gamma: Vector, *t: Array) -> Vector:
    return cross(Gamma, gradient(potential, jnp.stack(Gamma), *t))


def scalar_and_vector(q: tuple[Array, ...]) -> tuple[Array, Vector]:
    """The two parts of a quaternion."""
    return q[0], Vector(q[1:])


def axis_in_body(q: tuple[Array, ...], axis: VectorLike) -> Vector:
    """|q|² Λᵀγ, the axis γ in the body: Im(q̄γq)."""
    (w, v), axis = scalar_and_vector(q), Vector(axis)
    return (w * w - dot(v, v)) * axis + (2 * dot(v, axis) * v + 2 * w * cross(axis, v))


def _axis_in_body(q: tuple[Array, ...], axis: VectorLike) -> Vector:
    """Λᵀγ for |q| = 1, in fewer operations than `axis_in_body`."""
    w, v = scalar_and_vector(q)
    u = 2 * cross(axis, v)
    return axis + (w * u - cross(v, u))


def _third_axis(twice: Array, q: tuple[Array, ...]) -> Vector:
    """`_axis_in_body` of ½ twice e₃, in a third of its operations."""
    w, x, y, z = q
    return twice * Vector((x * z - w * y, y * z + w * x, 0.5 - (x * x + y * y)))


def quat_times_vec(q: tuple[Array, ...], u: Vector) -> tuple[Array, ...]:
    """q(0, u)."""
    w, v = scalar_and_vector(q)
    return (-dot(v, u), *(w * u + cross(v, u)))


class BodyAxes(Chart[OneBody, BodyAxesState]):
    """One body with at most a potential that has an axis, in its own axes."""

    def supports(self, system: System) -> bool:
        """Whether a system is one body with at most a potential that has an axis, with its equations of motion."""
        if isinstance(system, AbstractTop | AbstractDrivenTop) and system.axis is None:
            return False
        kinds = AbstractTop, AbstractDrivenTop, AbstractFreeBody, AbstractGyrostat
        return any(kind.governs(system) for kind in kinds)

    def unknowns(self, system: OneBody, state: State) -> BodyAxesState:
        """The unknowns of a step from this state."""
        z = body_axes_state(state)
        return z._replace(q=to_axis_frame(system.axis, z.q)) if isinstance(system, AbstractTop) else z

    def apply(self, system: OneBody, state: State, z: BodyAxesState, delta: BodyAxesState) -> State:
        """The state whose unknowns are z, after their increments."""
        return advance_body(state, z._replace(q=vectors.components(state.q)), _in_space(system, delta))

    def split_qp(self, z: BodyAxesState) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """The unknowns of the configuration and those of the momenta."""
        return z.q, z.Pi

    def stage_times(self, system: OneBody, state: State, passed: Array) -> Moment | None:
        """The times, (n,), after `state` for a driven top, and its axis at them, in one call."""
        if not isinstance(system, AbstractDrivenTop):
            return None
        t = clock(state) + passed
        return Moment(t, jax.vmap(system.axis_at)(t))

    def rate(self, system: OneBody) -> Callable[[BodyAxesState, PyTree], BodyAxesState]:
        """The time derivative of the unknowns at a moment, for |q| = 1 up to the error of a step."""
        inverse, rotor = vectors.inverse(system.inertia), system.rotor if isinstance(system, AbstractGyrostat) else None
        torque = _torque(system)

        def field(z: BodyAxesState, moment: PyTree) -> BodyAxesState:
            q_dot, Pi_dot = free_rates(inverse, rotor, z.q, z.Pi)
            Pi_dot = Pi_dot + torque(z, moment) if torque else Pi_dot
            return BodyAxesState(q_dot, Pi_dot, None if z.work is None else _power(system, z, moment))

        return field


BODY_AXES = BodyAxes()
