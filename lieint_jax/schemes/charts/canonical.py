"""Canonical coordinates of phase spaces, in flat space: those in which Runge–Kutta methods of Gauss are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It keeps |q|² and q·p, and π = ½ Im(p q̄) as far as the
torque does: all quadratic. A potential Ṽ(Γ) of an axis γ is better taken off the sphere as Ṽ(q̄γq), without |q|: its
part of ṗ is then 2γq∇Ṽ. That moves q·p, which changes nothing else, and is dropped after each step.

T*GL⁺(3) is flat as it is.

Coordinates are a tuple of components: those of q, then those of p. Of several bodies these are positions and
quaternions, then linear momenta and p, each with an axis of bodies, (N,).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vec3
from lieint_jax._numerics.vec3 import add, apply, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, CotangentMatrices, CotangentMotions
from lieint_jax.schemes.charts import several_bodies
from lieint_jax.schemes.charts.body_axes import axis_in_body, quat_times_vec, turned_back, turned_up, upright
from lieint_jax.types import (
    AbstractDrivenSystem,
    AbstractDrivenTop,
    AbstractElasticBody,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractGyrostat,
    AbstractMechanicalSystem,
    AbstractRigidBodies,
    AbstractTop,
    PhaseSpace,
    State,
    gradient,
)

Components = tuple[Array, ...]
_Quaternion = tuple[Array, Array, Array, Array]


class Parts(NamedTuple):
    """The coordinates of one body, or of many with an axis of bodies; x and P are empty in a system of one body."""

    x: Components
    q: Components
    P: Components
    p: Components


def supports(space: PhaseSpace) -> bool:
    """Whether a phase space has such coordinates here: T*SO(3), that of several bodies, T*GL⁺(3)."""
    if isinstance(space, CotangentGroup):
        return space.group is so3
    return isinstance(space, CotangentMotions | CotangentMatrices)


def canonical(system: Any, state: State) -> Components:
    """The coordinates of a state; of a top whose axis stays, in a frame where that is ±e₃."""
    if state.q.shape == (3, 3):
        return tuple(state.q.ravel()) + tuple(state.p.ravel())
    q, p = _components(state.q), _components(state.p)
    p = (*p[:-3], *_from_left(scale(2, p[-3:]), q[-4:]))
    return (*turned_up(system.axis, q), *turned_up(system.axis, p)) if _stands(system) else (*q, *p)


def parts(z: Components) -> Parts:
    """The parts of coordinates."""
    if len(z) == 8:
        return Parts((), z[:4], (), z[4:])
    return Parts(z[:3], z[3:7], z[7:10], z[10:])


def momentum(z: Components) -> Components:
    """π = ½ Im(p q̄) of coordinates, of several bodies after the linear momenta."""
    _, (w, *v), P, (p0, *p) = parts(z)
    return (*P, *scale(0.5, add(subtract(scale(w, p), scale(p0, v)), cross(v, p))))


def configuration(z: Components) -> Array:
    """The configuration, with quaternions of unit length: (4,), (N, 7), or (3, 3)."""
    if len(z) == 18:
        return jnp.stack(z[:9]).reshape(3, 3)
    x, q, *_ = parts(z)
    return jnp.stack([*x, *_unit(q)], axis=-1)


def _unit(q: Components) -> _Quaternion:
    r = jnp.sqrt(_inverse_square(q))
    w, x, y, z = q
    return r * w, r * x, r * y, r * z


def inverses(system: Any) -> Any:
    """The inverse of each inertia, computed once for a step."""
    if isinstance(system, AbstractElasticBody):
        return None
    if isinstance(system, AbstractFreeBodies | AbstractRigidBodies):
        return several_bodies.inverses(system)
    return vec3.inverse(system.metric if isinstance(system, AbstractMechanicalSystem) else system.inertia)


def field(system: Any, inverse: Any, z: Components, t: Array | None) -> Components:
    """The time derivative of the coordinates, with the `inverses` of a system."""
    if isinstance(system, AbstractElasticBody):
        F, P = (jnp.stack(x).reshape(3, 3) for x in (z[:9], z[9:]))
        rate = system.vector_field(State(F, P))
        return (*rate.q.ravel(), *rate.p.ravel())
    _, q, P, p = parts(z)
    q_dot, p_dot = _turning(system.rotor if isinstance(system, AbstractGyrostat) else None, inverse, q, p)
    first = (*(y / system.masses for y in P), *q_dot)  # pyright: ignore[reportAttributeAccessIssue]
    second = (*(jnp.zeros_like(y) for y in P), *p_dot)
    if isinstance(system, AbstractForcedSystem | AbstractDrivenSystem):
        second = tuple(map(jnp.add, second, _kick(system, z, t)))
    return (*first, *second)


def force(system: Any, _: Any, z: Components, t: Array | None) -> Components:
    """The components of π̇, or of (ṗ, π̇) of several bodies."""
    body = parts(z)
    if not isinstance(system, AbstractForcedSystem | AbstractDrivenSystem):
        return (jnp.zeros_like(z[0]),) * (3 + len(body.P))
    if isinstance(system, AbstractRigidBodies):
        pull = several_bodies.forces(system, body.x, _unit(body.q))
        return (*pull[:3], *_rotate(body.q, pull[3:]))
    if _has_axis(system):
        return _torque(system, body.q, t)
    q = configuration(z)
    at = (q,) if t is None or isinstance(system, AbstractForcedSystem) else (q, t)
    return _components(system.force(*at))


def power(system: AbstractDrivenSystem, _: Any, z: Components, t: Array) -> Components:
    """The power of a driven system, as one component."""
    return (system.power(configuration(z), t),)


def ended(system: Any, state: State, moves: Components, impulse: Components, work: Array | None) -> State:
    """`state` after these increments of its coordinates, of its momenta, and of the work."""
    moves, impulse = _in_space(system, moves, impulse)
    q = configuration(tuple(map(jnp.add, canonical(None, state), moves)))
    end = state._replace(q=q, p=state.p + jnp.stack(impulse, axis=-1).reshape(state.p.shape))
    return end if work is None or state.work is None else end._replace(work=state.work + work)


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the coordinates, and from the force."""
    z = canonical(system, state)
    rates = field(system, inverses(system), z, state.t)
    p_dot = rates[9:] if isinstance(system, AbstractElasticBody) else force(system, None, z, state.t)
    rates, p_dot = _in_space(system, rates, p_dot)
    _, q_dot = jax.jvp(configuration, (canonical(None, state),), (rates,))
    return State(q_dot, jnp.stack(p_dot, axis=-1).reshape(state.p.shape))


def _in_space(system: Any, rates: Components, force: Components) -> tuple[Components, Components]:
    """Changes of the coordinates, and those of the momenta, as if no axis stood."""
    if not _stands(system):
        return rates, force
    q, p = (turned_back(system.axis, half) for half in (rates[:4], rates[4:]))
    return (*q, *p), _components(so3.Ad_star(upright(system.axis)[0], jnp.stack(force)))


def _turning(rotor: Array | None, inverse: vec3.Symmetric, q: Components, p: Components) -> tuple[Any, Any]:
    """½qΩ and ½pΩ."""
    half = _half_rate(rotor, inverse, q, p)
    return quat_times_vec(q, half), quat_times_vec(p, half)


def _half_rate(rotor: Array | None, inverse: vec3.Symmetric, q: Components, p: Components) -> Components:
    """½Ω, of the momentum Π = ½ Im(q̄p)."""
    (w, *v), (first, *rest) = q, p
    Pi = scale(0.5, subtract(subtract(scale(w, rest), scale(first, v)), cross(v, rest)))
    return scale(0.5, apply(inverse, Pi if rotor is None else subtract(Pi, rotor)))


def _kick(system: Any, z: Components, t: Array | None) -> Components:
    """What the potential adds to the rate of the second half: the force, and −∂V/∂q."""
    x, q, *_ = parts(z)
    if _stands(system):
        return _kick_upright(system.potential, upright(system.axis)[1], q)
    if _has_axis(system):
        return _kick_about(system.potential, system.axis_at(t), q, t)
    if isinstance(system, AbstractRigidBodies):
        pull = several_bodies.forces(system, x, _unit(q))
        return (*pull[:3], *quat_times_vec(q, scale(2 * _inverse_square(q), pull[3:])))
    return _from_left(scale(2 * _inverse_square(q), force(system, None, z, t)), q)


def _rotate(q: Components, u: Components) -> Components:
    """q(0, u)q̄/|q|²."""
    return scale(_inverse_square(q), _times_conjugate(quat_times_vec(q, u), q))


def _has_axis(system: Any) -> bool:
    return isinstance(system, AbstractTop | AbstractDrivenTop) and system.axis is not None


def _stands(system: Any) -> bool:
    """Whether the coordinates are those in a frame where an axis is ±e₃."""
    return isinstance(system, AbstractTop) and system.axis is not None


def _kick_upright(potential: Any, height: Array, q: Components) -> Components:
    """−∂V/∂q of V(q) = Ṽ(q̄γq), which is Ṽ(Γ) where |q| = 1: 2γq∇Ṽ, with γ = height e₃."""
    a, b, c, d = (2 * height * x for x in _by_slope(potential, _seen_upright(height, q), q))
    return -d, -c, b, a


def _kick_about(potential: Any, axis: Array, q: Components, t: Any) -> Components:
    """2γq∇Ṽ for any axis γ."""
    return _from_left(scale(2, axis), _by_slope(potential, axis_in_body(q, axis), q, t))


def _torque(system: Any, q: Components, t: Any) -> Components:
    if _stands(system):
        return _torque_upright(system.potential, upright(system.axis)[1], q)
    return _torque_about(system.potential, system.axis_at(t), q, t)


def _torque_upright(potential: Any, height: Array, q: Components) -> Components:
    """The torque in space, γ × q∇Ṽq̄."""
    x, y, _ = _times_conjugate(_by_slope(potential, _seen_upright(height, q), q), q)
    return -height * y, height * x, jnp.zeros_like(x)


def _torque_about(potential: Any, axis: Array, q: Components, t: Array) -> Components:
    return cross(axis, _times_conjugate(_by_slope(potential, axis_in_body(q, axis), q, t), q))


def _seen_upright(height: Array, q: Components) -> Components:
    """`seen` of height e₃."""
    w, x, y, z = q
    return scale(height, (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z))


def _by_slope(potential: Any, Gamma: Components, q: Components, *t: Array) -> _Quaternion:
    """q∇Ṽ."""
    return quat_times_vec(q, _components(gradient(potential, jnp.stack(Gamma), *t)))


def _times_conjugate(x: _Quaternion, q: Components) -> vec3.Vector:
    """Im(x q̄)."""
    (w, *v), (a, *b) = q, x
    return add(subtract(scale(w, b), scale(a, v)), cross(v, b))


def _components(x: Array) -> Components:
    """The components along the last axis."""
    return tuple(x[..., i] for i in range(x.shape[-1]))


def _inverse_square(q: Components) -> Array:
    """1/|q|²."""
    w, *v = q
    return 1 / (w * w + dot(v, v))


def _from_left(u: Components, q: Components) -> _Quaternion:
    """(0, u)q."""
    w, *v = q
    return (-dot(u, v), *add(scale(w, u), cross(u, v)))
