"""Canonical coordinates of phase spaces, in flat space: those in which Runge–Kutta methods of Gauss are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It keeps |q|² and q·p, and π = ½ Im(p q̄) as far as the
torque does: all quadratic.

T*GL⁺(3) is flat as it is.

Coordinates are a tuple of components: those of q, then those of p; of several bodies positions, quaternions, linear
momenta, and p, each with an axis of bodies, (N,).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import kernel, three
from lieint_jax._numerics.three import add, apply, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, CotangentMatrices, CotangentMotions
from lieint_jax.schemes._body_axes import by, seen
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
)

_Quaternion = tuple[Array, Array, Array, Array]


class Parts(NamedTuple):
    """Coordinates by their meaning; x and P are empty for one body."""

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
    q, p = _components(state.q), _components(state.p)
    if len(q) == 4:
        return (*q, *_from_left(scale(2, p), q))
    return (*q, *p[:3], *_from_left(scale(2, p[3:]), q[3:]))


def parts(z: Components) -> Parts:
    if len(z) == 8:
        return Parts((), z[:4], (), z[4:])
    return Parts(z[:3], z[3:7], z[7:10], z[10:])


def momentum(z: Components) -> Components:
    """π = ½ Im(p q̄) of coordinates; after the linear momenta, if there are any."""
    _, (w, *v), P, (p0, *p) = parts(z)
    return (*P, *scale(0.5, add(subtract(scale(w, p), scale(p0, v)), cross(v, p))))


def configuration(z: Components) -> Array:
    """The configuration, with quaternions of unit length: (4,), (N, 7), or (3, 3)."""
    if len(z) == 18:
        return jnp.stack(z[:9]).reshape(3, 3)
    x, q, *_ = parts(z)
    r = jnp.sqrt(_inverse_square(q))
    return jnp.stack([*x, *(r * y for y in q)], axis=-1)


def inverses(system: Any) -> Any:
    """The inverse of each inertia, computed once for a step."""
    if isinstance(system, ElasticBody):
        return None
    if isinstance(system, FreeBodies | Bodies):
        return jax.vmap(three.inverse)(system.inertias)
    return three.inverse(system.metric if isinstance(system, MechanicalSystem) else system.inertia)


@kernel.stage
def field(system: Any, inverse: Any, z: Components, t: Array | None) -> Components:
    """The time derivative of the coordinates, with the `inverses` of a system."""
    if isinstance(system, ElasticBody):
        F, P = (jnp.stack(x).reshape(3, 3) for x in (z[:9], z[9:]))
        rate = system.vector_field(State(F, P))
        return (*rate.q.ravel(), *rate.p.ravel())
    _, q, P, p = parts(z)
    half = _half_rate(system.rotor if isinstance(system, Gyrostat) else None, inverse, q, p)
    q_dot, p_dot = by(q, half), by(p, half)
    velocity = tuple(y / system.masses for y in P)  # pyright: ignore[reportAttributeAccessIssue]
    if not isinstance(system, Forced | Driven):
        return (*velocity, *q_dot, *(jnp.zeros_like(y) for y in P), *p_dot)
    F, kick = _kick(system, z, t)
    return (*velocity, *q_dot, *F, *(a + b for a, b in zip(p_dot, kick, strict=True)))


@kernel.stage
def force(system: Any, _: Any, z: Components, t: Array | None) -> Components:
    """The components of π̇, or of (ṗ, π̇) of several bodies."""
    if not isinstance(system, Forced | Driven):
        *_, P, _ = parts(z)
        return (jnp.zeros_like(z[0]),) * (3 + len(P))
    q = configuration(z)
    at = (q,) if t is None or isinstance(system, Forced) else (q, t)
    return _components(system.force(*at))


@kernel.stage
def power(system: Driven, _: Any, z: Components, t: Array) -> Components:
    """The power of a driven system, as one component."""
    return (system.power(configuration(z), t),)


def ended(state: State, z: Components, impulse: Components | None, work: Array | None) -> State:
    """`state` moved to the coordinates z; with the impulse and the work of the step added to what they change."""
    p = jnp.stack(z[9:]).reshape(3, 3) if impulse is None else state.p + jnp.stack(impulse, axis=-1)
    end = state._replace(q=configuration(z), p=p)
    return end if work is None or state.work is None else end._replace(work=state.work + work)


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the coordinates, and from the force."""
    z = canonical(state)
    rate = field(system, inverses(system), z, state.t)
    if isinstance(system, ElasticBody):
        return ended(state, rate, None, None)
    _, q = jax.jvp(configuration, (z,), (rate,))
    return State(q, jnp.stack(force(system, None, z, state.t), axis=-1))


def _kick(system: Any, z: Components, t: Array | None) -> tuple[Components, _Quaternion]:
    """Ṗ, if there is such a part, and what the potential adds to ṗ: 2τq/|q|²."""
    _, q, *_ = parts(z)
    if isinstance(system, Top | DrivenTop) and system.axis is not None:
        return (), by(q, _body_torque(system, q, t))
    forces = force(system, None, z, t)
    return forces[:-3], _from_left(scale(2 * _inverse_square(q), forces[-3:]), q)


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
    return scale(2 * r, cross(Gamma, _components(jax.grad(system.potential)(*at))))


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
