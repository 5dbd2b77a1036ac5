"""NASA's cases: satellites under the gravity gradient on an ellipse, for 8 h, and a free tumbling brick."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from lieint_jax import orbits, schemes, systems
from lieint_jax.app.published._case import Case
from lieint_jax.runs import integrate

_HEAD = "verif/SIM_dyncomp/SET_test_val"
_T0 = [
    [-0.6443912269484258, 0.0528421023505859, 0.762868048125672],
    [-0.7615617871967408, -0.1345758406652156, -0.6339660774765135],
    [0.0691635085403311, -0.9894933326346473, 0.1269620169892195],
]
_AT_REST = {  # RUN_10C, at the times in s
    300: {
        "position, m": (-4033756.267998047, -1298847.133169205, 5302377.246945092),
        "attitude matrix": (
            (-0.5871162490491013, -0.2633642854141441, 0.7654631037945663),
            (-0.764805635822254, -0.1293984158099508, -0.6311326242561012),
            (0.2652675055807466, -0.9559787148018372, -0.1254505772358036),
        ),
        "rates, rad/s": (-1.958561461497211e-05, -0.001032040842888368, -2.37228160922577e-05),
    },
    28800: {
        "position, m": (-1051395.223245429, -6116653.272961161, 2626343.274205685),
        "attitude matrix": (
            (-0.1416223422259051, -0.9171375917053928, 0.372561068904521),
            (-0.9814677649343182, 0.08101112610984618, -0.1736612329832083),
            (0.1290896532541655, -0.3902509901681823, -0.9116139676943704),
        ),
        "rates, rad/s": (-1.958561461497211e-05, -0.001102150420357001, -0.0007137081527530395),
    },
}
_PITCHING = {  # RUN_10D, on the same orbit
    300: {
        "attitude matrix": (
            (-0.599756445358454, -0.2157163136966999, 0.7705573815466951),
            (-0.7646572748686626, -0.1292402714973616, -0.6313447586016051),
            (0.2357784091926621, -0.967865395718018, -0.08743636274561262),
        ),
        "rates, rad/s": (-1.958561461497211e-05, -0.0008852432884078457, -2.292505514081082e-05),
    },
    28800: {
        "attitude matrix": (
            (-0.09270989340746383, -0.9435593558564048, 0.3179632331578974),
            (-0.9864361111063251, 0.04359502545335181, -0.1582506633829749),
            (0.1354572787627401, -0.3283218173249661, -0.9348027117518567),
        ),
        "rates, rad/s": (-1.958561461497211e-05, -0.001062058853745821, -0.0006901638686869954),
    },
}


def jeod_gravity_gradient() -> Case:
    """JEOD's RUN_10C, which is NESC check case 10C."""
    name = "NASA JEOD, gravity gradient on an ellipse, 8 h (NESC check case 10C)"
    limit = "JEOD's orbit, which differs from Kepler's by 1e-5 m after 8 h, and its steps of the attitude"
    return _jeod(name, "RUN_10C", _AT_REST, limit, pitch_rate=-0.001122059109806593)


def jeod_pitching() -> Case:
    """JEOD's RUN_10D: the same satellite with a pitch rate of 0.01 °/s."""
    name = "NASA JEOD, the same with an initial pitch rate, 8 h (NESC check case 10D)"
    return _jeod(name, "RUN_10D", _PITCHING, "JEOD's own steps", pitch_rate=-0.00094752618460716)


def _jeod(code: str, run: str, published: dict, limit: str, *, pitch_rate: float) -> Case:
    return Case(
        code=code,
        source=f"nasa/jeod, {_HEAD}/{run}/log_state_ASCII.csv @6550cf4",
        scheme="extrapolate(satellite, 14), Δt = 60 s; orbits.from_state",
        published={f"{name}, at {t} s": x for t, values in published.items() for name, x in values.items()},
        limit=limit,
        compute=partial(_compute, pitch_rate),
    )


def _compute(pitch_rate: float) -> dict[str, np.ndarray]:
    """The positions, attitudes and rates at both times, by this package."""
    position, velocity = [-4315967.74, 960356.2, 5167269.53], [129.091037, -7491.513855, 1452.515654]
    orbit = orbits.from_state(398600441500000.0, position, velocity)
    satellite = systems.gravity_gradient([500.0, 12250.0, 12250.0], orbit)
    start = satellite.state(np.array(_T0).T, angular_velocity=[-1.958561461497211e-05, pitch_rate, 0.0], t=0.0)
    run = integrate(schemes.extrapolate(satellite, 14), start, 60.0, 480, save_every=5)
    found = {}
    for t in _AT_REST:
        state = jax.tree.map(lambda x, k=t // 300: x[k], run.state)
        ours = {
            "position, m": orbit(float(t))[0],
            "attitude matrix": satellite.free.rotation_matrix(state).T,
            "rates, rad/s": satellite.angular_velocity(state),
        }
        found |= {f"{name}, at {t} s": np.asarray(value) for name, value in ours.items()}
    return found


_RATES = {  # °/s at the times
    2: (-1.75081532854, 23.6495577599, 28.0713200449),
    10: (-2.41890222177, -23.5525695195, 28.12859263),
    20: (-5.42273467991, 22.7159305765, 28.6082817473),
    30: (12.6183907757, -17.3974747619, 31.1195888868),
}


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
