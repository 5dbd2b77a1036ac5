"""The motion of several bodies, each turning in its own axes: ẋ = P/m, Ṗ = F, and as `_body_axes`.

In a kernel few bodies are written out, number by number, which vectorises over the members of an ensemble. Elsewhere,
and for more of them, each number has an axis of bodies, (N,), and the program is shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import kernel, three
from lieint_jax._numerics.three import add, dot, scale
from lieint_jax.groups import so3
from lieint_jax.schemes import _body_axes
from lieint_jax.schemes._body_axes import Turning, spinning
from lieint_jax.schemes._capability import other_motion
from lieint_jax.types import Bodies, FreeBodies, State, System

FEW = 4  # bodies; a program that writes them out grows with their pairs


def apart(count: int) -> bool:
    """Whether so many bodies are written out, one by one."""
    return count <= FEW and kernel.inside()


def inverses(system: Bodies | FreeBodies) -> list[three.Symmetric]:
    """The inverse inertia of each body, or of all together."""
    if apart(system.masses.shape[0]):
        return [three.inverse(J) for J in system.inertias]
    return [jax.vmap(three.inverse)(system.inertias)]


def masses(system: Bodies | FreeBodies) -> list[Array]:
    """The mass of each body, or of all together."""
    return list(system.masses) if apart(system.masses.shape[0]) else [system.masses]


def forces(system: Bodies, x: Sequence[three.Vector], q: Sequence[tuple[Array, ...]]) -> Sequence[Sequence[Array]]:
    """The force on each body, and the torque in its axes, or on all: six numbers. Quaternions are of unit length."""
    whole = x[0][0].ndim > 0  # all in one
    if hasattr(system.potential, "forces") and not whole:
        return system.potential.forces(x, q)  # pyright: ignore
    found = system.force(together([jnp.stack([*place, *turn], axis=-1) for place, turn in zip(x, q, strict=True)]))
    rows = [tuple(jnp.moveaxis(found, -1, 0))] if whole else list(found)
    return [(*row[:3], *_times_transposed(_rotation(turn), row[3:])) for row, turn in zip(rows, q, strict=True)]


def together(rows: Sequence[Array]) -> Array:
    """(N, k) of the rows of each body, or of all."""
    return rows[0] if rows[0].ndim > 1 else jnp.stack(rows)


class Moving(NamedTuple):
    """The unknowns of a body, or of all: its place, and its linear momentum; a quaternion, and its body momentum."""

    x: three.Vector
    P: three.Vector
    turning: Turning


def known(system: System) -> bool:
    """Whether a system is of several bodies that move as this says."""
    return isinstance(system, Bodies) and not other_motion(motion, system, system)


def unknowns(system: System, state: State) -> Any:
    """Those of each body, or of all in an array, (N, 13)."""
    turning = jax.vmap(_body_axes.turning)(_turning_part(state))
    every = Moving(three.components(state.q[:, :3].T), three.components(state.p[:, :3].T), turning)
    count = len(state.q)
    return tuple(jax.tree.map(lambda x, n=n: x[n], every) for n in range(count)) if apart(count) else _packed(every)


def moved(system: System, state: State, z: Any, delta: Any) -> State:
    """The state whose unknowns are z, after their increments."""
    start, step = (_every(bodies) for bodies in (z, delta))
    end = jax.vmap(_body_axes.turned)(_turning_part(state), start.turning, step.turning)
    x, P = (jnp.stack(add(*pair), axis=-1) for pair in ((start.x, step.x), (start.P, step.P)))
    return state._replace(q=jnp.concatenate([x, end.q], axis=1), p=jnp.concatenate([P, end.p], axis=1))


def halves(z: Any) -> tuple[list[Array], list[Array]]:
    every = _every(z)
    return [*every.x, *every.turning.q], [*every.P, *every.turning.Pi]


def _packed(z: Moving) -> Array:
    return jnp.stack([*z.x, *z.P, *z.turning.q, *z.turning.Pi], axis=-1)


def _every(z: Any) -> Moving:
    """The unknowns of all bodies together."""
    if not isinstance(z, Array):
        return jax.tree.map(lambda *x: jnp.stack(x), *z)
    y = three.components(jnp.moveaxis(z, -1, 0))
    return Moving(y[:3], y[3:6], Turning(y[6:10], y[10:], None))


def moments(system: System, state: State, passed: Array) -> None:
    """Nothing changes with time."""


def rate(system: Any) -> Callable[[Any, None], Any]:
    """The time derivative of the unknowns, for quaternions of unit length but for the error of a step."""
    J, m = inverses(system), masses(system)

    def of(z: Any, _: None) -> Any:
        bodies = (_every(z),) if isinstance(z, Array) else z
        found = forces(system, [body.x for body in bodies], [body.turning.q for body in bodies])
        rates = tuple(map(_rate_of_one, m, J, bodies, found))
        return _packed(rates[0]) if isinstance(z, Array) else rates

    return of


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the unknowns."""
    z = unknowns(system, state)
    return jax.jvp(_state, (z,), (rate(system)(z, None),))[1]


def _state(z: Any) -> State:
    x, P, turning = _every(z)
    spin = [dot(row, turning.Pi) for row in _rotation(turning.q)]
    return State(jnp.stack([*x, *turning.q], axis=-1), jnp.stack([*P, *spin], axis=-1))


def _rotation(q: tuple[Array, ...]) -> three.Matrix:
    return so3.matrix_of(*q)


def _times_transposed(R: three.Matrix, v: three.Vector) -> three.Vector:
    return tuple(dot(axis, v) for axis in three.transpose(R))


def _rate_of_one(mass: Array, inverse: three.Symmetric, z: Moving, force: Sequence[Array]) -> Moving:
    q_dot, Pi_dot = spinning(inverse, None, z.turning.q, z.turning.Pi)
    return Moving(scale(1 / mass, z.P), tuple(force[:3]), Turning(q_dot, add(Pi_dot, force[3:]), None))


def _turning_part(state: State) -> State:
    return State(state.q[:, 3:], state.p[:, 3:])
