"""The spin state of 4179 Toutatis, fitted to two fixes: attitude, rate and inertia ratios.

Eight parameters (three of attitude, three of rate, two ratios of inertia) are fitted to twelve numbers: the attitudes
and body rates published for 1992-11-09 (a solution) and 1992-12-02 (a radar fix), without errors. So every angle, in
degrees, and every rate, in degrees a day, has the same weight, and their common standard error is estimated from the
residuals: an assumption. The two periods are not fitted: the fit predicts them.
"""

from __future__ import annotations

from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

from lieint_jax import ensemble, plots, scenarios, schemes
from lieint_jax.fitting._bounds import free, inertia_ratios
from lieint_jax.fitting._fit import Fit, fit
from lieint_jax.groups import so3
from lieint_jax.integrate import integrate
from lieint_jax.scenarios.rigid_body import mean_periods
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

_DAYS, _SAVES = 800.0, 2000  # length and saved states of the run that gives the mean periods
_STEPS = 464  # from the first fix to the second
_NAMES = (
    *(f"attitude, about space {axis} (°)" for axis in "xyz"),
    "inertia ratio Jx/Jz",
    "inertia ratio Jy/Jz",
    *(f"body rate {axis} (°/d)" for axis in "xyz"),
)


class SpinFit(NamedTuple):
    """The results of the study.

    Attributes:
        fit: its params are attitude (rotation in space from the published attitude, °), rate (°/d), inertia (ratios).
        published: the published values of these parameters.
        residuals: fitted less observed attitude (°) and rate (°/d), at the first and second fix, (2, 2, 3).
        before: the residuals of the published state and inertia, (2, 2, 3).
        sigma: √(sum of squares of the residuals / degrees of freedom), ° or °/d.
        errors: standard errors with that sigma, in the order of `ravel_pytree`.
        periods: mean precession and rotation period in days, and their standard errors, (2, 2).
        track: times; angle in ° from the attitude seen at the second fix, of the fitted and of the published motion.
        scenario: the scenario that holds the published values.
    """

    fit: Fit
    published: dict[str, Array]
    residuals: np.ndarray
    before: np.ndarray
    sigma: float
    errors: np.ndarray
    periods: np.ndarray
    track: tuple[np.ndarray, np.ndarray, np.ndarray]
    scenario: Any


class RadarEpochs(NamedTuple):
    """All published radar fixes of Toutatis, 17 of 1992, one of 2004 and one of 2008.

    Attributes:
        t: days since 1992-11-09 17:49:47 UTC, the epoch of the published states, (19,).
        q: attitudes as unit quaternions, (19, 4).
        euler_313_deg: the same as published, (19, 3).
        angular_velocity_deg: body rates in ° a day, (19, 3).
    """

    t: np.ndarray
    q: np.ndarray
    euler_313_deg: np.ndarray
    angular_velocity_deg: np.ndarray


def radar_epochs() -> RadarEpochs:
    """The radar fixes. Source: Takahashi, Busch & Scheeres 2013, AJ 146:95. No errors are published."""
    text = resources.files(scenarios).joinpath("toutatis_radar.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines() if line[0].isdigit()]
    days = [np.datetime64(row[0]) - np.datetime64("1992-11-09T17:49:47") for row in rows]
    numbers = np.array([row[1:] for row in rows], float)
    q = jax.vmap(so3.from_euler_313)(jnp.deg2rad(numbers[:, :3]))
    return RadarEpochs(np.array(days) / np.timedelta64(1, "D"), np.asarray(q), numbers[:, :3], numbers[:, 3:])


def run(quick: bool = False, progress: bool = True) -> SpinFit:
    """Fit the parameters and predict the periods. `quick` takes few samples for the periods' errors."""
    scenario = scenarios.load("toutatis")
    [seen] = scenario.observation
    first, second = ((s.attitude(), jnp.rad2deg(jnp.asarray(s.rate()))) for s in (scenario.state, seen))
    published = {
        "attitude": jnp.zeros(3),
        "inertia": jnp.asarray(scenario.inertia[:2]) / scenario.inertia[2],
        "rate": first[1],
    }

    def residuals(params: dict[str, Array]) -> tuple[Array, Array]:
        body, start = model(params, first[0])
        path = integrate(schemes.preprocessed(body, 6), start, seen.t / _STEPS, _STEPS, _STEPS)
        end = State(path.state.q[-1], path.state.p[-1])
        away = [misfit(body, state, *fix) for state, fix in ((start, first), (end, second))]
        return jnp.stack(away), jnp.all(path.info.converged)

    found = fit(
        residuals, published, bounds={"attitude": free, "inertia": inertia_ratios, "rate": free}, progress=progress
    )
    left, before = (np.asarray(residuals(p)[0]) for p in (found.params, published))
    sigma = float(np.sqrt((left**2).sum() / (left.size - len(_NAMES))))
    assert found.covariance is not None
    matrix = sigma**2 * found.covariance
    periods = _periods(found.params, matrix, first[0], 16 if quick else 200)
    return SpinFit(
        found,
        published,
        left,
        before,
        sigma,
        np.sqrt(np.diagonal(matrix)),
        periods,
        _track(found.params, published, first[0], seen.t, second[0]),
        scenario,
    )


def model(params: dict[str, Array], attitude: Array) -> tuple[RigidBody, State]:
    """The body, and its state at the first fix, where `attitude` was published."""
    body = RigidBody(jnp.append(params["inertia"], 1.0))
    q = so3.multiply(so3.exp(jnp.deg2rad(params["attitude"])), attitude)
    return body, body.state(q, angular_velocity=jnp.deg2rad(params["rate"]))


def misfit(body: RigidBody, state: State, attitude: Array, rate: Array) -> Array:
    """Rotation vector in space from the observed attitude (°), and body rate less the observed one (°/d), (2, 3)."""
    turn = so3.log(so3.multiply(state.q, so3.inverse(attitude)))
    return jnp.rad2deg(jnp.stack([turn, body.angular_velocity(state) - jnp.deg2rad(rate)]))


def _periods(params: Any, matrix: np.ndarray, attitude: Array, samples: int) -> np.ndarray:
    """Mean periods at the estimate, and their standard deviations over samples of its distribution, (2, 2)."""
    at, unravel = ravel_pytree(params)
    drawn = np.random.default_rng(1992).multivariate_normal(np.asarray(at), matrix, samples)
    members = jax.vmap(unravel)(jnp.asarray(np.vstack([at, drawn])))
    bodies, states = jax.vmap(model, (0, None))(members, attitude)
    step = jax.vmap(lambda body: schemes.preprocessed(body, 6))(bodies)
    steps = _SAVES * 8
    path = ensemble.run(step, states, _DAYS / steps, steps, steps // _SAVES, step_axis=0, progress=False)

    def one(m: int) -> tuple[np.ndarray, np.ndarray]:
        alone = path._replace(state=jax.tree.map(lambda leaf: leaf[:, m : m + 1], path.state))
        return mean_periods(jax.tree.map(lambda leaf: leaf[m], bodies), alone)

    of_each = [one(m) for m in range(samples + 1) if _physical(members["inertia"][m])]
    values = np.array(of_each)[:, :, 0]
    return np.stack([values[0], values[1:].std(axis=0, ddof=1)], axis=1)


def _physical(ratios: Array) -> bool:
    """True if some distribution of mass has these ratios of inertia."""
    return bool(jnp.all(jnp.isfinite(inertia_ratios.free(ratios))))


def _track(
    params: Any, published: Any, attitude: Array, end: float, seen: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, and the angle (°) from the attitude seen at the end, of the fitted and of the published motion."""

    def angle(p: Any) -> Array:
        body, start = model(p, attitude)
        path = integrate(schemes.preprocessed(body, 6), start, end / _STEPS, _STEPS)
        return jnp.rad2deg(jax.vmap(so3.angle, (0, None))(path.state.q, seen))

    t = np.linspace(0, end, _STEPS + 1)
    both = jax.jit(jax.vmap(angle))(jax.tree.map(lambda *x: jnp.stack(x), params, published))
    return t, np.asarray(both[0]), np.asarray(both[1])


def text(found: SpinFit) -> str:
    """The study's report, to print."""
    scenario, [seen] = found.scenario, found.scenario.observation
    fitted, _ = ravel_pytree(found.fit.params)
    given, _ = ravel_pytree(found.published)
    lines = [
        f"{scenario.title}: spin state and inertia ratios from two fixes",
        f"  first fix: {scenario.source('zhao')}; second: {scenario.source(seen.source)}",
        f"  {found.fit.outcome}",
        f"\n  {'':<32}{'published':>10}{'fitted':>12}{'± 1 sigma':>11}",
    ]
    lines += [
        f"  {name:<32}{g:>10.4f}{f:>12.4f}{e:>11.4f}"
        for name, g, f, e in zip(_NAMES, given, fitted, found.errors, strict=True)
    ]
    lines += [f"\n  {'residuals, calculated − observed':<44}{'published state':>24}{'fitted':>26}"]
    for k, epoch in enumerate(("1992-11-09 17:49:47", "1992-12-02 21:40:00")):
        for j, what in enumerate(("attitude, about space axes (°)", "body rate (°/d)")):
            was, now = ("(" + ", ".join(f"{x:6.2f}" for x in r[k, j]) + ")" for r in (found.before, found.residuals))
            lines.append(f"  {epoch} {what:<31}{was}  {now}")
    was, now = (float(np.linalg.norm(r[1, 0])) for r in (found.before, found.residuals))
    lines += [
        f"  attitude at the second fix: {was:.2f}° off with the published state, {now:.2f}° fitted",
        f"  the errors above assume one sigma for all angles (°) and rates (°/d), {found.sigma:.2f}: that of the",
        f"  residuals, with {found.residuals.size - len(_NAMES)} degrees of freedom. No errors are published.",
        "\n  prediction, nothing of it fitted:",
    ]
    for (value, error), key, name in zip(
        found.periods,
        ("precession_period", "rotation_period"),
        ("precession of the long axis", "rotation about it"),
        strict=True,
    ):
        published = scenario.published[key]
        lines.append(
            f"    {name:<28} {value:.3f} ± {error:.3f} d   published {published.value:g} ± {published.error:g}"
            f"  ({scenario.source(published.source)})"
        )
    return "\n".join(lines)


def draw(found: SpinFit) -> Figure:
    """Plot the angle from the attitude observed at the second fix, for the fitted and the published motion."""
    fig, axes = plots.figure(2)
    t, fitted, published = found.track
    plots.series(axes[0, 0], t, {"fitted": fitted, "published state": published}, "° from the second fix", "d")
    last = t > t[-1] - 1.5
    plots.series(axes[0, 1], t[last], {"fitted": fitted[last], "published state": published[last]}, "", "d")
    fig.suptitle(found.scenario.title, fontsize="medium")
    return fig
