"""The spin state and inertia of a satellite from its light curve: the model, many starts, and errors.

Eight parameters are fitted: attitude (3), body rate (3), two ratios of inertia. The zero point of the magnitudes is
eliminated: its least-squares value is the mean of the errors, which is subtracted. The motion is computed by the scheme
of order 6, whose derivatives in so many starts cost a tenth of the closed form's; its error is measured by comparison
with the closed form.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike

from lieint_jax import schemes
from lieint_jax.app.studies._facets import Facets, magnitude
from lieint_jax.app.studies._satellite_sky import Lightcurve, Scene, true_magnitudes
from lieint_jax.app.studies._symmetric_solutions import SPACE, Change, Solutions, distance, solutions
from lieint_jax.app.studies._tumbling import mean_periods, model, rotation_between
from lieint_jax.fitting import Fit, fit, free, inertia_ratios, principal_inertia
from lieint_jax.groups import so3
from lieint_jax.runs import integrate, over_members
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

BOUNDS = {"attitude": free, "inertia": inertia_ratios, "rate": free}
STEP = 0.75  # min
_ITERATIONS, _TOLERANCE, _FINE = 50, 1e-6, 4000
_AT_ONCE = 10_000  # guesses that are evaluated together
_POOL, _NEAR = 50_000, 500  # number of random bodies, and of those used for a candidate
_SCATTER = 0.8  # standard deviation of the logarithms of second moments


def magnitudes(params: dict[str, Array], begin: ArrayLike, facets: Facets, curve: Lightcurve) -> tuple[Array, Array]:
    """The model's magnitudes, (n,), and whether all steps converged; `params` and `begin` as in `_tumbling.model`."""
    body, state = model(params, jnp.asarray(begin))
    steps = int(np.ceil(curve.t[-1] / STEP))
    path = integrate(schemes.preprocessed(body, 6), state, STEP, steps, save_at=jnp.asarray(curve.t))
    q = path.state.q[1:]
    light = jax.vmap(_light, (0, (None, 0, 0)))(q, (facets, jnp.asarray(curve.sun), jnp.asarray(curve.observer)))
    return light, jnp.all(path.info.converged)


def _magnitude(q: Array, scene: tuple[Facets, Array, Array]) -> Array:
    facets, sun, observer = scene
    return magnitude(facets, q, sun, observer)


_light = jax.custom_jvp(_magnitude)


@partial(_light.defjvp, symbolic_zeros=True)
def _light_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """The derivative, by the gradient in the attitude: eight directions then cost little more than the light itself."""
    (q, scene), (dq, *changes) = primals, jax.tree.leaves(tangents, is_leaf=_is_zero)
    light, gradient = jax.value_and_grad(_magnitude)(q, scene)
    along = jnp.zeros(()) if _is_zero(dq) else jnp.vdot(gradient, dq)
    if all(map(_is_zero, changes)):
        return light, along
    full = [jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x for x in changes]
    change = jax.tree.unflatten(jax.tree.structure(scene), full)
    return light, along + jax.jvp(lambda scene: _magnitude(q, scene), (scene,), (change,))[1]


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def fit_magnitudes(
    guesses: dict[str, np.ndarray],
    begin: np.ndarray,
    observed: np.ndarray,
    facets: Facets,
    curve: Lightcurve,
    progress: bool = True,
) -> Fit:
    """Run many fits at once, to the observed magnitudes, (fits, n), at the exposures of the curve.

    Each leaf of `guesses`, and `begin`, has a leading axis (fits).
    """

    def residuals(params: dict[str, Array], data: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, observed = data
        light, converged = magnitudes(params, begin, facets, curve)
        error = (light - observed) / curve.noise
        return error - jnp.mean(error), converged

    return fit(
        residuals,
        guesses,
        bounds=BOUNDS,
        starts=True,
        data=(begin, observed),
        iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
        progress=progress,
    )


def random_guesses(
    frequencies: np.ndarray, count: int, key: Array
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Random guesses whose mean precession and rotation frequencies are near given candidates.

    The inertia is that of random second moments; the directions of the body momentum and the attitudes are uniform.
    From a pool of such bodies, each candidate uses those with the nearest ratio of the two frequencies, and scales
    their rates to its frequencies. All candidates have the same number of guesses.

    Args:
        frequencies: candidates for (precession, rotation) in 1/min, (candidates, 2).
        count: the number of guesses.
        key: the key of the random numbers.

    Returns:
        The guesses and their attitudes `begin`, (count, 4), for `fit_magnitudes`; the candidate of each, (count,).
    """
    keys = jax.random.split(key, 4)
    J, Pi, of_pool = (np.asarray(x) for x in _pool(keys[:2]))
    ratio, wanted = of_pool[:, 1] / of_pool[:, 0], frequencies[:, 1] / frequencies[:, 0]
    near = np.argsort(np.abs(np.log(ratio[:, None] / wanted)), axis=0)[:_NEAR]
    which = np.arange(count) % len(frequencies)
    chosen = near[np.asarray(jax.random.randint(keys[2], (count,), 0, _NEAR)), which]
    speed = (frequencies[which] / of_pool[chosen]).mean(axis=1)
    rate = np.rad2deg(speed[:, None] * Pi[chosen] / J[chosen])
    begin = jax.jit(lambda key: jax.vmap(so3.normalize)(jax.random.normal(key, (count, 4))))(keys[3])
    return {"attitude": np.zeros((count, 3)), "inertia": J[chosen, :2], "rate": rate}, np.asarray(begin), which


@jax.jit
def _pool(keys: Array) -> tuple[Array, Array, Array]:
    """Random bodies: moments over the third, body momenta, and mean frequencies of precession and rotation."""
    J = jax.vmap(principal_inertia.inside)(_SCATTER * jax.random.normal(keys[0], (_POOL, 3)))
    J = J / J[:, 2:]
    Pi = jax.random.normal(keys[1], (_POOL, 3))

    def frequencies(J: Array, Pi: Array) -> Array:
        body = RigidBody(J)
        return 1 / mean_periods(body, body.state(body_momentum=Pi))

    return J, Pi, jax.vmap(frequencies)(J, Pi)


def losses(
    guesses: dict[str, np.ndarray], begin: np.ndarray, facets: Facets, curve: Lightcurve, progress: bool = True
) -> np.ndarray:
    """Half the sum of squares of the errors of each guess, in units of the noise, (guesses,)."""
    from tqdm import tqdm  # imported here, so that the package imports quickly

    def loss(params: dict[str, Array], begin: Array) -> Array:
        light, _ = magnitudes(params, begin, facets, curve)
        return len(curve.t) * jnp.var(light - curve.magnitude) / (2 * curve.noise**2)

    piece_losses, pieces = over_members(loss), np.array_split(np.arange(len(begin)), -(-len(begin) // _AT_ONCE))
    found = []
    with tqdm(total=len(begin), unit=" guesses", disable=None if progress else True, leave=False) as bar:
        for piece in pieces:
            part = {name: leaf[piece] for name, leaf in guesses.items()}
            found.append(np.asarray(piece_losses(part, begin[piece])))
            bar.update(len(piece))
    return np.concatenate(found)


class Estimate(NamedTuple):
    """The best solution and the truth: attitude (rotation vector in space, °), inertia ratios, rate (°/min).

    Attributes:
        value: the estimate, (8,).
        truth: the truth, or its image under a symmetry of the facets, whichever is nearest, (8,).
        sigma: standard errors of the estimate, (8,).
        facet_symmetry: that symmetry, a rotation of the body axes, (3, 3).
        periods: mean precession and rotation period of the estimate (min), (2,).
        periods_sigma: their standard errors, (2,).
        errors: (estimate − truth)/σ of the synthetic sets, (sets, 8).
        light: the magnitudes of the fit, with the zero point of the light curve, (n,).
        fine_t, fine_light: many times, and the same magnitudes at these by the closed form, (m,).
        integration: the largest difference between the fit's magnitudes and those of the closed form, over the noise.
    """

    value: np.ndarray
    truth: np.ndarray
    sigma: np.ndarray
    facet_symmetry: np.ndarray
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
    """Compare the fit number `chosen` with the truth; the fits from number `several` on are those of synthetic sets."""
    starts = night.starts
    assert starts is not None
    assert starts.covariance is not None
    params = jax.tree.map(np.asarray, starts.params)  # off the devices over which the fits were split
    x = np.concatenate([params[name] for name in BOUNDS], axis=1)
    sigma = np.sqrt(np.diagonal(starts.covariance, axis1=1, axis2=2))
    truth, best = true_solution(made), solutions(params, begin).select(chosen)
    symmetry = min((c for c in every if c.name == SPACE[0]), key=lambda c: float(distance(c(truth), best)[0]))
    best_params = {name: leaf[chosen] for name, leaf in params.items()}
    body, state, light, periods, D = _evaluate_solution(best_params, begin[chosen], made, curve)
    fine = np.linspace(0, curve.t[-1], _FINE)
    exact = np.asarray(true_magnitudes(made._replace(body=body, state=state), np.append(curve.t, fine)))
    zero = np.mean(curve.magnitude - light)
    return Estimate(
        x[chosen],
        _parameter_vector(symmetry(truth), begin[chosen]),
        sigma[chosen],
        symmetry.g,
        periods,
        np.sqrt(np.diagonal(D @ starts.covariance[chosen] @ D.T)),
        (x[several:] - _parameter_vector(truth, truth.q[0])) / sigma[several:],
        light + zero,
        fine,
        exact[len(curve.t) :] + zero,
        float(np.abs(light - exact[: len(curve.t)]).max() / curve.noise),
    )


def _evaluate_solution(
    params: dict[str, Array], begin: np.ndarray, made: Scene, curve: Lightcurve
) -> tuple[RigidBody, State, np.ndarray, np.ndarray, np.ndarray]:
    """Body, state, magnitudes (n,) and mean periods (2,) of a solution, and the periods' derivative by x, (2, 8)."""

    @jax.jit
    def evaluate(params: dict[str, Array]) -> tuple[RigidBody, State, Array, Array, list[Array]]:
        def periods(params: dict[str, Array]) -> tuple[Array, Array]:
            found = mean_periods(*model(params, jnp.asarray(begin)))
            return found, found

        D, found = jax.jacfwd(periods, has_aux=True)(params)
        light, _ = magnitudes(params, begin, made.facets, curve)
        return *model(params, jnp.asarray(begin)), light, found, [D[name] for name in BOUNDS]

    body, state, light, found, D = evaluate(params)
    return body, state, np.asarray(light), np.asarray(found), np.concatenate(D, axis=1)


def _parameter_vector(solution: Solutions, begin: np.ndarray) -> np.ndarray:
    """The parameters of the fit, (8,), of a single solution."""
    rotation = rotation_between(jnp.asarray(solution.q[0]), jnp.asarray(begin))
    return np.concatenate([rotation, solution.inertia[0, :2] / solution.inertia[0, 2], solution.rate[0]])
