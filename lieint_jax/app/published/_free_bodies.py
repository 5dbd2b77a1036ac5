"""Free rigid bodies, as computed by NASA, Basilisk, kynema and van Zon & Schofield."""

from __future__ import annotations

import jax
import numpy as np

from lieint_jax import attitude, systems
from lieint_jax._checks import Attitude
from lieint_jax.app.published._case import Case

_SCHEME = "rigid_body(…).solution, the closed form"
_SPACECRAFT, _SPIN = [500.0, 200.0, 300.0], [0.5, -0.4, 0.7]  # kg m², rad/s


def tumbling_brick() -> Case:
    """NASA's check case of a tumbling brick without damping."""
    times = (2, 10, 20, 30)

    def compute() -> dict[str, np.ndarray]:
        body = systems.rigid_body([0.00189422, 0.006211019, 0.007194665])  # slug ft²
        start = body.state(angular_velocity=np.deg2rad([10.0, 20.0, 30.0]))
        ends = jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(np.array(times, float))
        return {f"rates at {t} s, °/s": np.rad2deg(end) for t, end in zip(times, np.asarray(ends), strict=True)}

    return Case.of("tumbling_brick", _SCHEME, compute)


def van_zon_schofield() -> Case:
    """Their program's closed form; the times are sums of its steps of 1/60 s, to the last bit."""
    times = (1.0000000000000013, 4.999999999999988, 9.983333333333409)

    def compute() -> dict[str, np.ndarray]:
        body = systems.rigid_body([10.0, 20.0, 26.0])
        start = body.state(angular_velocity=[1.0, 15.0, 1.0])
        ends = [body.solution(start, t) for t in times]
        rates = [np.asarray(body.angular_velocity(end)) for end in ends]
        matrix = {f"attitude matrix, space to body, at {times[1]} s": np.asarray(body.rotation_matrix(ends[1])).T}
        return matrix | {f"rates at {t} s, rad/s": rate for t, rate in zip(times, rates, strict=True)}

    return Case.of("van_zon_schofield", _SCHEME, compute)


def basilisk_free_body() -> Case:
    """Basilisk's test of a free spacecraft."""
    return _basilisk("basilisk_free", (1.0, 0.0, 0.0, 0.0))


def basilisk_momentum_frame() -> Case:
    """The same spacecraft in a frame whose third axis opposes its angular momentum."""
    third = -np.array(_SPACECRAFT) * _SPIN
    third /= np.linalg.norm(third)
    second = np.array([-third[1] / third[0], 1.0, 0.0])
    second /= np.linalg.norm(second)
    return _basilisk("basilisk_momentum_frame", np.array([np.cross(second, third), second, third]))


def _basilisk(name: str, start: Attitude) -> Case:
    def compute() -> dict[str, np.ndarray]:
        body = systems.rigid_body(_SPACECRAFT)
        end = body.solution(body.state(start, angular_velocity=_SPIN), 10.0)
        return {"MRP at 10 s": np.asarray(attitude.to_mrp(end.q))}

    return Case.of(name, _SCHEME, compute)


def kynema_precession() -> Case:
    """kynema's precessing body; its first step explains the difference (`tests/app/test_published_misfits.py`)."""

    def compute() -> dict[str, np.ndarray]:
        body = systems.rigid_body([1.0, 1.0, 0.5])
        end = body.solution(body.state(angular_velocity=[0.5, 0.5, 1.0]), 5.0)
        q = np.asarray(end.q)
        return {"quaternion at 5 s": q if q[0] < 0 else -q}

    return Case.of("kynema_precession", _SCHEME, compute)
