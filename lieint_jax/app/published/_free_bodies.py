"""Free rigid bodies, as computed by NASA, Basilisk and kynema."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from lieint_jax import attitude, systems
from lieint_jax._checks import Attitude
from lieint_jax.app.published._case import Case

_RATES = {  # °/s at the times
    2: (-1.75081532854, 23.6495577599, 28.0713200449),
    10: (-2.41890222177, -23.5525695195, 28.12859263),
    20: (-5.42273467991, 22.7159305765, 28.6082817473),
    30: (12.6183907757, -17.3974747619, 31.1195888868),
}
_SPACECRAFT, _SPIN = [500.0, 200.0, 300.0], [0.5, -0.4, 0.7]  # kg m², rad/s


@partial(
    Case,
    code="NASA, tumbling brick (NESC atmospheric check case 2)",
    source="nasa/simupy-flight, NESC_data/Atmospheric_checkcases/Atmos_02_TumblingBrickNoDamping/"
    "Atmos_02_sim_04.csv @70754e6; NASA/TM-2015-218675",
    scheme="rigid_body(…).solution, the closed form",
    published={f"rates at {t} s, °/s": rate for t, rate in _RATES.items()},
    limit="the other code's steps: NASA's simulations 01 and 04 differ by 1e-9, others by up to 3e-3",
)
def tumbling_brick() -> dict[str, np.ndarray]:
    """NASA's check case of a tumbling brick without damping."""
    body = systems.rigid_body([0.00189422, 0.006211019, 0.007194665])  # slug ft²
    start = body.state(angular_velocity=np.deg2rad([10.0, 20.0, 30.0]))
    ends = jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(np.array(list(_RATES), float))
    return {f"rates at {t} s, °/s": np.rad2deg(end) for t, end in zip(_RATES, np.asarray(ends), strict=True)}


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


@partial(
    Case,
    code="kynema, precession of a free symmetric body",
    source="kynema/kynema, tests/regression_tests/regression/test_precession.cpp @d3b403d",
    scheme="rigid_body(…).solution, the closed form",
    published={
        "quaternion at 5 s": (-0.63053045128590757, 0.60556039120583116, -0.30157681970585326, -0.38049886257377241)
    },
    limit="the other code's start: its generalized-α method begins with zero acceleration, an error of order 1",
)
def kynema_precession() -> dict[str, np.ndarray]:
    """kynema's precessing body; its first step explains the difference (`tests/app/test_published_misfits.py`)."""
    body = systems.rigid_body([1.0, 1.0, 0.5])
    end = body.solution(body.state(angular_velocity=[0.5, 0.5, 1.0]), 5.0)
    q = np.asarray(end.q)
    return {"quaternion at 5 s": q if q[0] < 0 else -q}
