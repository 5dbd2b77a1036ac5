"""The rigid bodies and gyrostats that the schemes on SO(3) accept, and the limits set by rounding."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax.typing import DTypeLike

from lieint_jax.groups import so3
from lieint_jax.schemes._shared.accepts import AcceptedSystems
from lieint_jax.types import (
    AbstractDampedBody,
    AbstractDrivenGyrostat,
    AbstractDrivenTop,
    AbstractFreeBody,
    AbstractGyrostat,
    AbstractTop,
    AbstractTorquedBody,
    State,
    clock,
)
from lieint_jax.types.vectors import symmetric

RotatingBody = (
    AbstractFreeBody | AbstractGyrostat | AbstractTop | AbstractDrivenTop | AbstractTorquedBody | AbstractDampedBody
)


def rigid_motion(body: RotatingBody, state: State) -> State:
    """(q̇, π̇) = (½ q Ω, 0) with JΩ = Π (2.12), or Π − h_r: the torque-free motion of a body."""
    own = so3.Ad_star(state.q, state.p)
    if isinstance(body, AbstractGyrostat):
        own = own - body.rotor
    Omega = symmetric(body.inertia).solve(own)
    return State(so3.tangent(state.q, jnp.stack(Omega)), jnp.zeros_like(state.p))


def _driven_motion(system: AbstractDrivenGyrostat, state: State) -> State:
    """The vector field of the gyrostat with the present rotor momentum, and ḣ_r = τ(t)."""
    turning = rigid_motion(system.with_rotor(system.rotor(state)), state)
    return turning._replace(extra={"rotor": system.torque(clock(state))})


FREE_BODIES = AcceptedSystems(AbstractFreeBody, "free rigid bodies (systems.rigid_body)", rigid_motion)
GYROSTATS = AcceptedSystems(AbstractGyrostat, "gyrostats (systems.gyrostat)", rigid_motion)
DRIVEN_GYROSTATS = AcceptedSystems(AbstractDrivenGyrostat, "driven gyrostats (systems.driven_gyrostat)", _driven_motion)
SLENDER = (
    "the inertia's moments differ so much that a full tensor does not hold the smallest one (to 1 : 3.5e4 in float64, "
    "1 : 1400 in float32): give principal moments (3,), and turn the attitude to the principal axes"
)


def attitude_error_limit(dtype: DTypeLike) -> float:
    """The error of an attitude, by rounding of the state alone, above which a step is not to be trusted."""
    return max(1e-6, math.sqrt(jnp.finfo(dtype).eps))
