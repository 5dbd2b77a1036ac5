"""Canonical coordinates of phase spaces, in flat space: those in which Runge–Kutta methods of Gauss are symplectic.

T*SO(3) is the quotient of T*S³ by ±1, and T*S³ ⊂ T*ℝ⁴: a unit quaternion q and p = 2πq ∈ ℝ⁴ with q·p = 0. With
Ω of the momentum Π = ½ Im(q̄p) in the body, and τ the torque in space at q/|q|,

    q̇ = ½ qΩ,    ṗ = ½ pΩ + 2τq/|q|²

is the Hamiltonian system of H(q/|q|, ½ Im(p q̄)) on T*ℝ⁴. It keeps |q|² and q·p, and π = ½ Im(p q̄) as far as the
torque does: all quadratic.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, CotangentMotions
from lieint_jax.types import PhaseSpace, State, System, time_derivative


def known(space: PhaseSpace) -> bool:
    """Whether a phase space has such coordinates here: T*SO(3), and that of several bodies."""
    return isinstance(space, CotangentMotions) or (isinstance(space, CotangentGroup) and space.group is so3)


def canonical(space: PhaseSpace, state: State) -> State:
    """The state in canonical coordinates; t, work and extra as they are."""
    if isinstance(space, CotangentMotions):
        spinors = jax.vmap(_spinor)(state.q[:, 3:], state.p[:, 3:])
        return state._replace(p=jnp.concatenate([state.p[:, :3], spinors], axis=1))
    return state._replace(p=_spinor(state.q, state.p))


def from_canonical(space: PhaseSpace, z: State) -> State:
    """The state of canonical coordinates; quaternions as they are, of unit length or not."""
    if isinstance(space, CotangentMotions):
        spins = jax.vmap(_spin)(z.q[:, 3:], z.p[:, 3:])
        return z._replace(p=jnp.concatenate([z.p[:, :3], spins], axis=1))
    return z._replace(p=_spin(z.q, z.p))


def unit_configuration(space: PhaseSpace, q: Array) -> Array:
    """q with its quaternions normalised."""
    if isinstance(space, CotangentMotions):
        return jnp.concatenate([q[:, :3], jax.vmap(so3.normalise)(q[:, 3:])], axis=1)
    return so3.normalise(q)


def rate(system: System, z: State) -> State:
    """The time derivative of the state at canonical coordinates z, at unit quaternions."""
    space = system.phase_space
    return time_derivative(system, from_canonical(space, z)._replace(q=unit_configuration(space, z.q)))


def canonical_rate(system: System, z: State) -> State:
    """The time derivative of canonical coordinates."""
    space, moving = system.phase_space, rate(system, z)
    if not isinstance(space, CotangentMotions):
        q_dot, p_dot = _spinor_rate(z.q, z.p, moving.q, moving.p)
        return moving._replace(q=q_dot, p=p_dot)
    turning = jax.vmap(_spinor_rate)(z.q[:, 3:], z.p[:, 3:], moving.q[:, 3:], moving.p[:, 3:])
    q_dot, p_dot = (jnp.concatenate([x[:, :3], y], axis=1) for x, y in zip(moving[:2], turning, strict=True))
    return moving._replace(q=q_dot, p=p_dot)


def _spinor(q: Array, spin: Array) -> Array:
    """p = 2πq."""
    return 4 * so3.spatial_tangent(q, spin)


def _spin(q: Array, p: Array) -> Array:
    """π = ½ Im(p q̄)."""
    return so3.spatial_velocity(q, p) / 4


def _spinor_rate(q: Array, p: Array, turning: Array, torque: Array) -> tuple[Array, Array]:
    """q̇ and ṗ, of the q̇ = `turning` at the unit quaternion q/|q|, and of the torque there."""
    length = jnp.sqrt(jnp.sum(q * q))
    half_rate = so3.multiply(so3.inverse(q), turning) / length
    return length * turning, so3.multiply(p, half_rate) + 4 / length**2 * so3.spatial_tangent(q, torque)
