"""4179 Toutatis: its radar fixes, the problem of its spin state, and what the study returns."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._body import longitude_latitude
from lieint_jax.app.scenarios.rigid_body import FreeBody
from lieint_jax.app.studies._flyby import Flyby
from lieint_jax.app.studies._tumbling import mean_periods, model, rotate, rotation_between
from lieint_jax.app.studies.inference import Coverage, Estimate, Params, Problem, Published, StudentT, Unknown
from lieint_jax.fitting import Fit, inertia_ratios, member_by_member
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody

FITTED, MIDDLE = 17, 8  # number of fixes of 1992; index of the middle one, the epoch of the parameters
STATES = {"Zhao et al. 2015": "toutatis", "Takahashi et al. 2013": "toutatis_takahashi"}  # published, as scenarios
QUANTITIES = (
    *("precession period (d)", "rotation period (d)", "momentum, longitude (°)", "momentum, latitude (°)"),
    *("inertia ratio Jx/Jz", "inertia ratio Jy/Jz", "Euler angle α (°)", "Euler angle β (°)", "Euler angle γ (°)"),
    *("body rate x (°/d)", "body rate y (°/d)", "body rate z (°/d)"),
)
HUDSON_OSTRO = (7.35, 5.41)  # precession and rotation period, d; Hudson & Ostro 1995, Science 270:84
_EPOCH = np.datetime64("1992-11-09T17:49:47")


class RadarEpochs(NamedTuple):
    """All published radar fixes of Toutatis: 17 of 1992, one of 2004 and one of 2008."""

    t: np.ndarray  # days since 1992-11-09 17:49:47 UTC, the epoch of the published states, (19,)
    q: np.ndarray  # attitudes as unit quaternions, (19, 4)
    euler_313_deg: np.ndarray  # the same as Euler 3-1-3 angles, as published (°), (19, 3)
    angular_velocity_deg: np.ndarray  # body rates (°/d), (19, 3)
    date: list[str]  # dates, UTC, to the minute


def radar_epochs() -> RadarEpochs:
    """The radar fixes. Source: Takahashi, Busch & Scheeres 2013, AJ 146:95, where no errors are given."""
    lines = resources.files(scenarios).joinpath("toutatis_radar.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line[0].isdigit()]
    days = np.array([np.datetime64(row[0]) - _EPOCH for row in rows]) / np.timedelta64(1, "D")
    numbers = np.array([row[1:] for row in rows], float)
    q = np.asarray(jax.vmap(so3.from_euler_313)(jnp.deg2rad(numbers[:, :3])))
    return RadarEpochs(days, q, numbers[:, :3], numbers[:, 3:], [row[0].replace("T", " ") for row in rows])


def later_fixes() -> tuple[list[str], np.ndarray, np.ndarray]:
    """Dates, days since the published epoch, (3,), and attitudes, (3, 4), of the radar fixes of 2004 and 2008, and of
    Chang'e-2 in 2012: −20.1°, 27.6°, 42.2°, each ± 1° (Zhao et al. 2015).

    The angles of Chang'e-2 are read in the convention of the radar fixes. The inverse rotation is excluded: with the
    direction of the momentum, 2H/|π|² would be 1.5 times as large as in the published states.
    """
    fixes = radar_epochs()
    t = (np.datetime64("2012-12-13T08:30") - _EPOCH) / np.timedelta64(1, "D")
    q = so3.from_euler_313(jnp.deg2rad(jnp.array([-20.1, 27.6, 42.2])))
    dates = [*(day[:10] for day in fixes.date[FITTED:]), "2012-12-13"]
    return dates, np.append(fixes.t[FITTED:], t), np.vstack([fixes.q[FITTED:], q])


def radar_data() -> dict[str, Array]:
    """The fixes of 1992 for the fit, with times in days from the middle one, and the epoch of the published states."""
    fixes = radar_epochs()
    t, q, rate = fixes.t - fixes.t[MIDDLE], fixes.q, fixes.angular_velocity_deg
    data = {"begin": q[MIDDLE], "epoch": -fixes.t[MIDDLE], "q": q[:FITTED], "rate": rate[:FITTED], "t": t[:FITTED]}
    return {name: jnp.asarray(x) for name, x in data.items()}


def published_params(name: str, begin: Array, t: Array) -> Params:
    """The published state of a scenario after time t, as parameters of `model`."""
    scenario = scenarios.load(name)
    body = RigidBody(jnp.asarray(scenario.inertia) / scenario.inertia[2])
    later = body.solution(body.state(scenario.state.attitude(), angular_velocity=scenario.state.rate()), t)
    rate = jnp.rad2deg(body.angular_velocity(later))
    return {"attitude": rotation_between(later.q, begin), "inertia": body.inertia[:2], "rate": rate}


@jax.jit
def path(params: Params, data: dict[str, Array]) -> Array:
    """Attitudes and body rates (°/d), (n, 7), at data["t"], (n,); data["begin"] as in `model`."""
    body, state = model(params, data["begin"])

    def spin_at(t: Array) -> Array:
        later = body.solution(state, t)
        return jnp.concatenate([later.q, jnp.rad2deg(body.angular_velocity(later))])

    return jax.lax.map(spin_at, data["t"])


path_of_fits = member_by_member(path)


def errors(params: Params, data: dict[str, Array]) -> Array:
    """Calculated less observed: rotation vectors in space (°) and body rates (°/d), (2, n, 3)."""
    found = path_of_fits(params, {"begin": data["begin"], "t": data["t"]})
    return jnp.stack([jax.vmap(rotation_between)(found[:, :4], data["q"]), found[:, 4:] - data["rate"]])


def derived(params: Params, data: dict[str, Array]) -> Array:
    """`QUANTITIES`, (12,): the Euler 3-1-3 angles and the body rate are those at the published epoch."""
    body, state = model(params, data["begin"])
    at_epoch = path_of_fits(params, {"begin": data["begin"], "t": data["epoch"][None]})[0]
    euler = jnp.rad2deg(so3.to_euler_313(at_epoch[:4])) % 360
    pole = longitude_latitude(state.p)
    return jnp.concatenate([mean_periods(body, state), pole, params["inertia"], euler, at_epoch[4:]])


def simulate(params: Params, data: dict[str, Array], noise: Array) -> dict[str, Array]:
    """The fixes of a model, rotated and changed by noise, (2, n, 3)."""
    found = path(params, {"begin": data["begin"], "t": data["t"]})
    return data | {"q": jax.vmap(rotate)(noise[0], found[:, :4]), "rate": found[:, 4:] + noise[1]}


@cache
def problem() -> Problem:
    """The unknowns with the published state of Takahashi et al. as first guess, the fixes, and published values."""
    data, scenario = radar_data(), scenarios.load("toutatis")
    start = published_params(STATES["Takahashi et al. 2013"], data["begin"], -data["epoch"])
    unknowns = {
        "attitude": Unknown(("attitude x", "attitude y", "attitude z"), start["attitude"], scatter=10.0),
        "inertia": Unknown(("Jx/Jz", "Jy/Jz"), start["inertia"], inertia_ratios, 0.15),
        "rate": Unknown(("rate x", "rate y", "rate z"), start["rate"], scatter=5.0),
    }
    known = [(p.value, p.error or 0.0, scenario.source(p.source)) for p in scenario.published.values()]
    known += [(period, 0.0, "Hudson & Ostro 1995, Science 270:84") for period in HUDSON_OSTRO]
    published = [Published(QUANTITIES[k % 4], *value) for k, value in enumerate(known)]
    options = {"derived": derived, "quantities": QUANTITIES, "published": published, "simulate": simulate}
    return Problem(unknowns, errors, data, StudentT((8.0, 8.0), 0.01, 100.0), **options)


class Prediction(NamedTuple):
    """Torque-free motion after the fixes of 1992."""

    t: np.ndarray  # days from the middle fix, (times,)
    spread: np.ndarray  # the 5, 50 and 95 % quantiles of the members' angles from the estimate (°), (3, times)
    rms: np.ndarray  # the root mean square of these angles (°), (times,)
    # the angles (°) of the estimate and the published states from the later fixes, by name, (3,) each
    fix_angles: dict[str, np.ndarray]
    member_fix_angles: np.ndarray  # the angles (°) of the members from the later fixes, (members, 3)
    # the share of the members that are farther from the estimate than the later fix is, (3,): small where the fix is
    # outside the spread
    farther_share: np.ndarray
    pole: np.ndarray  # the angle (°) between the momentum of each single radar fix and the fitted one, (19,)
    energy: np.ndarray  # 2H Jz/|π|² of the estimate, and of each attitude with the fitted direction of π, (1 + 20,)


class SpinFit(NamedTuple):
    """The results of the study."""

    fit: Fit  # the fits from the two published states, from one of them with normal errors, and from random starts
    share_at_minimum: float  # the share of the random starts that end in the minimum of the first fit
    estimate: Estimate  # the spin state with its uncertainty
    normal: Estimate  # the estimate for normal errors, by least squares that are not robust
    # calculated less observed attitudes (°) and rates (°/d), by name of the state, (2, 17, 3) each
    residuals: dict[str, np.ndarray]
    weights: np.ndarray  # the weights of attitudes and rates in the fit, (2, 17)
    outlier: np.ndarray  # whether each is an outlier, (2, 17)
    published: dict[str, np.ndarray]  # the derived quantities of the published states, by name, (12,) each
    # the squared distance of each published state from the estimate, by its covariance, by name; for the truth it would
    # be χ² of 8 degrees of freedom
    mahalanobis_squared: dict[str, float]
    prediction: Prediction  # the prediction for 2004, 2008 and 2012
    flyby: Flyby  # the effect of the Earth's torque on 2004-09-29
    # the factors by which the errors of the parameters, and of the noise levels, are enlarged: the ratio of scatter to
    # reported error in the first half of the synthetic sets
    factors: np.ndarray
    coverage: Coverage  # how often the enlarged errors include the truth in the second half
    scenario: FreeBody  # the scenario that holds the published values

    @property
    def periods(self) -> np.ndarray:
        """The mean precession and rotation periods in days, with their standard errors, (2, 2)."""
        return np.stack([self.estimate.values[8:10], self.estimate.sigmas[8:10]], axis=1)
