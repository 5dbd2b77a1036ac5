"""Canonical coordinates of phase spaces, in flat space: those in which Runge–Kutta methods of Gauss are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It keeps |q|² and q·p, and π = ½ Im(p q̄) as far as the
torque does: all quadratic. A potential Ṽ(Γ) of an axis γ is better taken off the sphere as Ṽ(q̄γq), without |q|: its
part of ṗ is then 2γq∇Ṽ. That moves q·p, which changes nothing else, and is dropped after each step.

T*GL⁺(3) is flat as it is.

Coordinates are a tuple of components: those of q, then those of p. Of several bodies these are positions and
quaternions, then linear momenta and p, each with an axis of bodies, (N,); or one body after the other, as
`_several_bodies` says.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import kernel, three
from lieint_jax._numerics.three import add, apply, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, CotangentMatrices, CotangentMotions
from lieint_jax.schemes import _several_bodies
from lieint_jax.schemes._body_axes import by, seen, turned_back, turned_up, upright
from lieint_jax.schemes._several_bodies import apart
from lieint_jax.schemes._stages import Components
from lieint_jax.types import (
    Bodies,
    Driven,
    DrivenTop,
    ElasticBody,
    Forced,
    FreeBodies,
    Gyrostat,
    MechanicalSystem,
    PhaseSpace,
    State,
    Top,
    gradient,
)

_Quaternion = tuple[Array, Array, Array, Array]


class Parts(NamedTuple):
    """The coordinates of one body, or of many with an axis of bodies; x and P are empty in a system of one body."""

    x: Components
    q: Components
    P: Components
    p: Components


def known(space: PhaseSpace) -> bool:
    """Whether a phase space has such coordinates here: T*SO(3), that of several bodies, T*GL⁺(3)."""
    if isinstance(space, CotangentGroup):
        return space.group is so3
    return isinstance(space, CotangentMotions | CotangentMatrices)


@kernel.stage
def canonical(system: Any, state: State) -> Components:
    """The coordinates of a state; of a top whose axis stays, in a frame where that is ±e₃."""
    if state.q.shape == (3, 3):
        return tuple(state.q.ravel()) + tuple(state.p.ravel())
    if state.q.ndim == 2 and apart(len(state.q)):
        bodies = zip(map(_components, state.q), map(_components, state.p), strict=True)
        return _all_halves([_coordinates(q, p) for q, p in bodies])
    q, p = _coordinates(_components(state.q), _components(state.p))
    return (*turned_up(system.axis, q), *turned_up(system.axis, p)) if _stands(system) else _all_halves([(q, p)])


def _coordinates(q: Components, p: Components) -> tuple[Components, Components]:
    """Of q and p, those of a body or of many: each of both halves."""
    return q, (*p[:-3], *_from_left(scale(2, p[-3:]), q[-4:]))


def _all_halves(bodies: Sequence[tuple[Components, Components]]) -> Components:
    """The first half of each body, then the second of each."""
    return tuple(x for half in zip(*bodies, strict=True) for x in itertools.chain(*half))


def parts(z: Components) -> list[Parts]:
    """The coordinates of each body, or of many together."""
    half = len(z) // 2
    if half == 4:
        return [Parts((), z[:4], (), z[4:])]
    starts = range(0, half, 7)
    return [
        Parts(z[n : n + 3], z[n + 3 : n + 7], z[half + n : half + n + 3], z[half + n + 3 : half + n + 7])
        for n in starts
    ]


def momentum(z: Components) -> Components:
    """π = ½ Im(p q̄) of coordinates, of several bodies after the linear momenta."""
    return tuple(itertools.chain(*map(_momenta, parts(z))))


def _momenta(body: Parts) -> Components:
    (w, *v), (p0, *p) = body.q, body.p
    return (*body.P, *scale(0.5, add(subtract(scale(w, p), scale(p0, v)), cross(v, p))))


def configuration(z: Components) -> Array:
    """The configuration, with quaternions of unit length: (4,), (N, 7), or (3, 3)."""
    if len(z) == 18:
        return jnp.stack(z[:9]).reshape(3, 3)
    bodies = [jnp.stack([*x, *_unit(q)], axis=-1) for x, q, *_ in parts(z)]
    return bodies[0] if len(z) == 8 else _several_bodies.together(bodies)


@kernel.stage
def _unit(q: Components) -> _Quaternion:
    r = jnp.sqrt(_inverse_square(q))
    w, x, y, z = q
    return r * w, r * x, r * y, r * z


def inverses(system: Any) -> Any:
    """The inverse of each inertia, computed once for a step."""
    if isinstance(system, ElasticBody):
        return None
    if isinstance(system, FreeBodies | Bodies):
        return _several_bodies.inverses(system)
    return [three.inverse(system.metric if isinstance(system, MechanicalSystem) else system.inertia)]


def field(system: Any, inverse: Any, z: Components, t: Array | None) -> Components:
    """The time derivative of the coordinates, with the `inverses` of a system."""
    if isinstance(system, ElasticBody):
        F, P = (jnp.stack(x).reshape(3, 3) for x in (z[:9], z[9:]))
        rate = system.vector_field(State(F, P))
        return (*rate.q.ravel(), *rate.p.ravel())
    bodies = parts(z)
    masses = _several_bodies.masses(system) if isinstance(system, FreeBodies | Bodies) else [None]
    rates = [
        _rate(system.rotor if isinstance(system, Gyrostat) else None, J, m, body)
        for J, m, body in zip(inverse, masses, bodies, strict=True)
    ]
    return _all_halves(_kicked(system, bodies, rates, z, t) if isinstance(system, Forced | Driven) else rates)


@kernel.stage
def force(system: Any, _: Any, z: Components, t: Array | None) -> Components:
    """The components of π̇, or of (ṗ, π̇) of several bodies."""
    bodies = parts(z)
    if not isinstance(system, Forced | Driven):
        return (jnp.zeros_like(z[0]),) * (3 + len(bodies[0].P)) * len(bodies)
    if isinstance(system, Bodies):
        rows = _forces(system, bodies)
        return tuple(x for row, body in zip(rows, bodies, strict=True) for x in (*row[:3], *_turned(body.q, row[3:])))
    if _has_axis(system):
        return _torque(system, bodies[0].q, t)
    q = configuration(z)
    at = (q,) if t is None or isinstance(system, Forced) else (q, t)
    return _components(system.force(*at))


@kernel.stage
def power(system: Driven, _: Any, z: Components, t: Array) -> Components:
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
    p_dot = rates[9:] if isinstance(system, ElasticBody) else force(system, None, z, state.t)
    rates, p_dot = _in_space(system, rates, p_dot)
    _, q_dot = jax.jvp(configuration, (canonical(None, state),), (rates,))
    return State(q_dot, jnp.stack(p_dot, axis=-1).reshape(state.p.shape))


def _in_space(system: Any, rates: Components, force: Components) -> tuple[Components, Components]:
    """Changes of the coordinates, and those of the momenta, as if no axis stood."""
    if not _stands(system):
        return rates, force
    q, p = (turned_back(system.axis, half) for half in (rates[:4], rates[4:]))
    return (*q, *p), _components(so3.Ad_star(upright(system.axis)[0], jnp.stack(force)))


def _rate(rotor: Array | None, inverse: Any, mass: Any, body: Parts) -> tuple[Components, Components]:
    """The derivatives of both halves of a body's coordinates, without a potential."""
    q_dot, p_dot = _turning(rotor, inverse, body.q, body.p)
    velocity, zeros = tuple(y / mass for y in body.P), (jnp.zeros_like(y) for y in body.P)
    return (*velocity, *q_dot), (*zeros, *p_dot)


@kernel.together
def _turning(rotor: Array | None, inverse: three.Symmetric, q: Components, p: Components) -> tuple[Any, Any]:
    """½qΩ and ½pΩ."""
    half = _half_rate(rotor, inverse, q, p)
    return by(q, half), by(p, half)


@kernel.stage
def _half_rate(rotor: Array | None, inverse: three.Symmetric, q: Components, p: Components) -> Components:
    """½Ω, of the momentum Π = ½ Im(q̄p)."""
    (w, *v), (first, *rest) = q, p
    Pi = scale(0.5, subtract(subtract(scale(w, rest), scale(first, v)), cross(v, rest)))
    return scale(0.5, apply(inverse, Pi if rotor is None else subtract(Pi, rotor)))


def _kicked(
    system: Any, bodies: list[Parts], rates: list[tuple[Components, Components]], z: Components, t: Array | None
) -> list[tuple[Components, Components]]:
    """The rates with what the potential adds to their second half: the force, and −∂V/∂q."""
    if _has_axis(system):
        [(q_dot, p_dot)], q = rates, bodies[0].q
        if _stands(system):
            return [(q_dot, _kicked_upright(system.potential, upright(system.axis)[1], q, p_dot))]
        return [(q_dot, _kicked_about(system.potential, system.axis_at(t), q, p_dot, t))]
    if isinstance(system, Bodies):
        kicks = [(*row[:3], *_kick(body.q, row[3:])) for row, body in zip(_forces(system, bodies), bodies, strict=True)]
    else:
        q = bodies[0].q
        kicks = [_from_left(scale(2 * _inverse_square(q), force(system, None, z, t)), q)]
    return [(q, tuple(map(jnp.add, p, kick))) for (q, p), kick in zip(rates, kicks, strict=True)]


def _forces(system: Bodies, bodies: list[Parts]) -> Any:
    """The force on each body, and the torque in its axes."""
    return _several_bodies.forces(system, [body.x for body in bodies], [_unit(body.q) for body in bodies])


@kernel.together
def _kick(q: Components, torque: Components) -> Components:
    """A torque in the body as 2qτ/|q|²."""
    return by(q, scale(2 * _inverse_square(q), torque))


@kernel.together
def _turned(q: Components, u: Components) -> Components:
    """q(0, u)q̄/|q|²."""
    return scale(_inverse_square(q), _back(by(q, u), q))


def _has_axis(system: Any) -> bool:
    return isinstance(system, Top | DrivenTop) and system.axis is not None


def _stands(system: Any) -> bool:
    """Whether the coordinates are those in a frame where an axis is ±e₃."""
    return isinstance(system, Top) and system.axis is not None


@kernel.together
def _kicked_upright(potential: Any, height: Array, q: Components, p_dot: Components) -> Components:
    return _sum(p_dot, _kick_upright(potential, height, q))


@kernel.together
def _kick_upright(potential: Any, height: Array, q: Components) -> Components:
    """−∂V/∂q of V(q) = Ṽ(q̄γq), which is Ṽ(Γ) where |q| = 1: 2γq∇Ṽ, with γ = height e₃."""
    a, b, c, d = (2 * height * x for x in _by_slope(potential, _seen_upright(height, q), q))
    return -d, -c, b, a


@kernel.together
def _kicked_about(potential: Any, axis: Array, q: Components, p_dot: Components, t: Array) -> Components:
    return _sum(p_dot, _kick_about(potential, axis, q, t))


@kernel.together
def _kick_about(potential: Any, axis: Array, q: Components, t: Array) -> Components:
    """2γq∇Ṽ for any axis γ."""
    return _from_left(scale(2, axis), _by_slope(potential, seen(q, axis), q, t))


@kernel.together
def _sum(p_dot: Components, kick: Components) -> Components:
    return tuple(map(jnp.add, p_dot, kick))


def _torque(system: Any, q: Components, t: Any) -> Components:
    if _stands(system):
        return _torque_upright(system.potential, upright(system.axis)[1], q)
    return _torque_about(system.potential, system.axis_at(t), q, t)


@kernel.together
def _torque_upright(potential: Any, height: Array, q: Components) -> Components:
    """The torque in space, γ × q∇Ṽq̄."""
    x, y, _ = _back(_by_slope(potential, _seen_upright(height, q), q), q)
    return -height * y, height * x, jnp.zeros_like(x)


@kernel.together
def _torque_about(potential: Any, axis: Array, q: Components, t: Array) -> Components:
    return cross(axis, _back(_by_slope(potential, seen(q, axis), q, t), q))


def _seen_upright(height: Array, q: Components) -> Components:
    """`seen` of height e₃."""
    w, x, y, z = q
    return scale(height, (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z))


def _by_slope(potential: Any, Gamma: Components, q: Components, *t: Array) -> _Quaternion:
    """q∇Ṽ."""
    return by(q, _components(gradient(potential, jnp.stack(Gamma), *t)))


def _back(x: _Quaternion, q: Components) -> three.Vector:
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
