"""Basilisk's spacecraft with a constant torque in the body."""

from __future__ import annotations

import numpy as np

from lieint_jax import attitude, schemes, systems, torques
from lieint_jax.app.published._case import Case
from lieint_jax.runs import integrate


def basilisk_constant_torque() -> Case:
    """A constant torque for 10 min; Basilisk's step explains the difference (`tests/app/test_published_misfits.py`)."""

    def compute() -> dict[str, np.ndarray]:
        law = torques.thruster([-1.0, 1.0, -1.0], 0.0, 600.0)  # N m
        body = systems.torqued_body([900.0, 800.0, 600.0], law)  # kg m²
        start = body.state(attitude.from_mrp([0.1, 0.2, -0.3]), angular_velocity=[0.001, -0.01, 0.03], t=0.0)
        step = schemes.compose(schemes.torqued_midpoint(body), 6)
        end = integrate(step, start, 0.05, 12000, save_every=12000)
        return {"MRP at 600 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}

    scheme = "compose(torqued_midpoint(body), 6) with torques.thruster, Δt = 0.05 s"
    return Case.of("basilisk_constant_torque", scheme, compute)
