"""The motion of a few bodies, number by number, each turning in its own axes: ẋ = P/m, Ṗ = F, and as `_body_axes`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import kernel, three
from lieint_jax._numerics.three import add, apply, cross, scale
from lieint_jax.groups import so3
from lieint_jax.schemes import _body_axes
from lieint_jax.schemes._body_axes import Turning, by
from lieint_jax.schemes._capability import other_motion
from lieint_jax.types import Bodies, State, System

FEW = 4  # bodies; the program grows with their pairs


class Place(NamedTuple):
    """The position, the unit quaternion and the rotation of a body."""

    x: three.Vector
    q: tuple[Array, ...]
    R: three.Matrix

    @classmethod
    def of(cls, x: three.Vector, q: tuple[Array, ...]) -> Place:
        return cls(x, q, _rotation(q))


def forces(system: Bodies, places: Sequence[Place]) -> Sequence[Sequence[Array]]:
    """The force and the torque in space on each body, six numbers."""
    if hasattr(system.potential, "forces"):
        return system.potential.forces([at.x for at in places], [at.R for at in places])  # pyright: ignore
    rows = system.force(jnp.stack([jnp.stack([*at.x, *at.q]) for at in places]))
    return [three.components(row) for row in rows]


class Moving(NamedTuple):
    """The unknowns of one body: its place, and its linear momentum; a quaternion, and its body momentum."""

    x: three.Vector
    P: three.Vector
    turning: Turning


def known(system: System) -> bool:
    """Whether a system is of few bodies that move as this says."""
    if not isinstance(system, Bodies) or system.masses.shape[0] > FEW:
        return False
    return not other_motion(motion, system, system)


def unknowns(state: State) -> tuple[Moving, ...]:
    x, P = state.q[:, :3], state.p[:, :3]
    turning = (_body_axes.unknowns(_turning_part(state, n)) for n in range(len(x)))
    return tuple(Moving(three.components(x[n]), three.components(P[n]), z) for n, z in enumerate(turning))


def moved(state: State, z: tuple[Moving, ...], delta: tuple[Moving, ...]) -> State:
    """The state whose unknowns are z, after their increments."""
    q, p = [], []
    for n, (at, d) in enumerate(zip(z, delta, strict=True)):
        end = _body_axes.moved(_turning_part(state, n), at.turning, d.turning)
        q.append(jnp.concatenate([jnp.stack(add(at.x, d.x)), end.q]))
        p.append(jnp.concatenate([jnp.stack(add(at.P, d.P)), end.p]))
    return state._replace(q=jnp.stack(q), p=jnp.stack(p))


def rate(system: Any) -> Callable[[Any], tuple[Moving, ...]]:
    """The time derivative of the unknowns, for quaternions of unit length but for the error of a step."""
    inverses = [three.inverse(J) for J in system.inertias]

    def of(z: Any) -> tuple[Moving, ...]:
        places = [Place.of(body.x, body.turning.q) for body in z]
        pulls = forces(system, places)
        return tuple(map(_rate_of_one, system.masses, inverses, z, places, pulls))

    return of


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the unknowns."""
    z = unknowns(state)
    q, p = [], []
    for body, change in zip(z, rate(system)(z), strict=True):
        at, moves = ((jnp.stack(y.turning.q), jnp.stack(y.turning.Pi)) for y in (body, change))
        q.append(jnp.stack([*change.x, *change.turning.q]))
        p.append(jnp.concatenate([jnp.stack(change.P), jax.jvp(so3.Ad, at, moves)[1]]))
    return State(jnp.stack(q), jnp.stack(p))


@kernel.stage
def _rotation(q: tuple[Array, ...]) -> three.Matrix:
    return so3.matrix_of(*q)


def _rate_of_one(mass: Array, inverse: Any, z: Moving, at: Place, force: Sequence[Array]) -> Moving:
    q, Pi = z.turning.q, z.turning.Pi
    Omega = apply(inverse, Pi)
    torque = [three.dot(axis, force[3:]) for axis in three.transpose(at.R)]
    turning = Turning(by(q, scale(0.5, Omega)), add(cross(Pi, Omega), torque), None, None)
    return Moving(scale(1 / mass, z.P), tuple(force[:3]), turning)


def _turning_part(state: State, n: int) -> State:
    return State(state.q[n, 3:], state.p[n, 3:])
