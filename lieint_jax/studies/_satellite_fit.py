"""The spin state and inertia of a satellite from its light curve: the model, many starts, and errors.

Eight parameters are fitted: attitude (3), body rate (3), two ratios of inertia. The zero point of the magnitudes is the
mean of the errors: it is taken out of them, which is least squares for it too. The motion is that of the scheme of
order 6, whose derivatives in so many starts cost a tenth of the closed form's; its error is measured beside that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from lieint_jax import schemes
from lieint_jax.ensemble._over_members import over_members
from lieint_jax.fitting._bounds import free, inertia_ratios, principal_inertia
from lieint_jax.fitting._fit import Fit, fit
from lieint_jax.groups import so3
from lieint_jax.integrate import integrate
from lieint_jax.studies._equivalents import SPACE, Change, Solutions, distance, solutions
from lieint_jax.studies._facets import Facets, magnitude
from lieint_jax.studies._radar import model
from lieint_jax.studies._satellite_sky import Lightcurve, Scene, true_magnitudes
from lieint_jax.studies._tumbling import mean_periods
from lieint_jax.systems import RigidBody

BOUNDS = {"attitude": free, "inertia": inertia_ratios, "rate": free}
STEP = 0.75  # min
_ITERATIONS, _TOLERANCE, _FINE = 50, 1e-6, 4000
_POOL, _NEAR, _SCATTER = 50_000, 500, 0.8  # random bodies, those kept for a candidate, scatter of log second moments


def magnitudes(params: dict[str, Array], begin: Array, facets: Facets, curve: Lightcurve) -> tuple[Array, Array]:
    """The model's magnitudes, (n,), and whether all steps converged; `params` and `begin` as in `_radar.model`."""
    body, state = model(params, begin)
    steps = int(np.ceil(curve.t[-1] / STEP))
    path = integrate(schemes.preprocessed(body, 6), state, STEP, steps, save_at=jnp.asarray(curve.t))
    q = path.state.q[1:]
    light = jax.vmap(magnitude, (None, 0, 0, 0))(facets, q, jnp.asarray(curve.sun), jnp.asarray(curve.observer))
    return light, jnp.all(path.info.converged)


def fitted(
    guesses: dict[str, Any], begin: Any, seen: Any, facets: Facets, curve: Lightcurve, progress: bool = True
) -> Fit:
    """All fits at once to magnitudes seen, (fits, n), at the exposures of the curve.

    Each leaf of guesses, and `begin`, has a leading axis.
    """

    def residuals(params: dict[str, Array], data: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, seen = data
        light, converged = magnitudes(params, begin, facets, curve)
        error = (light - seen) / curve.noise
        return error - jnp.mean(error), converged

    return fit(
        residuals,
        guesses,
        bounds=BOUNDS,
        starts=True,
        data=(begin, seen),
        iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
        progress=progress,
    )


def random_guesses(
    frequencies: np.ndarray, count: int, key: Array
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Guesses whose mean precession and rotation frequencies are near given ones, else at random.

    The inertia is that of random second moments, the body momentum's direction and the attitude are uniform. Of a pool
    of such bodies, those whose ratio of the two frequencies is nearest to a candidate's serve it, and turn as fast as
    it says. Each candidate has as many guesses.

    Args:
        frequencies: candidates for (precession, rotation) in 1/min, (candidates, 2).
        count: the number of guesses.
        key: of the random numbers.

    Returns:
        Guesses as `fitted` wants them, their attitudes `begin`, (count, 4), and the candidate of each, (count,).
    """
    keys = jax.random.split(key, 4)
    J = jax.vmap(principal_inertia.inside)(_SCATTER * jax.random.normal(keys[0], (_POOL, 3)))
    J = np.asarray(J / J[:, 2:])
    Pi = np.asarray(jax.random.normal(keys[1], (_POOL, 3)))

    @jax.jit
    @jax.vmap
    def periods(J: Array, Pi: Array) -> Array:
        body = RigidBody(J)
        return mean_periods(body, body.state(body_momentum=Pi))

    of_pool = 1 / np.asarray(periods(J, Pi))
    ratio, wanted = of_pool[:, 1] / of_pool[:, 0], frequencies[:, 1] / frequencies[:, 0]
    near = np.argsort(np.abs(np.log(ratio[:, None] / wanted)), axis=0)[:_NEAR]
    which = np.arange(count) % len(frequencies)
    chosen = near[np.asarray(jax.random.randint(keys[2], (count,), 0, _NEAR)), which]
    speed = (frequencies[which] / of_pool[chosen]).mean(axis=1)
    rate = np.rad2deg(speed[:, None] * Pi[chosen] / J[chosen])
    begin = jax.vmap(so3.normalise)(jax.random.normal(keys[3], (count, 4)))
    return {"attitude": np.zeros((count, 3)), "inertia": J[chosen, :2], "rate": rate}, np.asarray(begin), which


def losses(guesses: dict[str, np.ndarray], begin: np.ndarray, facets: Facets, curve: Lightcurve) -> Array:
    """Half the sum of squares of each guess's errors in units of the noise, (guesses,)."""

    def one(params: dict[str, Array], begin: Array) -> Array:
        light, _ = magnitudes(params, begin, facets, curve)
        return len(curve.t) * jnp.var(light - curve.magnitude) / (2 * curve.noise**2)

    return over_members(one)(guesses, begin)


class Estimate(NamedTuple):
    """The best solution beside the truth, in the order attitude (°, as turns in space), inertia ratios, rate (°/min).

    Attributes:
        value: the estimate, (8,).
        truth: the truth, or its image under a symmetry of the facets, whichever is nearest, (8,).
        sigma: standard errors of the estimate, (8,).
        turned: that symmetry, a turn of the body axes, (3, 3).
        periods: mean precession and rotation period of the estimate (min), (2,).
        periods_sigma: their standard errors, (2,).
        errors: (estimate − truth)/σ of the synthetic sets, (sets, 8).
        light: the magnitudes of the fit, with the zero point of the light curve, (n,).
        fine_t, fine_light: the same at many times by the closed form, (m,).
        integration: the largest difference between the fit's magnitudes and those of the closed form, over the noise.
    """

    value: np.ndarray
    truth: np.ndarray
    sigma: np.ndarray
    turned: np.ndarray
    periods: np.ndarray
    periods_sigma: np.ndarray
    errors: np.ndarray
    light: np.ndarray
    fine_t: np.ndarray
    fine_light: np.ndarray
    integration: float


def true_solution(made: Scene) -> Solutions:
    """The true spin state, as one solution."""
    rate, J = np.rad2deg(made.body.angular_velocity(made.state)), np.asarray(made.body.inertia)
    return Solutions(np.asarray(made.state.q)[None], rate[None], (J / np.cbrt(J.prod()))[None])


def estimate(
    made: Scene, curve: Lightcurve, night: Fit, begin: np.ndarray, chosen: int, several: int, every: list[Change]
) -> Estimate:
    """The fit `chosen` beside the truth; the fits from the number `several` on are of synthetic sets."""
    starts = night.starts
    assert starts is not None
    assert starts.covariance is not None
    x = np.asarray(jax.vmap(lambda p: ravel_pytree(p)[0])(starts.params))
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], starts.params))
    truth, best = true_solution(made), solutions(starts.params, begin).take(chosen)
    turn = min((c for c in every if c.name == SPACE[0]), key=lambda c: float(distance(c(truth), best)[0]))
    sigma = np.sqrt(np.diagonal(starts.covariance, axis1=1, axis2=2))

    def periods(x: Array) -> Array:
        return mean_periods(*model(unravel(x), jnp.asarray(begin[chosen])))

    D = jax.jit(jax.jacfwd(periods))(x[chosen])
    light = magnitudes(unravel(jnp.asarray(x[chosen])), jnp.asarray(begin[chosen]), made.facets, curve)[0]
    body, state = model(unravel(jnp.asarray(x[chosen])), jnp.asarray(begin[chosen]))
    fine = np.linspace(0, curve.t[-1], _FINE)
    closed = made._replace(body=body, state=state)
    exact = np.asarray(true_magnitudes(closed, jnp.asarray(np.append(curve.t, fine))))
    zero = float(np.mean(curve.magnitude - light))
    return Estimate(
        x[chosen],
        _vector(turn(truth), begin[chosen]),
        sigma[chosen],
        turn.g,
        np.asarray(periods(x[chosen])),
        np.sqrt(np.diagonal(D @ starts.covariance[chosen] @ D.T)),
        (x[several:] - _vector(truth, truth.q[0])) / sigma[several:],
        np.asarray(light) + zero,
        fine,
        exact[len(curve.t) :] + zero,
        float(np.abs(light - exact[: len(curve.t)]).max() / curve.noise),
    )


def _vector(one: Solutions, begin: np.ndarray) -> np.ndarray:
    """A solution as the parameters of the fit, (8,)."""
    turn = so3.log(so3.multiply(jnp.asarray(one.q[0]), so3.inverse(jnp.asarray(begin))))
    return np.concatenate([np.rad2deg(turn), one.inertia[0, :2] / one.inertia[0, 2], one.rate[0]])
