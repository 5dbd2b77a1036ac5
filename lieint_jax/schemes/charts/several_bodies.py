"""The motion of several bodies, with rotations in the axes of each: ẋ = P/m, Ṗ = F, and as in `body_axes`.

The unknowns have an axis of bodies, (N,), and are packed into one array.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.capabilities import AbstractFreeBodies, AbstractRigidBodies
from lieint_jax.groups import so3
from lieint_jax.schemes.charts import body_axes
from lieint_jax.schemes.charts._chart import Chart
from lieint_jax.schemes.charts.body_axes import BodyAxesState, free_rates
from lieint_jax.types import State, System, vectors
from lieint_jax.types.shapes import PyTree
from lieint_jax.types.vectors import Matrix, Symmetric, Vector, vector

Components = tuple[Array, ...]


def inverses(system: AbstractRigidBodies | AbstractFreeBodies) -> Symmetric:
    """The inverse inertias of the bodies."""
    return jax.vmap(vectors.inverse)(system.inertias)


def forces(system: AbstractRigidBodies, x: Vector, q: Components) -> tuple[Vector, Vector]:
    """The forces on the bodies, and the torques in their axes. Quaternions are of unit length."""
    found = system.force(jnp.stack([*x, *q], axis=-1))
    pull = tuple(jnp.moveaxis(found, -1, 0))
    return Vector(pull[:3]), Matrix(so3.matrix_of(*q)).T @ Vector(pull[3:])


class Moving(NamedTuple):
    """The unknowns: positions and linear momenta; quaternions and body momenta."""

    x: Vector
    P: Vector
    turning: BodyAxesState


def _pack(z: Moving) -> Array:
    return jnp.stack([*z.x, *z.P, *z.turning.q, *z.turning.Pi], axis=-1)


def _parts(z: Array) -> Moving:
    y = vectors.components(jnp.moveaxis(z, -1, 0))
    return Moving(Vector(y[:3]), Vector(y[3:6]), BodyAxesState(y[6:10], Vector(y[10:]), None))


def _state(z: Array) -> State:
    x, P, turning = _parts(z)
    spin = Matrix(so3.matrix_of(*turning.q)) @ turning.Pi
    return State(jnp.stack([*x, *turning.q], axis=-1), jnp.stack([*P, *spin], axis=-1))


def _turning_part(state: State) -> State:
    return State(state.q[:, 3:], state.p[:, 3:])


class SeveralBodies(Chart[AbstractRigidBodies, Array]):
    """Several bodies: positions and linear momenta in space, quaternions and momenta in the axes of each."""

    def supports(self, system: System) -> bool:
        """Whether a system is of several bodies with these equations of motion."""
        return AbstractRigidBodies.governs(system)

    def unknowns(self, system: AbstractRigidBodies, state: State) -> Array:
        """The unknowns of all bodies in one array, (N, 13)."""
        turning = jax.vmap(body_axes.body_axes_state)(_turning_part(state))
        return _pack(Moving(vector(state.q[:, :3].T), vector(state.p[:, :3].T), turning))

    def apply(self, system: AbstractRigidBodies, state: State, z: Array, delta: Array) -> State:
        """The state whose unknowns are z, after their increments."""
        start, step = _parts(z), _parts(delta)
        end = jax.vmap(body_axes.advance_body)(_turning_part(state), start.turning, step.turning)
        x, P = (jnp.stack(y, axis=-1) for y in (start.x + step.x, start.P + step.P))
        return state._replace(q=jnp.concatenate([x, end.q], axis=1), p=jnp.concatenate([P, end.p], axis=1))

    def split_qp(self, z: Array) -> tuple[list[Array], list[Array]]:
        """The configuration and the momentum."""
        every = _parts(z)
        return [*every.x, *every.turning.q], [*every.P, *every.turning.Pi]

    def rate(self, system: AbstractRigidBodies) -> Callable[[Array, PyTree], Array]:
        """The time derivative of the unknowns, for quaternions of unit length up to the error of a step."""
        inverse, masses = inverses(system), system.masses

        def field(z: Array, _: PyTree) -> Array:
            x, P, turning = _parts(z)
            force, torque = forces(system, x, turning.q)
            q_dot, Pi_dot = free_rates(inverse, None, turning.q, turning.Pi)
            return _pack(Moving((1 / masses) * P, force, BodyAxesState(q_dot, Pi_dot + torque, None)))

        return field


SEVERAL_BODIES = SeveralBodies()
