"""The heavy top that the multibody community uses as a benchmark: Brüls, Cardona & Arnold 2012."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np
from jax import Array

from lieint_jax import schemes, systems
from lieint_jax.app.published._case import Case
from lieint_jax.groups import so3
from lieint_jax.runs import integrate

_ARM = np.array([0.0, 1.0, 0.0])  # from the point to the center of mass, m
_WEIGHT = 15.0 * 9.81  # N
_SCHEME = "gauss(top, 8), Δt = 0.001 s"


@cache
def _states() -> tuple[Array, Array]:
    """Quaternions and angular velocities in the body for 2 s, every 0.01 s."""
    top = systems.heavy_top([15.234375, 0.46875, 15.234375], _WEIGHT * _ARM)
    start = top.state(angular_velocity=[0.0, 150.0, -4.61538])
    run = integrate(schemes.gauss(top, 8), start, 0.001, 2000, save_every=10)
    return run.state.q, jax.vmap(top.free.angular_velocity)(run.state)


def kynema_heavy_top() -> Case:
    """A test of kynema, whose reference has an error of 1e-6."""

    def compute() -> dict[str, np.ndarray]:
        q = _states()[0][-1]
        return {
            "displacement of the center at 2 s, m": np.asarray(so3.Ad(q, _ARM)) - _ARM,
            "quaternion at 2 s": np.asarray(q),
        }

    return Case.of("kynema_heavy_top", _SCHEME, compute)


def exudyn_heavy_top() -> Case:
    """Tests of Exudyn by its explicit Lie group methods, which quote converged numbers."""

    def compute() -> dict[str, np.ndarray]:
        rates = np.asarray(jax.vmap(so3.Ad)(*_states()))[:, 1]
        quantity = "angular velocity about the space axis y at {} s, rad/s"
        return {quantity.format("0.01"): rates[1], quantity.format("2"): rates[-1]}

    return Case.of("exudyn_heavy_top", _SCHEME, compute)
