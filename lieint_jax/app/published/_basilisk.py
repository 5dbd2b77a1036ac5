"""Basilisk's spacecraft: free, with three wheels, and with a constant torque in the body."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np

from lieint_jax import attitude, schemes, systems, torques
from lieint_jax._checks import Attitude
from lieint_jax.app.published._case import Case
from lieint_jax.runs import integrate

_SPACECRAFT, _SPIN = [500.0, 200.0, 300.0], [0.5, -0.4, 0.7]  # kg m², rad/s


def basilisk_free_body() -> Case:
    """Basilisk's test of a free spacecraft."""
    return _basilisk("Basilisk, free spacecraft", (0.373034285, -0.00239564413, 0.208570797))


def basilisk_momentum_frame() -> Case:
    """The same spacecraft in a frame whose third axis opposes its angular momentum."""
    third = -np.array(_SPACECRAFT) * _SPIN
    third /= np.linalg.norm(third)
    second = np.array([-third[1] / third[0], 1.0, 0.0])
    second /= np.linalg.norm(second)
    to_space = np.array([np.cross(second, third), second, third])
    name = "Basilisk, free spacecraft in the frame of its momentum"
    return _basilisk(name, (0.572693314, 0.510734375, -0.307377611), to_space)


def _basilisk(code: str, published: tuple[float, ...], start: Attitude = (1.0, 0.0, 0.0, 0.0)) -> Case:
    @partial(
        Case,
        code=code,
        source="AVSLab/basilisk, src/simulation/dynamics/spacecraft/_UnitTest/test_spacecraft.py @babdff7",
        scheme="rigid_body(…).solution, the closed form",
        published={"MRP at 10 s": published},
        limit="nine printed digits",
        digits=5e-10,
    )
    def case() -> dict[str, np.ndarray]:
        body = systems.rigid_body(_SPACECRAFT)
        end = body.solution(body.state(start, angular_velocity=_SPIN), 10.0)
        return {"MRP at 10 s": np.asarray(attitude.to_mrp(end.q))}

    return case


_AXIAL = 100 / (6000 * 2 * np.pi / 60)  # kg m², of each wheel: 100 N m s at 6000 rpm


def _motors(t: jnp.ndarray, q: jnp.ndarray, Omega: jnp.ndarray, h: jnp.ndarray) -> jnp.ndarray:
    """The motors' torques: 0.2, 0.1 and −0.5 N m until 0.5 s, then 0."""
    return jnp.where(t < 0.5, jnp.array([0.2, 0.1, -0.5]), 0.0)


@partial(
    Case,
    code="Basilisk, three balanced reaction wheels",
    source="AVSLab/basilisk, src/simulation/dynamics/reactionWheels/_UnitTest/"
    "test_reactionWheelStateEffector_integrated.py @babdff7",
    scheme="compose(torqued_midpoint(body), 4) with torques.wheels, Δt = 0.005 s",
    published={"MRP at 1 s": (0.0199853994, 0.00245647716, 8.45356279e-06)},
    limit="nine printed digits",
    digits=5e-11,
)
def basilisk_wheels() -> dict[str, np.ndarray]:
    """A spacecraft with three balanced wheels; the third motor is limited to the largest torque of 0.2 N m."""
    axes, moments = jnp.eye(3), jnp.full(3, _AXIAL)
    locked = jnp.array([900.0, 800.0, 600.0])
    speeds = jnp.array([500.0, 200.0, -150.0]) * (2 * np.pi / 60)
    law = torques.wheels(axes, moments, _motors, max_torque=0.2, speeds=speeds)
    body = systems.torqued_body(torques.body_inertia(locked, axes, moments), law)
    start = body.state(angular_velocity=[0.08, 0.01, 0.0], t=0.0)
    step = schemes.compose(schemes.torqued_midpoint(body), 4)
    end = integrate(step, start, 0.005, 200, save_every=200)  # the motors stop where a step ends
    return {"MRP at 1 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}


@partial(
    Case,
    code="Basilisk, constant torque on a spacecraft, 10 min",
    source="AVSLab/basilisk, src/simulation/dynamics/extForceTorque/_UnitTest/test_extForceTorqueIntegrated.py "
    "@babdff7",
    scheme="compose(torqued_midpoint(body), 6) with torques.thruster, Δt = 0.05 s",
    published={"MRP at 600 s": (0.491025978, -0.421586707, 0.361459503)},
    limit="the other code's steps: RK4 on its parameters, 0.1 s",
    digits=5e-10,
)
def basilisk_constant_torque() -> dict[str, np.ndarray]:
    """A constant torque for 10 min; Basilisk's step explains the difference (`tests/app/test_published_misfits.py`)."""
    law = torques.thruster([-1.0, 1.0, -1.0], 0.0, 600.0)  # N m
    body = systems.torqued_body([900.0, 800.0, 600.0], law)  # kg m²
    start = body.state(attitude.from_mrp([0.1, 0.2, -0.3]), angular_velocity=[0.001, -0.01, 0.03], t=0.0)
    step = schemes.compose(schemes.torqued_midpoint(body), 6)
    end = integrate(step, start, 0.05, 12000, save_every=12000)
    return {"MRP at 600 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}
