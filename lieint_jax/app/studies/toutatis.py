"""The spin state of 4179 Toutatis from its radar fixes of 1992, and what torque-free motion predicts for later fixes.

Eight parameters (attitude, body rate, two ratios of inertia) and two noise levels are fitted to the 17 attitudes and
body rates of 1992. No errors are published with them, so all attitudes have the same weight, and so have all rates, by
the two noise levels. Some fixes are far from any solution: the errors are modeled by Student's t with 4 degrees of
freedom, whose tails make the fit robust against outliers. The motion between fixes is the closed form of the free body.

The covariance is tested on synthetic data sets of the fitted model; the prediction is that of an ensemble.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from lieint_jax.app import scenarios
from lieint_jax.app.studies import _flyby
from lieint_jax.app.studies._pulls import squared_distances
from lieint_jax.app.studies._radar import (
    FITTED,
    MIDDLE,
    STATES,
    RadarEpochs,
    errors,
    later_fixes,
    path,
    radar_epochs,
)
from lieint_jax.app.studies._spin_fit import (
    Estimate,
    Unravel,
    coverage,
    derived_quantities,
    enlarge_errors,
    estimates,
    fit_spins,
    repeat,
)
from lieint_jax.app.studies._toutatis_picture import draw
from lieint_jax.app.studies._toutatis_report import text
from lieint_jax.app.studies._toutatis_result import Prediction, SpinFit
from lieint_jax.app.studies._tumbling import model, rotation_between
from lieint_jax.fitting import DEGREES_OF_FREEDOM, Fit, student_t_weights
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import vectors

__all__ = ["RadarEpochs", "SpinFit", "draw", "model", "radar_epochs", "run", "text"]

_NORMAL = 1e8  # degrees of freedom of Student's t for a normal distribution
_FAR = 18.8  # |e|²/σ²: any of 34 normal vectors of three components exceeds it with a probability of 0.01

# Least distance: Busch et al. 2012, AGU Fall Meeting, P31A-1873. Elements of the orbit about the Sun at JD 2454797.5 as
# encyclopaedias quote them from JPL's Small-Body Database: enough for an order of magnitude, not checked there.
_FLYBY_DISTANCE = 0.01036 * _flyby.AU
_ELEMENTS = {"semi_major_axis": 2.5321, "eccentricity": 0.6288, "inclination_deg": 0.446}


def run(quick: bool = False, progress: bool = True) -> SpinFit:
    """Fit, compare, predict, and test the uncertainty; `quick` uses a fifth of the synthetic sets and members."""
    sets, members = (20, 200) if quick else (100, 1000)
    data = radar_data()
    given = {name: published_params(scenario, data["begin"], -data["epoch"]) for name, scenario in STATES.items()}
    found, many = _fit_from_many_starts(list(given.values()), data, 2 * sets, progress)
    starts = found.starts
    assert starts is not None
    three = jax.tree.map(lambda leaf: leaf[:3], (starts.params, many))
    states = estimates(*three)
    estimate, normal = (jax.tree.map(lambda leaf, k=k: leaf[k], states) for k in (0, 2))
    unravel = ravel_pytree(next(iter(given.values())))[1]
    test = coverage(estimate, unravel, data, 2 * sets, progress=progress)
    factors = np.maximum(test.select(slice(None, sets)).scatter, 1)  # errors are never reduced
    estimate = enlarge_errors(estimate, factors[0])
    paths = {"fitted": path(unravel(estimate.x), data)} | {name: path(p, data) for name, p in given.items()}
    residuals = {name: np.asarray(errors(along, data)) for name, along in paths.items()}
    e, noise = residuals["fitted"], np.asarray(estimate.noise)[:, None]
    difference = {name: np.asarray(ravel_pytree(p)[0] - estimate.x) for name, p in given.items()}
    body, state = model(unravel(estimate.x), data["begin"])
    return SpinFit(
        found,
        float((np.abs(starts.loss[3:] - starts.loss[0]) < 1e-4).mean()),
        estimate,
        normal,
        residuals,
        np.asarray(student_t_weights(jnp.asarray(e), jnp.asarray(noise))),
        (e**2).sum(axis=-1) > _FAR * noise**2,
        {name: _derived_at_epoch(p, data) for name, p in given.items()},
        {name: float(squared_distances(d[None], np.asarray(estimate.covariance))[0]) for name, d in difference.items()},
        _predict(estimate, unravel, given, data["begin"], members),
        _flyby.passage(body, state, _FLYBY_DISTANCE, _flyby.speed_at_infinity(**_ELEMENTS), members),
        factors,
        test.select(slice(sets, None)).rescale(factors),
        scenarios.load("toutatis"),
    )


def radar_data() -> dict[str, Array]:
    """The fixes of 1992 for the fit, with times in days from the middle one, and the epoch of the published states."""
    fixes = radar_epochs()
    middle = fixes.t[MIDDLE]
    return {
        "begin": jnp.asarray(fixes.q[MIDDLE]),
        "epoch": jnp.asarray(-middle),
        "freedom": jnp.asarray(DEGREES_OF_FREEDOM),
        "q": jnp.asarray(fixes.q[:FITTED]),
        "rate": jnp.asarray(fixes.angular_velocity_deg[:FITTED]),
        "t": jnp.asarray(fixes.t[:FITTED] - middle),
    }


def published_params(name: str, begin: Array, t: Array) -> dict[str, Array]:
    """The published state of a scenario after time t, as parameters of `model`."""
    scenario = scenarios.load(name)
    body = RigidBody(jnp.asarray(scenario.inertia) / scenario.inertia[2])
    later = body.solution(body.state(scenario.state.attitude(), angular_velocity=scenario.state.rate()), t)
    rate = body.angular_velocity(later)
    return {"attitude": rotation_between(later.q, begin), "inertia": body.inertia[:2], "rate": jnp.rad2deg(rate)}


def _fit_from_many_starts(
    given: list[dict[str, Array]], data: dict[str, Array], starts: int, progress: bool
) -> tuple[Fit, dict[str, Array]]:
    """Fit from both published states, from the first with normal errors, and from random states about the second.

    The number of starts is that of synthetic sets, so that one compiled program fits both.
    """
    rng = np.random.default_rng(17)
    scatter = {"attitude": 10.0, "inertia": 0.15, "rate": 5.0}
    random = {name: p + scatter[name] * rng.normal(size=(starts - 3, p.size)) for name, p in given[1].items()}
    chosen = jax.tree.map(lambda a, b, more: jnp.concatenate([jnp.stack([a, b, a]), more]), given[0], given[1], random)
    many = repeat(data, starts) | {"freedom": jnp.full(starts, DEGREES_OF_FREEDOM).at[2].set(_NORMAL)}
    return fit_spins(chosen | {"noise": jnp.full((starts, 2), 8.0)}, many, progress), many


def _derived_at_epoch(params: dict[str, Array], data: dict[str, Array]) -> np.ndarray:
    at_epoch = path(params, {"begin": data["begin"], "t": data["epoch"][None]})[0]
    return np.asarray(derived_quantities(params, data["begin"], at_epoch))


def _predict(
    estimate: Estimate, unravel: Unravel, given: dict[str, dict[str, Array]], begin: Array, members: int
) -> Prediction:
    """Predict the motion of the estimate, of both published states, and of members drawn from the covariance."""
    fixes, later = radar_epochs(), later_fixes()
    t = np.append(np.geomspace(1, 8000, 60), later.t - fixes.t[MIDDLE])
    drawn = np.random.default_rng(2004).multivariate_normal(estimate.x, estimate.covariance, members)
    x = np.stack([estimate.x, *(ravel_pytree(p)[0] for p in given.values())])

    @jax.jit
    def attitudes(x: Array) -> Array:
        body, state = model(unravel(x), begin)
        return jax.vmap(lambda t: body.solution(state, t).q)(jnp.asarray(t))

    q = jax.lax.map(attitudes, jnp.asarray(np.concatenate([x, drawn])))
    angles = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (None, 0))(q[0], q[len(x) :]))
    off = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (0, None))(q[:, -3:], jnp.asarray(later.q)))
    body, state = model(unravel(estimate.x), begin)
    rate = jnp.asarray(np.deg2rad(fixes.angular_velocity_deg))
    p = jax.vmap(so3.Ad)(jnp.asarray(fixes.q), body.inertia * rate)
    every = jnp.concatenate([state.q[None], jnp.asarray(fixes.q), jnp.asarray(later.q[-1:])])
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
