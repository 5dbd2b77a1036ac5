"""Basilisk's spacecraft with three wheels."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from lieint_jax import attitude, schemes, systems, torques
from lieint_jax.app.published._case import Case
from lieint_jax.runs import integrate

_AXIAL = 100 / (6000 * 2 * np.pi / 60)  # kg m², of each wheel: 100 N m s at 6000 rpm


def _motors(t: jnp.ndarray, q: jnp.ndarray, Omega: jnp.ndarray, h: jnp.ndarray) -> jnp.ndarray:
    """The motors' torques: 0.2, 0.1 and −0.5 N m until 0.5 s, then 0."""
    return jnp.where(t < 0.5, jnp.array([0.2, 0.1, -0.5]), 0.0)


def basilisk_wheels() -> Case:
    """A spacecraft with three balanced wheels; the third motor is limited to the largest torque of 0.2 N m."""

    def compute() -> dict[str, np.ndarray]:
        axes, moments = jnp.eye(3), jnp.full(3, _AXIAL)
        locked = jnp.array([900.0, 800.0, 600.0])
        speeds = jnp.array([500.0, 200.0, -150.0]) * (2 * np.pi / 60)
        law = torques.wheels(axes, moments, _motors, max_torque=0.2, speeds=speeds)
        body = systems.torqued_body(torques.body_inertia(locked, axes, moments), law)
        start = body.state(angular_velocity=[0.08, 0.01, 0.0], t=0.0)
        step = schemes.compose(schemes.torqued_midpoint(body), 4)
        end = integrate(step, start, 0.005, 200, save_every=200)  # the motors stop where a step ends
        return {"MRP at 1 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}

    scheme = "compose(torqued_midpoint(body), 4) with torques.wheels, Δt = 0.005 s"
    return Case.of("basilisk_wheels", scheme, compute)
