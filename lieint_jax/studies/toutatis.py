"""The spin state of 4179 Toutatis from its radar fixes of 1992, and what torque-free motion predicts for 2004 and 2008.

Eight parameters (attitude, body rate, two ratios of inertia) and two noise levels are fitted to the 17 attitudes and
body rates of 1992. No errors are published with them, so each attitude has the same weight and each rate too, by the
two noise levels. Some fixes are far off any solution: the errors are taken for Student's t with 4 degrees of freedom,
whose tails let the fit find its outliers by itself. The motion between fixes is the closed form of the free body.

The covariance is put to the test by synthetic data sets of the fitted model; the prediction is that of an ensemble.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

from lieint_jax import scenarios
from lieint_jax.fitting._fit import Fit
from lieint_jax.fitting._robust import FREEDOM, student_t_weights
from lieint_jax.groups import so3
from lieint_jax.studies import _flyby, _toutatis_picture
from lieint_jax.studies._flyby import Flyby
from lieint_jax.studies._radar import RadarEpochs, dates, errors, model, path, radar_epochs
from lieint_jax.studies._spin_fit import Coverage, Estimate, coverage, derived, estimates, fitted, repeated
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

__all__ = ["RadarEpochs", "SpinFit", "draw", "model", "radar_epochs", "run", "text"]

FITTED, MIDDLE = 17, 8  # the number of fixes of 1992, and the one in their middle, where the parameters are
STATES = {"Zhao et al. 2015": "toutatis", "Takahashi et al. 2013": "toutatis_takahashi"}
_NORMAL = 1e8  # degrees of freedom of Student's t for a normal distribution
_FAR = 18.8  # |e|²/σ² that one of 34 normal vectors of three components exceeds with a probability of .01

# Least distance and published effect: Busch et al. 2012, AGU Fall Meeting, P31A-1873. Elements of the orbit about the
# Sun at JD 2454797.5: JPL Small-Body Database, in the public domain.
FLYBY_DISTANCE = 0.01036 * _flyby.AU
ELEMENTS = {"semi_major_axis": 2.5321, "eccentricity": 0.6288, "inclination_deg": 0.446}
PUBLISHED_CHANGE = 0.08  # °/d, the largest change of the spin by the flyby of 2004
_TO_2008 = 1516.0  # days from that flyby, 2004-09-29, to the fix of 2008-11-23

NAMES = (
    "precession period (d)",
    "rotation period (d)",
    "momentum, longitude (°)",
    "momentum, latitude (°)",
    "inertia ratio Jx/Jz",
    "inertia ratio Jy/Jz",
    "Euler angle α (°)",
    "Euler angle β (°)",
    "Euler angle γ (°)",
    "body rate x (°/d)",
    "body rate y (°/d)",
    "body rate z (°/d)",
)


class Prediction(NamedTuple):
    """Torque-free motion after the fixes of 1992.

    Attributes:
        t: days from the middle fix, (times,).
        spread: 5, 50 and 95 % of the members' angles from the estimate (°), (3, times).
        rms: their root mean square (°), (times,).
        off: angles (°) of the estimate and the published states from the fixes of 2004 and 2008, by name, (2,) each.
        members_off: those of the members, (members, 2).
        pole: angle (°) of the momentum that a single fix gives from the fitted one, (19,).
    """

    t: np.ndarray
    spread: np.ndarray
    rms: np.ndarray
    off: dict[str, np.ndarray]
    members_off: np.ndarray
    pole: np.ndarray


class SpinFit(NamedTuple):
    """The results of the study.

    Attributes:
        fit: from the two published states, one of them once more with normal errors, and random starts.
        same: the share of the random starts that end in the same minimum.
        estimate: the spin state with its uncertainty.
        normal: the estimate with normal errors, that is by least squares without robustness.
        residuals: calculated less observed attitudes (°) and rates (°/d) by name of the state, (2, 17, 3) each.
        weights: of attitudes and rates in the fit, (2, 17).
        outlier: whether each is an outlier, (2, 17).
        published: the derived quantities of the published states, by name, (12,) each.
        apart: squared distance of each published state from the estimate by its covariance: χ² of 8.
        prediction: for 2004 and 2008.
        flyby: the Earth's torque on 2004-09-29.
        coverage: how often the uncertainty holds the truth.
        scenario: the scenario that holds the published values.
    """

    fit: Fit
    same: float
    estimate: Estimate
    normal: Estimate
    residuals: dict[str, np.ndarray]
    weights: np.ndarray
    outlier: np.ndarray
    published: dict[str, np.ndarray]
    apart: dict[str, float]
    prediction: Prediction
    flyby: Flyby
    coverage: Coverage
    scenario: Any

    @property
    def periods(self) -> np.ndarray:
        """Mean precession and rotation period in days, and their standard errors, (2, 2)."""
        sigma = np.sqrt(np.diagonal(self.estimate.derived_covariance))
        return np.stack([np.asarray(self.estimate.derived)[:2], sigma[:2]], axis=1)


def run(quick: bool = False, progress: bool = True) -> SpinFit:
    """Fit, compare, predict, and test the uncertainty; `quick` takes 20 synthetic sets for 100, 100 members for 1000."""
    sets, members = (20, 100) if quick else (100, 1000)
    data = radar_data()
    given = {name: published_params(scenario, data["begin"], -data["epoch"]) for name, scenario in STATES.items()}
    found, many = _from_many_starts(list(given.values()), data, sets, progress)
    assert found.starts is not None
    three = jax.tree.map(lambda leaf: leaf[:3], (found.starts.params, many))
    states = estimates(*three)
    estimate, normal = (jax.tree.map(lambda leaf, k=k: leaf[k], states) for k in (0, 2))
    unravel = ravel_pytree(next(iter(given.values())))[1]
    paths = {"fitted": path(unravel(estimate.x), data)} | {name: path(p, data) for name, p in given.items()}
    residuals = {name: np.asarray(errors(found, data)) for name, found in paths.items()}
    e, noise = residuals["fitted"], np.asarray(estimate.noise)[:, None]
    difference = {name: np.asarray(ravel_pytree(p)[0] - estimate.x) for name, p in given.items()}
    body, state = model(unravel(estimate.x), data["begin"])
    return SpinFit(
        found,
        float((np.abs(found.starts.loss[3:] - found.starts.loss[0]) < 1e-4).mean()),
        estimate,
        normal,
        residuals,
        np.asarray(student_t_weights(jnp.asarray(e), noise)),
        (e**2).sum(axis=-1) > _FAR * noise**2,
        {name: _derived(p, data) for name, p in given.items()},
        {name: float(d @ np.linalg.solve(estimate.covariance, d)) for name, d in difference.items()},
        _predict(estimate, unravel, given, data["begin"], members),
        _flyby.passage(body, state, FLYBY_DISTANCE, _flyby.speed_at_infinity(**ELEMENTS), members),
        coverage(estimate, unravel, data, sets, progress=progress),
        scenarios.load("toutatis"),
    )


def radar_data() -> dict[str, Array]:
    """The fixes of 1992 for the fit: their times in days from the middle one, and the epoch of the published states."""
    fixes = radar_epochs()
    middle = fixes.t[MIDDLE]
    return {
        "begin": jnp.asarray(fixes.q[MIDDLE]),
        "epoch": jnp.asarray(-middle),
        "freedom": jnp.asarray(FREEDOM),
        "q": jnp.asarray(fixes.q[:FITTED]),
        "rate": jnp.asarray(fixes.angular_velocity_deg[:FITTED]),
        "t": jnp.asarray(fixes.t[:FITTED] - middle),
    }


def published_params(name: str, begin: Array, t: Array) -> dict[str, Array]:
    """The published state of a scenario after time t, as parameters of `model`."""
    scenario = scenarios.load(name)
    body = RigidBody(jnp.asarray(scenario.inertia) / scenario.inertia[2])
    later = body.solution(body.state(scenario.state.attitude(), angular_velocity=scenario.state.rate()), t)
    turn = so3.log(so3.multiply(later.q, so3.inverse(begin)))
    rate = body.angular_velocity(later)
    return {"attitude": jnp.rad2deg(turn), "inertia": body.inertia[:2], "rate": jnp.rad2deg(rate)}


def _from_many_starts(
    given: list[dict[str, Array]], data: dict[str, Array], starts: int, progress: bool
) -> tuple[Fit, dict[str, Array]]:
    """The fit from both published states, with normal errors from the first, and from random states about the second.

    There are as many starts as synthetic sets, so that one program makes both.
    """
    rng = np.random.default_rng(17)
    scatter = {"attitude": 10.0, "inertia": 0.15, "rate": 5.0}
    moved = {name: p + scatter[name] * rng.normal(size=(starts - 3, p.size)) for name, p in given[1].items()}
    chosen = jax.tree.map(lambda a, b, more: jnp.concatenate([jnp.stack([a, b, a]), more]), given[0], given[1], moved)
    many = repeated(data, starts) | {"freedom": jnp.full(starts, FREEDOM).at[2].set(_NORMAL)}
    return fitted(chosen | {"noise": jnp.full((starts, 2), 8.0)}, many, progress), many


def _derived(params: dict[str, Array], data: dict[str, Array]) -> np.ndarray:
    at_epoch = path(params, {"begin": data["begin"], "t": data["epoch"][None]})[0]
    return np.asarray(derived(params, data["begin"], at_epoch))


def _predict(
    estimate: Estimate, unravel: Any, given: dict[str, dict[str, Array]], begin: Array, members: int
) -> Prediction:
    """The motion of the estimate, of both published states and of members drawn by the covariance."""
    fixes = radar_epochs()
    t = np.append(np.geomspace(1, 6000, 60), fixes.t[FITTED:] - fixes.t[MIDDLE])
    drawn = np.random.default_rng(2004).multivariate_normal(estimate.x, estimate.covariance, members)
    x = np.stack([estimate.x, *(ravel_pytree(p)[0] for p in given.values())])

    @jax.jit
    def attitudes(x: Array) -> Array:
        body, state = model(unravel(x), begin)
        return jax.vmap(lambda t: body.solution(state, t).q)(jnp.asarray(t))

    q = jax.lax.map(attitudes, jnp.asarray(np.concatenate([x, drawn])))
    apart = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (None, 0))(q[0], q[len(x) :]))
    off = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (0, None))(q[:, -2:], jnp.asarray(fixes.q[FITTED:])))
    body, state = model(unravel(estimate.x), begin)
    rate = jnp.asarray(np.deg2rad(fixes.angular_velocity_deg))
    p = np.asarray(jax.vmap(so3.Ad)(jnp.asarray(fixes.q), body.inertia * rate))
    cosine = p @ np.asarray(state.p) / np.linalg.norm(p, axis=1) / np.linalg.norm(state.p)
    return Prediction(
        t[:-2],
        np.percentile(apart[:, :-2], (5, 50, 95), axis=0),
        np.sqrt((apart[:, :-2] ** 2).mean(axis=0)),
        dict(zip(("fitted", *given), off, strict=False)),
        off[len(x) :],
        np.rad2deg(np.arccos(cosine)),
    )


def text(found: SpinFit) -> str:
    """The study's report, to print."""
    parts = (_head, _residual_table, _comparison, _prediction, _torque, _coverage)
    return "\n".join(line for part in parts for line in part(found))


def _head(found: SpinFit) -> list[str]:
    noise, error = np.asarray(found.estimate.noise), 1 / np.sqrt(24 / 9 * FITTED)
    plain = np.asarray(found.normal.noise)
    sigma = np.sqrt(np.diagonal(found.estimate.derived_covariance))
    moved = (np.asarray(found.normal.derived) - np.asarray(found.estimate.derived)) / sigma
    return [
        f"{found.scenario.title}: spin state, inertia ratios and noise from the {FITTED} radar fixes of 1992",
        f"  fixes: {found.scenario.source('takahashi')}, without errors: all attitudes have one weight, all rates one",
        f"  {found.fit.outcome}; {100 * found.same:.0f} % of {len(found.fit.starts.loss) - 3} random starts end there",
        f"  noise, fitted: attitudes {noise[0]:.2f} ± {noise[0] * error:.2f}°, rates {noise[1]:.2f} ± "
        f"{noise[1] * error:.2f} °/d (scales of Student's t, {FREEDOM:g} degrees of freedom)",
        f"  with normal errors instead they are {plain[0]:.2f}° and {plain[1]:.2f} °/d, and the quantities below move by "
        f"up to {np.abs(moved).max():.1f} σ",
    ]


def _residual_table(found: SpinFit) -> list[str]:
    size = {name: np.linalg.norm(e, axis=-1) for name, e in found.residuals.items()}
    lines = [
        "\n  |calculated − observed|       attitude (°)                        body rate (°/d)",
        f"  {'':<18}{'fitted':>8}{'weight':>8}{'Zhao':>7}{'Takahashi':>11}{'fitted':>12}{'weight':>8}{'Zhao':>7}"
        f"{'Takahashi':>11}",
    ]
    for k, date in enumerate(dates()[:FITTED]):
        row = f"  {date:<18}"
        for kind in range(2):
            ours, zhao, takahashi = (size[name][kind, k] for name in ("fitted", *STATES))
            mark = "*" if found.outlier[kind, k] else " "
            row += f"{ours:>{12 if kind else 8}.2f}{mark}{found.weights[kind, k]:>7.2f}{zhao:>7.1f}{takahashi:>11.1f}"
        lines.append(row)
    rms = [np.sqrt((s**2).mean(axis=1)) for s in size.values()]
    row = f"  {'rms':<18}" + "".join(
        f"{rms[0][k]:>{12 if k else 8}.2f}{'':>8}{rms[1][k]:>7.2f}{rms[2][k]:>11.2f}" for k in range(2)
    )
    return [
        *lines,
        row,
        "  * an outlier: normal errors of the fitted noise would have one so large in 1 of 100 such tables",
    ]


def _comparison(found: SpinFit) -> list[str]:
    sigma = np.sqrt(np.diagonal(found.estimate.derived_covariance))
    lines = [f"\n  {'':<26}{'fitted':>9}{'± 1σ':>9}{'Zhao':>17}{'Takahashi':>17}"]
    for k, name in enumerate(NAMES):
        value = float(found.estimate.derived[k])
        row = f"  {name:<26}{value:>9.3f}{sigma[k]:>9.3f}"
        for state in STATES:
            other = float(found.published[state][k])
            row += f"{other:>10.3f}{_difference(other, value, k) / sigma[k]:>5.1f} σ"
        lines.append(row)
    zhao, takahashi = found.apart.values()
    pairs = zip(NAMES, found.scenario.published.values(), found.estimate.derived, sigma, strict=False)
    return [
        *lines,
        "  (Euler angles and rates of 1992-11-09 17:49:47 UTC; the other columns are what the published states imply,",
        f"  with the inertia of {found.scenario.source('takahashi')}, and their distance from ours)",
        f"  all eight parameters together, at the middle fix: χ² = {zhao:.0f} for the state of Zhao et al. and "
        f"{takahashi:.0f} for that of Takahashi et al. (8 expected)",
        "\n  published as such:",
        *(
            f"    {name:<26}{p.value:>8g} ± {p.error:<5g} ours {float(x):.3f} ± {s:.3f}: "
            f"{(float(x) - p.value) / np.hypot(s, p.error):+.1f} σ of both   ({found.scenario.source(p.source)})"
            for name, p, x, s in pairs
        ),
        *(
            f"    {NAMES[k]:<26}{value:>8g}         ours {float(found.estimate.derived[k]):.3f} ± {sigma[k]:.3f}: "
            f"{(float(found.estimate.derived[k]) - value) / sigma[k]:+.1f} σ           (Hudson & Ostro 1995, Science 270:84)"
            for k, value in enumerate(HUDSON_OSTRO)
        ),
    ]


HUDSON_OSTRO = (7.35, 5.41)  # days; Science 270:84


def _difference(a: float, b: float, k: int) -> float:
    """a − b; of angles in degrees, the shortest way round."""
    return (a - b + 180) % 360 - 180 if "°)" in NAMES[k] else a - b


def _prediction(found: SpinFit) -> list[str]:
    p = found.prediction
    lines = ["\n  torque-free to 2004 and 2008: angle of the prediction from the radar fix (°)"]
    lines += [f"  {'':<26}{'2004-10-10':>12}{'2008-11-23':>12}"]
    lines += [f"    {name:<24}{off[0]:>12.1f}{off[1]:>12.1f}" for name, off in p.off.items()]
    low, high = np.percentile(p.members_off, (5, 95), axis=0)
    lines += [
        f"    {'members, 5 to 95 %':<24}"
        + "".join(f"{f'{a:.0f} to {b:.0f}':>12}" for a, b in zip(low, high, strict=True))
    ]
    pole = p.pole[:FITTED][~found.outlier[1]]
    days = [np.interp(angle, p.rms, p.t) for angle in (30, 90)]
    return [
        *lines,
        f"  The fit's own uncertainty loses the attitude first: the members spread by 30° rms after {days[0]:.0f} days, by "
        f"90° after {days[1]:.0f},",
        f"  and by {p.rms[-1]:.0f}° in the end (random attitudes: 132°). The miss is not outside that spread.",
        f"  The direction of the momentum needs no phase: single fixes of 1992 give it {np.sqrt((pole**2).mean()):.1f}° rms "
        f"from the fitted one,",
        f"  those of 2004 and 2008 {p.pole[-2]:.1f}° and {p.pole[-1]:.1f}°: no change of it is seen.",
    ]


def rate_errors(found: SpinFit) -> np.ndarray:
    """Standard errors of the mean rates of precession and rotation, 360°/period, in °/d, (2,)."""
    value, error = found.periods.T
    return 360 * error / value**2


def _torque(found: SpinFit) -> list[str]:
    f, own = found.flyby, rate_errors(found)
    rms, most = np.sqrt((f.rates**2).mean(axis=0)), np.abs(f.rates).max()
    return [
        "\n  the Earth's torque in the flyby of 2004-09-29, an order of magnitude: a hyperbola of least distance "
        f"{f.distance / _flyby.AU:.5f} au,",
        f"  {f.speed:.2f} km/s at infinity (from the elements, with a circular orbit of the Earth), any phase, any direction",
        f"    |Δπ|/|π| {np.sqrt((f.momentum**2).mean()):.1e} rms; the momentum turns by up to {f.pole.max():.2f}°",
        f"    precession rate {rms[0]:.3f} rms, rotation rate {rms[1]:.4f} rms, at most {most:.3f} °/d",
        f"    published: at most {PUBLISHED_CHANGE} °/d   (Busch et al. 2012, AGU Fall Meeting, P31A-1873)",
        f"  By the fix of 2008 that is {_TO_2008 * rms[0]:.0f}° rms, {_TO_2008 * most:.0f}° at most: no torque-free motion can "
        "hold through it. But the fit",
        f"  of 1992 knows these rates to ± {own[0]:.2f} and ± {own[1]:.2f} °/d only, and cannot tell one reason from the other.",
    ]


def _coverage(found: SpinFit) -> list[str]:
    c = found.coverage
    one, two = _held(c)
    names = (*(f"attitude {a}" for a in "xyz"), "Jx/Jz", "Jy/Jz", *(f"rate {a}" for a in "xyz"), "log σ, attitude")
    labels = (*names, "log σ, rate", *(NAMES[k] for k in range(4)))
    picked = (*range(10), *range(10, 14))
    lines = [
        f"\n  coverage: {len(c.pulls)} synthetic sets of the fitted model, {int(c.success.sum())} fits succeeded",
        f"  {'':<26}{'within 1σ':>10}{'within 2σ':>10}{'scatter/σ':>11}",
    ]
    lines += [
        f"  {label:<26}{100 * one[k]:>9.0f}%{100 * two[k]:>9.0f}%{c.pulls[:, k].std():>11.2f}"
        for label, k in zip(labels, picked, strict=True)
    ]
    return [
        *lines,
        f"  {'mean of the parameters':<26}{100 * one[:8].mean():>9.1f}%{100 * two[:8].mean():>9.1f}%"
        f"{c.pulls[:, :8].std():>11.2f}   expected 68.3 %, 95.4 %, 1",
        f"  truth inside the joint 95 % ellipsoid: {100 * (c.distance <= 15.507).mean():.0f} % of the sets",
    ]


def _held(c: Coverage) -> tuple[np.ndarray, np.ndarray]:
    """The shares of the sets with the truth within 1σ and 2σ."""
    size = np.abs(c.pulls)
    return (size <= 1).mean(axis=0), (size <= 2).mean(axis=0)


def draw(found: SpinFit) -> Figure:
    """Plot residuals by epoch, ours beside published values, the prediction and its failure, and the coverage."""
    return _toutatis_picture.draw(found)
