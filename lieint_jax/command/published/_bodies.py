"""Rigid bodies, free and with wheels, torques, gravity or a weight, as other codes have computed them."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import attitude, orbits, schemes, systems, torques
from lieint_jax._checks import Attitude
from lieint_jax.command.published._case import case
from lieint_jax.groups import so3
from lieint_jax.runs import integrate

_CLOSED_FORM = "rigid_body(…).solution, the closed form"
_GAUSS = "gauss(top, 8), Δt = 0.001 s"
_ORBITING = "extrapolate(satellite, 14), Δt = 60 s; orbits.from_state"
_SPACECRAFT, _SPIN = [500.0, 200.0, 300.0], [0.5, -0.4, 0.7]  # of Basilisk, kg m², rad/s
_T0 = [  # of JEOD
    [-0.6443912269484258, 0.0528421023505859, 0.762868048125672],
    [-0.7615617871967408, -0.1345758406652156, -0.6339660774765135],
    [0.0691635085403311, -0.9894933326346473, 0.1269620169892195],
]
_WEIGHED = 15.0 * 9.81 * np.array([0.0, 1.0, 0.0])  # N m: the weight times the arm, of the top of Brüls et al.


@case("jeod_10c", _ORBITING)
def jeod_gravity_gradient() -> dict[str, np.ndarray]:
    """NASA's satellite under the gravity gradient on an ellipse for 8 h: JEOD's RUN_10C, NESC check case 10C."""
    return _jeod(-0.001122059109806593)


@case("jeod_10d", _ORBITING)
def jeod_pitching() -> dict[str, np.ndarray]:
    """JEOD's RUN_10D: the same satellite with a pitch rate of 0.01 °/s."""
    return _jeod(-0.00094752618460716)


def _jeod(pitch_rate: float) -> dict[str, np.ndarray]:
    """The positions, attitudes and rates at both published times."""
    orbit = orbits.from_state(
        398600441500000.0, [-4315967.74, 960356.2, 5167269.53], [129.091037, -7491.513855, 1452.515654]
    )
    satellite = systems.gravity_gradient([500.0, 12250.0, 12250.0], orbit)
    start = satellite.state(np.array(_T0).T, angular_velocity=[-1.958561461497211e-05, pitch_rate, 0.0], t=0.0)
    run = integrate(schemes.extrapolate(satellite, 14), start, 60.0, 480, save_every=5)
    found = {}
    for t in (300, 28800):
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


@case("tumbling_brick", _CLOSED_FORM)
def tumbling_brick() -> dict[str, np.ndarray]:
    """NASA's check case of a tumbling brick without damping."""
    body = systems.rigid_body([0.00189422, 0.006211019, 0.007194665])  # slug ft²
    start, times = body.state(angular_velocity=np.deg2rad([10.0, 20.0, 30.0])), (2, 10, 20, 30)
    ends = jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(np.array(times, float))
    return {f"rates at {t} s, °/s": np.rad2deg(end) for t, end in zip(times, np.asarray(ends), strict=True)}


@case("algorithm_903_free", _CLOSED_FORM)
def algorithm_903_free() -> dict[str, np.ndarray]:
    """Celledoni & Zanna: the motion in closed form with matrices (example 0) and with quaternions (example 2)."""
    body = systems.rigid_body([1.0, 1.648785782711929, 1.9720127096641928])
    Pi = [-0.709894965287627, -0.685144717153487, 0.163174308075589]
    rotated = [  # the first attitude of example 0
        [-0.139359936806125, -0.726901415681411, -0.672453076350874],
        [-0.414251479478192, -0.574008408466476, 0.706335655874678],
        [-0.899430108326112, 0.376999574124619, -0.221126211350745],
    ]
    first, second = (
        body.solution(body.state(attitude, body_momentum=Pi), 0.1) for attitude in (rotated, [1.0, 0.0, 0.0, 0.0])
    )
    return {
        "body momentum at 0.1": np.asarray(body.body_momentum(second)),
        "attitude matrix at 0.1, example 0": np.asarray(body.rotation_matrix(first)),
        "quaternion at 0.1, example 2": np.asarray(second.q),
    }


@case("algorithm_903_top", "nystrom(top, 6, drift=exact(top.free)), the same scheme, Δt = 0.5")
def algorithm_903_top() -> dict[str, np.ndarray]:
    """A top whose moments of inertia break the triangle inequality, as no body's do."""
    pull = np.array([9.558630354723854e-05, 0.00048777318247201465, -0.0008677214881719239])  # in space
    size = float(np.linalg.norm(pull))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*triangle inequality")
        top = systems.heavy_top([1.0, 1.0126869887825154, 3.3062374224730378], [0, 0, size], axis=pull / size)
    start = top.state(body_momentum=[-0.34790957088547336, -0.19822914599675923, -0.9163318919276364])
    run = integrate(schemes.nystrom(top, 6, drift=schemes.exact(top.free)), start, 0.5, 51)
    found = {}
    for t, k in ((10.5, 21), (25.5, 51)):
        state = jax.tree.map(lambda x, k=k: x[k], run.state)
        found[f"body momentum at {t}"] = np.asarray(so3.Ad_star(state.q, state.p))
        found[f"attitude matrix at {t}"] = np.asarray(so3.to_matrix(state.q))
    return found


@case("van_zon_schofield", _CLOSED_FORM)
def van_zon_schofield() -> dict[str, np.ndarray]:
    """Their program's closed form; the times are sums of its steps of 1/60 s, to the last bit."""
    times = (1.0000000000000013, 4.999999999999988, 9.983333333333409)
    body = systems.rigid_body([10.0, 20.0, 26.0])
    start = body.state(angular_velocity=[1.0, 15.0, 1.0])
    ends = [body.solution(start, t) for t in times]
    rates = [np.asarray(body.angular_velocity(end)) for end in ends]
    matrix = {f"attitude matrix, space to body, at {times[1]} s": np.asarray(body.rotation_matrix(ends[1])).T}
    return matrix | {f"rates at {t} s, rad/s": rate for t, rate in zip(times, rates, strict=True)}


@case("basilisk_free", _CLOSED_FORM)
def basilisk_free_body() -> dict[str, np.ndarray]:
    """Basilisk's test of a free spacecraft."""
    return _basilisk((1.0, 0.0, 0.0, 0.0))


@case("basilisk_momentum_frame", _CLOSED_FORM)
def basilisk_momentum_frame() -> dict[str, np.ndarray]:
    """The same spacecraft in a frame whose third axis opposes its angular momentum."""
    third = -np.array(_SPACECRAFT) * _SPIN
    third /= np.linalg.norm(third)
    second = np.array([-third[1] / third[0], 1.0, 0.0])
    second /= np.linalg.norm(second)
    return _basilisk(np.array([np.cross(second, third), second, third]))


def _basilisk(start: Attitude) -> dict[str, np.ndarray]:
    body = systems.rigid_body(_SPACECRAFT)
    end = body.solution(body.state(start, angular_velocity=_SPIN), 10.0)
    return {"MRP at 10 s": np.asarray(attitude.to_mrp(end.q))}


@case("basilisk_wheels", "compose(torqued_midpoint(body), 4) with torques.wheels, Δt = 0.005 s")
def basilisk_wheels() -> dict[str, np.ndarray]:
    """Basilisk's spacecraft with three balanced wheels; the third motor is limited to the largest torque of 0.2 N m."""
    axes, moments = jnp.eye(3), jnp.full(3, 100 / (6000 * 2 * np.pi / 60))  # kg m²: 100 N m s at 6000 rpm
    locked = jnp.array([900.0, 800.0, 600.0])
    speeds = jnp.array([500.0, 200.0, -150.0]) * (2 * np.pi / 60)
    law = torques.wheels(axes, moments, _motors, max_torque=0.2, speeds=speeds)
    body = systems.torqued_body(torques.body_inertia(locked, axes, moments), law)
    start = body.state(angular_velocity=[0.08, 0.01, 0.0], t=0.0)
    step = schemes.compose(schemes.torqued_midpoint(body), 4)
    end = integrate(step, start, 0.005, 200, save_every=200)  # the motors stop where a step ends
    return {"MRP at 1 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}


def _motors(t: Array, q: Array, Omega: Array, h: Array) -> Array:
    """The motors' torques: 0.2, 0.1 and −0.5 N m until 0.5 s, then 0."""
    return jnp.where(t < 0.5, jnp.array([0.2, 0.1, -0.5]), 0.0)


@case("basilisk_constant_torque", "compose(torqued_midpoint(body), 6) with torques.thruster, Δt = 0.05 s")
def basilisk_constant_torque() -> dict[str, np.ndarray]:
    """A constant torque for 10 min; Basilisk's step explains the difference (`test_published_misfits.py`)."""
    law = torques.thruster([-1.0, 1.0, -1.0], 0.0, 600.0)  # N m
    body = systems.torqued_body([900.0, 800.0, 600.0], law)  # kg m²
    start = body.state(attitude.from_mrp([0.1, 0.2, -0.3]), angular_velocity=[0.001, -0.01, 0.03], t=0.0)
    step = schemes.compose(schemes.torqued_midpoint(body), 6)
    end = integrate(step, start, 0.05, 12000, save_every=12000)
    return {"MRP at 600 s": np.asarray(attitude.to_mrp(end.state.q[-1]))}


def _heavy_top() -> tuple[Array, Array]:
    """Quaternions and angular velocities in the body for 2 s, every 0.01 s.

    The top is the benchmark of the multibody community: Brüls, Cardona & Arnold 2012.
    """
    top = systems.heavy_top([15.234375, 0.46875, 15.234375], _WEIGHED)
    start = top.state(angular_velocity=[0.0, 150.0, -4.61538])
    run = integrate(schemes.gauss(top, 8), start, 0.001, 2000, save_every=10)
    return run.state.q, jax.vmap(top.free.angular_velocity)(run.state)


@case("kynema_heavy_top", _GAUSS)
def kynema_heavy_top() -> dict[str, np.ndarray]:
    """A test of kynema, whose reference has an error of 1e-6."""
    q, arm = _heavy_top()[0][-1], np.array([0.0, 1.0, 0.0])  # m, from the point to the center of mass
    return {
        "displacement of the center at 2 s, m": np.asarray(so3.Ad(q, arm)) - arm,
        "quaternion at 2 s": np.asarray(q),
    }


@case("exudyn_heavy_top", _GAUSS)
def exudyn_heavy_top() -> dict[str, np.ndarray]:
    """Tests of Exudyn by its explicit Lie group methods, which quote converged numbers."""
    rates = np.asarray(jax.vmap(so3.Ad)(*_heavy_top()))[:, 1]
    quantity = "angular velocity about the space axis y at {} s, rad/s"
    return {quantity.format("0.01"): rates[1], quantity.format("2"): rates[-1]}


@case("kynema_precession", _CLOSED_FORM)
def kynema_precession() -> dict[str, np.ndarray]:
    """kynema's precessing body; its first step explains the difference (`test_published_misfits.py`)."""
    body = systems.rigid_body([1.0, 1.0, 0.5])
    end = body.solution(body.state(angular_velocity=[0.5, 0.5, 1.0]), 5.0)
    q = np.asarray(end.q)
    return {"quaternion at 5 s": q if q[0] < 0 else -q}
