"""NASA's satellite under the gravity gradient on an ellipse, for 8 h, without and with an initial pitch rate."""

from __future__ import annotations

import jax
import numpy as np

from lieint_jax import orbits, schemes, systems
from lieint_jax.app.published._case import Case
from lieint_jax.runs import integrate

_T0 = [
    [-0.6443912269484258, 0.0528421023505859, 0.762868048125672],
    [-0.7615617871967408, -0.1345758406652156, -0.6339660774765135],
    [0.0691635085403311, -0.9894933326346473, 0.1269620169892195],
]
_TIMES = (300, 28800)  # s, of the published states


def jeod_gravity_gradient() -> Case:
    """JEOD's RUN_10C, which is NESC check case 10C."""
    return _jeod("jeod_10c", pitch_rate=-0.001122059109806593)


def jeod_pitching() -> Case:
    """JEOD's RUN_10D: the same satellite with a pitch rate of 0.01 °/s."""
    return _jeod("jeod_10d", pitch_rate=-0.00094752618460716)


def _jeod(name: str, pitch_rate: float) -> Case:
    return Case.of(
        name, "extrapolate(satellite, 14), Δt = 60 s; orbits.from_state", compute=lambda: _compute(pitch_rate)
    )


def _compute(pitch_rate: float) -> dict[str, np.ndarray]:
    """The positions, attitudes and rates at both times, by this package."""
    orbit = orbits.from_state(
        398600441500000.0, [-4315967.74, 960356.2, 5167269.53], [129.091037, -7491.513855, 1452.515654]
    )
    satellite = systems.gravity_gradient([500.0, 12250.0, 12250.0], orbit)
    start = satellite.state(np.array(_T0).T, angular_velocity=[-1.958561461497211e-05, pitch_rate, 0.0], t=0.0)
    run = integrate(schemes.extrapolate(satellite, 14), start, 60.0, 480, save_every=5)
    found = {}
    for t in _TIMES:
        state = jax.tree.map(lambda x, k=t // 300: x[k], run.state)
        position, velocity = orbit(float(t))
        ours = {
            "position, m": position,
            "velocity, m/s": velocity,
            "attitude matrix": satellite.free.rotation_matrix(state).T,
            "rates, rad/s": satellite.angular_velocity(state),
        }
        found |= {f"{name}, at {t} s": np.asarray(value) for name, value in ours.items()}
    return found
