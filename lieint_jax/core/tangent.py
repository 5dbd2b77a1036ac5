"""Tangent vectors in the coordinates of a phase space: their units, Jacobians of maps, frames; distances of states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import PhaseVector, Scalar, TangentVectors
from lieint_jax._xla import compiled
from lieint_jax.core._group import PhaseSpace, SpaceWithUnits
from lieint_jax.core._state import State
from lieint_jax.core._step import push_forward
from lieint_jax.core._system import System, time_derivative

_Aux = TypeVar("_Aux")

# Dimensions above which the columns of a derivative are taken one by one: XLA fuses a batch of them so that each
# element is computed again for each of its uses. With 64 molecules, and with three bodies by `nystrom`, a certificate
# took many minutes.
_LARGE = 24
_SLOW = 1e-2  # of the momentum with which a system swings by a radian: with less it is at rest


def value_and_jacobian(
    space: PhaseSpace, function: Callable[[State], tuple[State, _Aux]], state: State
) -> tuple[State, _Aux, Array]:
    """end, aux = function(state), and the derivative of end, (2d, 2d), in the coordinates of the phase space."""
    one = jnp.eye(space.dim, dtype=state.p.dtype)
    if space.dim <= _LARGE:
        return push_forward(space, function, state, one)

    def of_perturbed(delta: Array) -> tuple[State, tuple[State, _Aux]]:
        end, aux = function(space.perturb(state, delta))
        return end, (end, aux)

    _, push, (end, aux) = jax.linearize(of_perturbed, jnp.zeros_like(one[0]), has_aux=True)
    return end, aux, jax.lax.map(lambda delta: space.trivialize(end, push(delta)), one).T


def distance(a: State, b: State, space: PhaseSpace | None = None, *, scale: State | None = None) -> Scalar:
    """The largest difference of two states, in q, and in p over the largest component of p: dimensionless.

    If a phase space with its own units is given, differences are in these units. The units are those of the state
    `scale`, by default b.
    """
    scale = b if scale is None else scale
    if isinstance(space, SpaceWithUnits):
        return jnp.max(jnp.abs(space.displacement(b, a) / jnp.concatenate(units(space, scale))))
    return jnp.maximum(jnp.max(jnp.abs(a.q - b.q)), jnp.max(jnp.abs(a.p - b.p), initial=0) / size(scale.p))


def size(p: Array) -> Scalar:
    """The largest component of a momentum, 1 for zero: the unit of errors of momenta."""
    largest = jnp.max(jnp.abs(p), initial=0)
    return jnp.where(largest > 0, largest, 1)


def units(space: PhaseSpace, state: State) -> tuple[PhaseVector, PhaseVector]:
    """The units of δq and of δp, (d,) each, in which tangent vectors are dimensionless: 1 and `size`, or its own."""
    if isinstance(space, SpaceWithUnits):
        return space.units(state)
    momenta = space.dim // 2 if state.p.size else 0
    return jnp.ones(space.dim - momenta, state.p.dtype), jnp.ones(momenta, state.p.dtype) * size(state.p)


def swinging(system: System, state: State) -> State:
    """The state whose momenta are the units of momenta: the state itself, or at rest one that swings by a radian.

    That has √(∂ṗ/∂q / ∂q̇/∂p) along generic directions, and no momentum where no force depends on q. A state with less
    than _SLOW of it counts as at rest; of several bodies their positions and their attitudes each.
    """
    space, (of_q, of_p) = system.phase_space, units(system.phase_space, state)
    if not of_p.size:
        return state
    n, along = of_q.size, jnp.asarray(np.cos(np.arange(space.dim)), state.p.dtype)

    def velocity(delta: Array) -> Array:
        z = space.perturb(state, delta)
        return space.trivialize(z, time_derivative(system, z))

    def change(direction: Array) -> Array:
        return jax.jvp(velocity, (jnp.zeros_like(along),), (direction,))[1]

    directions = jnp.stack([along.at[n:].set(0).at[:n].multiply(of_q), along.at[:n].set(0)])
    by_q, by_p = jax.vmap(change)(directions)  # one batch compiles in half of the time
    stiffness, mobility = jnp.max(of_q * jnp.abs(by_q[n:])), jnp.abs(by_p[:n])
    natural = jnp.sqrt(stiffness / jnp.where(mobility > 0, mobility, jnp.inf))
    several = isinstance(space, SpaceWithUnits)
    p, axes = (state.p.reshape(-1, 2, 3), (0, 2)) if several else (state.p, None)
    natural = natural.reshape(p.shape) if natural.size == p.size else jnp.max(natural)
    size, least = (jnp.max(jnp.abs(x), axis=axes, keepdims=several) for x in (p, natural))
    return state._replace(p=jnp.where(size < _SLOW * least, natural, p).reshape(state.p.shape))


scale_at = compiled(swinging, once=True)


@partial(compiled, once=True)
def units_at_start(system: System, state: State) -> PhaseVector:
    """The units of δq and δp, (2d,), as `units`, also of a state at rest."""
    return jnp.concatenate(units(system.phase_space, swinging(system, state)))


def orthonormalize(W: TangentVectors) -> tuple[Array, Array]:
    """The orthonormal factor Q of W = QR, and the logarithms of R's diagonal, by Gram and Schmidt (modified)."""
    rest, Q, growth = [W[:, j] for j in range(W.shape[1])], [], []
    while rest:
        length = jnp.sqrt(jnp.sum(rest[0] * rest[0]))
        q = rest[0] * (1 / length)
        rest = [w - jnp.sum(q * w) * q for w in rest[1:]]
        Q, growth = [*Q, q], [*growth, jnp.log(length)]
    return jnp.stack(Q, axis=1), jnp.stack(growth)
