"""Canonical coordinates of phase spaces, in flat space: those in which Runge–Kutta methods of Gauss are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It keeps |q|² and q·p, and π = ½ Im(p q̄) as far as the
torque does: all quadratic.

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
from lieint_jax.schemes._body_axes import by, seen
from lieint_jax.schemes._several_bodies import Place, apart
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


def canonical(state: State) -> Components:
    """The coordinates of a state."""
    if state.q.shape == (3, 3):
        return tuple(state.q.ravel()) + tuple(state.p.ravel())
    if state.q.ndim == 2 and apart(len(state.q)):
        bodies = zip(map(_components, state.q), map(_components, state.p), strict=True)
        return _all_halves([_coordinates(q, p) for q, p in bodies])
    return _all_halves([_coordinates(_components(state.q), _components(state.p))])


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


@kernel.stage
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
    if isinstance(system, Forced | Driven):
        kicks = _kicks(system, bodies, z, t)
        rates = [(q, tuple(map(jnp.add, p, kick))) for (q, p), kick in zip(rates, kicks, strict=True)]
    return _all_halves(rates)


@kernel.stage
def force(system: Any, _: Any, z: Components, t: Array | None) -> Components:
    """The components of π̇, or of (ṗ, π̇) of several bodies."""
    bodies = parts(z)
    if not isinstance(system, Forced | Driven):
        return (jnp.zeros_like(z[0]),) * (3 + len(bodies[0].P)) * len(bodies)
    if isinstance(system, Bodies):
        places = [Place.of(body.x, _unit(body.q)) for body in bodies]
        return tuple(itertools.chain(*_several_bodies.forces(system, places)))
    q = configuration(z)
    at = (q,) if t is None or isinstance(system, Forced) else (q, t)
    return _components(system.force(*at))


@kernel.stage
def power(system: Driven, _: Any, z: Components, t: Array) -> Components:
    """The power of a driven system, as one component."""
    return (system.power(configuration(z), t),)


def ended(state: State, z: Components, impulse: Components | None, work: Array | None) -> State:
    """`state` moved to the coordinates z; with the impulse and the work of the step added to what they change."""
    moves = z[9:] if impulse is None else impulse
    p = jnp.stack(moves, axis=-1).reshape(state.p.shape)
    p = p if impulse is None else state.p + p
    end = state._replace(q=configuration(z), p=p)
    return end if work is None or state.work is None else end._replace(work=state.work + work)


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the coordinates, and from the force."""
    z = canonical(state)
    rate = field(system, inverses(system), z, state.t)
    if isinstance(system, ElasticBody):
        return ended(state, rate, None, None)
    _, q = jax.jvp(configuration, (z,), (rate,))
    return State(q, jnp.stack(force(system, None, z, state.t), axis=-1).reshape(state.p.shape))


def _rate(rotor: Array | None, inverse: Any, mass: Any, body: Parts) -> tuple[Components, Components]:
    """The derivatives of both halves of a body's coordinates, without a potential."""
    half = _half_rate(rotor, inverse, body.q, body.p)
    velocity, zeros = tuple(y / mass for y in body.P), (jnp.zeros_like(y) for y in body.P)
    return (*velocity, *by(body.q, half)), (*zeros, *by(body.p, half))


def _kicks(system: Any, bodies: list[Parts], z: Components, t: Array | None) -> list[Components]:
    """What the potential adds to the second half of each body's rates: the force, and 2τq/|q|²."""
    if isinstance(system, Top | DrivenTop) and system.axis is not None:
        return [by(bodies[0].q, _body_torque(system, bodies[0].q, t))]
    found = force(system, None, z, t)
    each = len(found) // len(bodies)
    return [_kick(body.q, found[n * each : (n + 1) * each]) for n, body in enumerate(bodies)]


def _kick(q: Components, force: Components) -> Components:
    """The force on a body, if there is one, and its torque τ as 2τq/|q|²."""
    return (*force[:-3], *_from_left(scale(2 * _inverse_square(q), force[-3:]), q))


@kernel.stage
def _half_rate(rotor: Array | None, inverse: three.Symmetric, q: Components, p: Components) -> Components:
    """½Ω, of the momentum Π = ½ Im(q̄p)."""
    (w, *v), (first, *rest) = q, p
    Pi = scale(0.5, subtract(subtract(scale(w, rest), scale(first, v)), cross(v, rest)))
    return scale(0.5, apply(inverse, Pi if rotor is None else subtract(Pi, rotor)))


@kernel.stage
def _body_torque(system: Any, q: Components, t: Any) -> Components:
    """2 Γ × ∇Ṽ(Γ)/|q|², twice the torque in the body of a potential that has an axis, over |q|²."""
    r = _inverse_square(q)
    moves = isinstance(system, DrivenTop)
    Gamma = scale(r, seen(q, _components(system.axis_at(t) if moves else system.axis)))
    at = (jnp.stack(Gamma), t) if moves else (jnp.stack(Gamma),)
    return scale(2 * r, cross(Gamma, _components(gradient(system.potential, *at))))


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
