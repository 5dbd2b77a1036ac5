"""The spin state of 4179 Toutatis from its radar fixes of 1992, and what torque-free motion predicts for later fixes.

Eight parameters (attitude, body rate, two ratios of inertia) and two noise levels are fitted to the 17 attitudes and
body rates of 1992. No errors are published with them, so all attitudes have the same weight, and so have all rates, by
the two noise levels. Some fixes are far from any solution: the errors are modeled by Student's t with 4 degrees of
freedom, whose tails make the fit robust against outliers. The motion between fixes is the closed form of the free body.

The covariance is tested on synthetic data sets of the fitted model; the prediction is that of an ensemble.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax import orbits, plots
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._body import longitude_latitude
from lieint_jax.app.scenarios.rigid_body import FreeBody
from lieint_jax.app.studies import _flyby
from lieint_jax.app.studies._flyby import Flyby
from lieint_jax.app.studies.inference import coverage_cells, draw_pulls, published_lines, table
from lieint_jax.fitting import (
    DEGREES_OF_FREEDOM,
    Fit,
    inertia_ratios,
    inference,
    member_by_member,
    student_t_noise_error,
    student_t_weights,
)
from lieint_jax.fitting.inference import Coverage, Estimate, Params, Problem, Published, StudentT, Unknown
from lieint_jax.fitting.tumbling import mean_periods, model, rotate, rotation_between
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import vectors

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
def spin_problem() -> Problem:
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


__all__ = ["RadarEpochs", "SpinFit", "draw", "model", "radar_epochs", "run", "text"]

_NORMAL = 1e8  # degrees of freedom of Student's t for a normal distribution
_FAR = 18.8  # |e|²/σ²: any of 34 normal vectors of three components exceeds it with a probability of 0.01

# Least distance: Busch et al. 2012, AGU Fall Meeting, P31A-1873. Elements of the orbit about the Sun at JD 2454797.5 as
# encyclopaedias quote them from JPL's Small-Body Database: enough for an order of magnitude, not checked there.
_FLYBY_DISTANCE = 0.01036 * _flyby.AU
_ELEMENTS = 2.5321, 0.6288, np.deg2rad(0.446)  # semi-major axis (au), eccentricity, inclination
_CHANGE = 0.08  # °/d, the largest change of the spin by the flyby of 2004: Busch et al. 2012, AGU, P31A-1873
_TO_2008 = 1516.0  # days from that flyby, 2004-09-29, to the fix of 2008-11-23


def run(quick: bool = False, progress: bool = True) -> SpinFit:
    """Fit, compare, predict, and test the uncertainty; `quick` uses a fifth of the synthetic sets and members."""
    sets, members = (20, 200) if quick else (100, 1000)
    problem, data = spin_problem(), radar_data()
    origin = data["begin"], -data["epoch"]
    given = {name: published_params(scenario, *origin) for name, scenario in STATES.items()}
    # From both published states, from the first with normal errors, and from random states about the second. Their
    # number is that of synthetic sets, so that one compiled program fits both.
    zhao, takahashi = (p | {"noise": problem.levels["noise"]} for p in given.values())
    random = inference.random_starts(problem, 2 * sets - 3, 17)
    three = jax.tree.map(lambda a, b: jnp.stack([a, b, a]), zhao, takahashi)
    guesses = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), three, random)
    many, freedom = inference.repeat(data, 2 * sets), np.full(2 * sets, DEGREES_OF_FREEDOM)
    freedom[2] = _NORMAL
    found = inference.fit_starts(problem, guesses, many, freedom, progress)
    states = inference.estimates(problem, found, many, freedom, range(3))
    estimate, normal = (jax.tree.map(lambda leaf, k=k: leaf[k], states) for k in (0, 2))
    factors, test = inference.calibrate_errors(problem, estimate, sets, 1992, progress)
    estimate = inference.enlarge_errors(estimate, factors[0])
    compared = {"fitted": problem.unravel(estimate.x), **given}
    residuals = {name: np.asarray(errors(p, data)) for name, p in compared.items()}
    e, noise = residuals["fitted"], estimate.noise[:, None]
    difference = np.stack([np.asarray(ravel_pytree(p)[0]) - estimate.x for p in given.values()])
    distances = inference.squared_distances(difference, estimate.covariance[None])
    body, state = model(problem.unravel(estimate.x), data["begin"])
    speed = _flyby.EARTH_SPEED * float(orbits.encounter_speed(*_ELEMENTS))
    assert found.starts is not None
    return SpinFit(
        found,
        float((np.abs(found.starts.loss[3:] - found.starts.loss[0]) < 1e-4).mean()),
        estimate,
        normal,
        residuals,
        np.asarray(student_t_weights(jnp.asarray(e), jnp.asarray(noise))),
        (e**2).sum(axis=-1) > _FAR * noise**2,
        {name: np.asarray(derived(p, data)) for name, p in given.items()},
        dict(zip(given, distances.tolist(), strict=True)),
        _predict(problem, estimate, given, members),
        _flyby.passage(body, state, _FLYBY_DISTANCE, speed, members),
        factors,
        test,
        scenarios.load("toutatis"),
    )


def _predict(problem: Problem, estimate: Estimate, given: dict[str, Params], members: int) -> Prediction:
    """Predict the motion of the estimate, of both published states, and of members drawn from the covariance."""
    fixes, begin, (_, later_t, later_q) = radar_epochs(), problem.data["begin"], later_fixes()
    t = np.append(np.geomspace(1, 8000, 60), later_t - fixes.t[MIDDLE])

    def attitudes(params: Params) -> Array:
        body, state = model(params, begin)
        return jax.vmap(lambda t: body.solution(state, t).q)(jnp.asarray(t))

    x = np.stack([estimate.x, *(ravel_pytree(p)[0] for p in given.values())])
    drawn = inference.draw_members(estimate, members, 2004)
    q = jnp.asarray(inference.predict(problem, attitudes, np.concatenate([x, drawn])))
    angles = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (None, 0))(q[0], q[len(x) :]))
    off = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (0, None))(q[:, -3:], jnp.asarray(later_q)))
    body, state = model(problem.unravel(estimate.x), begin)
    rate = jnp.asarray(np.deg2rad(fixes.angular_velocity_deg))
    p = jax.vmap(so3.Ad)(jnp.asarray(fixes.q), body.inertia * rate)
    every = jnp.concatenate([state.q[None], jnp.asarray(fixes.q), jnp.asarray(later_q[-1:])])
    Pi = np.asarray(jax.vmap(so3.Ad_star, (0, None))(every, state.p / jnp.linalg.norm(state.p)))
    return Prediction(
        t[:-3],
        np.percentile(angles[:, :-3], (5, 50, 95), axis=0),
        np.sqrt((angles[:, :-3] ** 2).mean(axis=0)),
        dict(zip(("fitted", *given), off, strict=False)),
        off[len(x) :],
        (angles[:, -3:] >= off[0]).mean(axis=0),
        np.rad2deg(jax.vmap(vectors.angle, (None, 0))(state.p, p)),
        (Pi**2 / np.asarray(body.inertia)).sum(axis=1),
    )


def text(found: SpinFit) -> str:
    """The report of the study, as text."""
    parts = (_head, _residual_table, _comparison, _prediction, _torque, _coverage)
    return "\n".join(line for part in parts for line in part(found))


def _head(found: SpinFit) -> list[str]:
    noise, normal = found.estimate.noise, found.normal.noise
    error = student_t_noise_error(FITTED, 3) * found.factors[1]
    ours, sigma = found.estimate.values[8:], found.estimate.sigmas[8:]
    other = found.normal.values[8:]
    moved = max(abs(inference.pull(*row)) for row in zip(QUANTITIES, ours, sigma, other, strict=True))
    assert found.fit.starts is not None
    return [
        f"{found.scenario.title}: spin state, inertia ratios and noise from the {FITTED} radar fixes of 1992",
        f"  fixes: {found.scenario.source('takahashi')}, without errors: attitudes have one weight, and so have rates",
        f"  {found.fit.outcome}; {100 * found.share_at_minimum:.0f} % of {len(found.fit.starts.loss) - 3} random "
        "starts end there",
        f"  noise, fitted: attitudes {noise[0]:.2f} ± {noise[0] * error:.2f}°, rates {noise[1]:.2f} ± "
        f"{noise[1] * error:.2f} °/d (scales of Student's t, {DEGREES_OF_FREEDOM:g} degrees of freedom)",
        f"  with normal errors instead: {normal[0]:.2f}°, {normal[1]:.2f} °/d, and the values below change by up to "
        f"{moved:.1f} σ",
    ]


def _residual_table(found: SpinFit) -> list[str]:
    size = np.stack([np.linalg.norm(found.residuals[name], axis=-1) for name in ("fitted", *STATES)])
    heads = ("fitted", "weight", "Zhao", "Takahashi")
    rows: list[tuple[str, ...]] = [("", *heads, *heads)]
    columns = size.T, found.weights.T, found.outlier.T
    for date, sizes, weights, outlier in zip(radar_epochs().date, *columns, strict=False):
        cells = (
            (f"{ours:.2f}{' *'[int(far)]}", f"{weight:.2f}", f"{zhao:.1f}", f"{takahashi:.1f}")
            for (ours, zhao, takahashi), weight, far in zip(sizes, weights, outlier, strict=True)
        )
        rows.append((date, *(cell for kind in cells for cell in kind)))
    rms = ((f"{ours:.2f} ", "", f"{z:.2f}", f"{t:.2f}") for ours, z, t in np.sqrt((size**2).mean(-1)).T)
    rows.append(("rms", *(cell for kind in rms for cell in kind)))
    return [
        f"\n  {'|calculated − observed|':<31}{'attitude (°)':<38}body rate (°/d)",
        *table(rows),
        "  * an outlier: with normal errors of the fitted noise, 1 of 100 such tables has a residual as large",
    ]


def _comparison(found: SpinFit) -> list[str]:
    value, sigma = found.estimate.values[8:], found.estimate.sigmas[8:]
    rows: list[tuple[str, ...]] = [("", "fitted", "± 1σ", "Zhao", "", "Takahashi")]
    for k, name in enumerate(QUANTITIES):
        others = (float(found.published[state][k]) for state in STATES)
        each = ((f"{x:.3f}", f"{inference.pull(name, value[k], sigma[k], x):+.1f} σ") for x in others)
        rows.append((name, f"{value[k]:.3f}", f"{sigma[k]:.3f}", *(cell for pair in each for cell in pair)))
    distances, tested = found.mahalanobis_squared.values(), found.coverage.mahalanobis_squared
    beyond = " and ".join(
        f"{d:.0f} ({(tested > d).sum()} of {len(tested)} synthetic sets are farther off)" for d in distances
    )
    return [
        "",
        *table(rows),
        "  (angles and rates at 1992-11-09 17:49:47 UTC; right, values of the published states, with the inertia of",
        f"  {found.scenario.source('takahashi')}, and their difference from ours)",
        "  all eight parameters together, at the middle fix: squared distances by the covariance, 8 expected, of Zhao",
        f"  and Takahashi: {beyond}",
        "\n  published values:",
        *published_lines(QUANTITIES, found.estimate, spin_problem().published),
    ]


def _prediction(found: SpinFit) -> list[str]:
    p = found.prediction
    low, high = np.percentile(p.member_fix_angles, (5, 95), axis=0)
    rows = [("", *later_fixes()[0])]
    rows += [(name, *(f"{x:.1f}" for x in off)) for name, off in p.fix_angles.items()]
    rows += [("members, 5 to 95 %", *(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True)))]
    rows += [("members farther off", *(f"{100 * share:.0f} %" for share in p.farther_share))]
    pole = p.pole[:FITTED][~found.outlier[1]]
    single, early = np.sqrt((pole**2).mean()), p.energy[1 : 1 + FITTED][~found.outlier[0]]
    verdict = "No miss is outside the spread" if p.farther_share.min() > 0.05 else "Some misses are outside the spread"
    first, second = (np.interp(angle, p.rms, p.t) for angle in (30, 90))
    return [
        "\n  torque-free prediction of later fixes, by radar and, in 2012, by Chang'e-2: angle from the fix (°)",
        *table(rows, "    "),
        f"  {verdict} of the fit's own uncertainty: the members spread by 30° rms after {first:.0f} days,",
        f"  by 90° after {second:.0f}, by {p.rms[-1]:.0f}° at the end (random attitudes: 132°).",
        f"  The direction of the momentum differs from the fitted one by {single:.1f}° rms in single fixes of 1992, by",
        f"  {p.pole[-2]:.1f}° and {p.pole[-1]:.1f}° in those of 2004 and 2008; 2H Jz/|π|² is {p.energy[0]:.3f} fitted,",
        f"  {early.mean():.3f} ± {early.std():.3f} for single attitudes of 1992, "
        f"{', '.join(f'{x:.3f}' for x in p.energy[-3:])} for the later ones.",
    ]


def _torque(found: SpinFit) -> list[str]:
    f, (value, error) = found.flyby, found.periods.T
    own = 360 * error / value**2  # of the mean rates of precession and rotation, 360°/period
    rms, most = np.sqrt((f.rates**2).mean(axis=0)), np.abs(f.rates[:, 0]).max()
    change, usual, worst = 100 * np.sqrt((f.momentum**2).mean()), _TO_2008 * rms[0], _TO_2008 * most
    return [
        "\n  the Earth's torque in the flyby of 2004-09-29, in order of magnitude, over all phases and directions:",
        f"    a hyperbola of least distance {f.distance / _flyby.AU:.5f} au, {f.speed:.2f} km/s at infinity",
        "    (elements quoted from JPL's Small-Body Database, not checked there; the Earth on a circle)",
        f"    momentum: changes by {change:.2f} % rms, rotates by {f.pole.max():.2f}° at most",
        f"    precession rate: {rms[0]:.3f} °/d rms, {most:.2f} at most; rotation rate: {rms[1]:.4f} rms",
        f"    published: {_CHANGE} °/d at most   (Busch et al. 2012, AGU Fall Meeting, P31A-1873)",
        f"  By the fix of 2008 this change of rate adds up to {usual:.0f}° rms, {worst:.0f}° at most, even from",
        "  a state known exactly.",
        f"  The fit of 1992 determines the two rates to ± {own[0]:.2f} and ± {own[1]:.2f} °/d.",
    ]


def _coverage(found: SpinFit) -> list[str]:
    c, names = found.coverage, spin_problem().names
    one, two, _ = inference.shares(c.pulls[:, :8])
    labels = (*names, "log noise, attitudes", "log noise, rates", *QUANTITIES[:4])
    sets, chance = len(c.pulls), inference.chance_errors(len(c.pulls))
    rows = [
        ("", "within 1σ", "within 2σ", "rms/σ"),
        *((label, *cells) for label, cells in zip(labels, coverage_cells(c.pulls), strict=False)),
        ("mean of the parameters", f"{one.mean():.1f}%", f"{two.mean():.1f}%", f"{c.scatter(8)[0]:.2f}"),
        ("expected of each", "68.3%", "95.4%", "1"),
    ]
    lines = table(rows)
    inside = 100 * (c.mahalanobis_squared <= inference.chi_square_point(8)).mean()
    return [
        f"\n  errors: those of the observed information, enlarged by {found.factors[0]:.3f} (noise levels: "
        f"{found.factors[1]:.3f}), which is",
        f"  the ratio of scatter to error in {sets} synthetic sets of the fitted model; a test by {sets} other sets "
        f"({int(c.success.sum())} fits succeeded):",
        *lines[:-1],
        f"{lines[-1]}   ± {chance.within_1:.1f} %, {chance.within_2:.1f} % by chance",
        f"  truth inside the joint 95 % ellipsoid: {inside:.0f} % of the sets",
    ]


_MARKS = {"fitted": ("o", plots.INK), "Zhao et al. 2015": ("^", plots.RED), "Takahashi et al. 2013": ("s", plots.BLUE)}
_DECEMBER = 20.2571  # days from the published epoch, 1992-11-09 17:49:47, to 1992-11-30 00:00
_TITLES = (
    "17 radar fixes of 1992: attitudes",
    "the same: body rates",
    "torque-free to the fixes of 2004, 2008 and 2012",
    "mean periods",
    "direction of the angular momentum",
    "reported errors in synthetic data",
)


@plots.style()
def draw(found: SpinFit) -> Figure:
    """Plot the residuals, the prediction, momentum and periods with published values, and the test of the errors."""
    fig, axes = plots.figure(3, 2)
    for kind, (ax, label) in enumerate(zip(axes[0, :2], ("attitude error (°)", "body rate error (°/d)"), strict=True)):
        _draw_residuals(ax, found, kind, label)
    _draw_prediction(axes[0, 2], found)
    _draw_pair(axes[1, 0], found, 0, "precession of the long axis (d)", "rotation about the long axis (d)")
    axes[1, 0].plot(*HUDSON_OSTRO, "D", color=plots.GRAY, mec=plots.INK, ms=6, label="Hudson & Ostro 1995")
    _draw_pair(axes[1, 1], found, 2, "ecliptic longitude (°)", "ecliptic latitude (°)")
    for ax in axes[1, :2]:
        ax.legend(loc="best")
    draw_pulls(axes[1, 2], found.coverage.pulls[:, :8])
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(found.scenario.title)
    return fig


def _look(name: str) -> tuple[str, Any]:
    """The marker of a state, and its look."""
    mark, color = _MARKS[name]
    return mark, {"color": color, "mfc": color if name == "fitted" else "none", "ms": 5}


def _draw_residuals(ax: Axes, found: SpinFit, kind: int, label: str) -> None:
    """Plot the size of each residual by date, with outliers ringed, and the fitted noise level."""
    day, outlier = radar_epochs().t[:FITTED] - _DECEMBER, found.outlier[kind]
    sizes = {name: np.linalg.norm(found.residuals[name][kind], axis=-1) for name in _MARKS}
    for name, size in sizes.items():
        mark, look = _look(name)
        ax.plot(day, size, mark, label=name, **look)
    ringed = day[outlier], sizes["fitted"][outlier]
    ax.plot(*ringed, "o", ms=13, mfc="none", mec=plots.INK, mew=1.0, label="outlier of the fit")
    level = np.sqrt(3) * float(found.estimate.noise[kind])
    ax.axhline(level, color=plots.INK, lw=0.8, ls="--", label="√3 × fitted noise")
    top = max(size.max() for size in sizes.values())
    ax.set(xlabel="December 1992 (UTC)", ylabel=label, ylim=(0, 1.55 * top), xticks=range(3, 19, 3))
    ax.legend(ncols=2, loc="upper center")


def _draw_prediction(ax: Axes, found: SpinFit) -> None:
    """Plot the spread of the members against time, and the angles of predictions from the later fixes."""
    p, (dates, t, _) = found.prediction, later_fixes()
    label = "members about the estimate, 5–95 %"
    ax.fill_between(p.t, p.spread[0], p.spread[2], color=plots.GRAY, alpha=0.5, lw=0, label=label)
    ax.plot(p.t, p.rms, color=plots.INK, lw=1.2, label="the same, rms")
    later = t - radar_epochs().t[MIDDLE]
    for name, label in zip(_MARKS, ("predictions from the fix, marks as in (a)", None, None), strict=True):
        mark, look = _look(name)
        ax.plot(later, p.fix_angles[name], mark, label=label, **look)
    for day, date, height in zip(later, dates, (190, 204, 218), strict=True):
        ax.annotate(date[:4], (day, height), ha="center", va="bottom", fontsize="x-small")
        ax.plot([day, day], [0, height], color=plots.GRAY, lw=0.6, zorder=0)
    ax.set(xscale="log", xlim=(5, 14000), ylim=(0, 270), yticks=range(0, 181, 30))
    ax.set(xlabel="days after 1992-12-10", ylabel="angle (°)")
    ax.legend(loc="upper left")


def _draw_pair(ax: Axes, found: SpinFit, first: int, xlabel: str, ylabel: str) -> None:
    """Plot two derived quantities with their 1σ and 2σ ellipses, and the published states and values."""
    pair = slice(first, first + 2)
    center, matrix = found.estimate.derived[pair], found.estimate.derived_covariance[pair, pair]
    for radius, dashes in ((1, "-"), (2, "--")):
        ax.plot(*inference.ellipse(center, matrix, radius).T, dashes, color=plots.INK, lw=1)
    ax.plot(*center, "o", color=plots.INK, ms=5, label="fitted, ellipses of 1σ, 2σ")
    for name, values in found.published.items():
        mark, look = _look(name)
        ax.plot(*values[pair], mark, label=f"state of {name}", **{**look, "ms": 6})
    x, y = list(found.scenario.published.values())[pair]
    ax.errorbar(x.value, y.value, y.error, x.error, "x", color=plots.RED, ms=5, lw=1, label="Zhao et al., as published")
    (x, y), (dx, dy) = center, 2.4 * np.sqrt(np.diagonal(matrix))
    ax.locator_params(nbins=6)
    ax.set(xlabel=xlabel, ylabel=ylabel, xlim=(x - dx, x + dx), ylim=(y - dy, y + 2 * dy))
