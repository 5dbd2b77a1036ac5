"""The robust fit of a torque-free spin state to radar fixes, with noise levels and covariance, for one or many sets."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from lieint_jax.fitting._bounds import free, inertia_ratios, interval
from lieint_jax.fitting._fit import Fit, fit
from lieint_jax.fitting._robust import FREEDOM, student_t, student_t_information
from lieint_jax.groups import so3
from lieint_jax.studies._radar import errors, fixes, model
from lieint_jax.studies._tumbling import direction, mean_periods

LEAST, MOST = 0.01, 100.0  # bounds of the noise levels, ° and °/d
BOUNDS = {"attitude": free, "inertia": inertia_ratios, "noise": interval(LEAST, MOST), "rate": free}


class Estimate(NamedTuple):
    """A spin state with its uncertainty. For many, every field has a leading axis.

    Attributes:
        x: the parameters attitude (°), inertia (ratios), rate (°/d) as a vector, (8,).
        covariance: of x, the inverse of the Fisher information, (8, 8).
        noise: the noise levels of attitudes (°) and rates (°/d), for as many degrees of freedom as are left, (2,).
        derived: see `derived`, (7,).
        derived_covariance: of `derived`, to first order, (7, 7).
    """

    x: Array
    covariance: Array
    noise: Array
    derived: Array
    derived_covariance: Array


def residuals(params: dict[str, Array], data: dict[str, Any]) -> Any:
    """For least squares: the errors as Student's t has them, with data["freedom"] degrees of freedom, and the noise."""
    e = errors({name: params[name] for name in ("attitude", "inertia", "rate")}, data)
    return [student_t(e[k], params["noise"][k], LEAST, data["freedom"]) for k in range(2)]


def fitted(guesses: dict[str, Array], data: dict[str, Any], progress: bool = True) -> Fit:
    """All fits at once; each leaf of guesses and data has a leading axis."""
    return fit(residuals, guesses, bounds=BOUNDS, starts=True, data=data, tolerance=1e-9, progress=progress)


def repeated(tree: Any, times: int) -> Any:
    """The tree with a leading axis, as many times."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (times, *jnp.shape(leaf))), tree)


def derived(params: dict[str, Array], begin: Array) -> Array:
    """Mean periods of precession and rotation (d), longitude and latitude of π (°), Euler 3-1-3 angles (°), (7,)."""
    body, state = model(params, begin)
    euler = jnp.rad2deg(so3.to_euler_313(state.q)) % 360
    return jnp.concatenate([mean_periods(body, state), direction(state.p), euler])


@jax.jit
def estimates(params: dict[str, Array], data: dict[str, Any]) -> Estimate:
    """The estimates of many fits, with their covariances; each leaf has a leading axis."""
    return lax.map(lambda x: _estimate(*x), (params, data))


def _estimate(params: dict[str, Array], data: dict[str, Any]) -> Estimate:
    """The covariance (Σ_k c JₖᵀJₖ/σₖ²)⁻¹, k the attitudes and the rates, with c the Fisher information.

    σ of the fit is that of maximum likelihood, too small, since the errors have been fitted: σₖ² is enlarged by the
    number of all components of kind k over those that are left, less hₖ, the trace of kind k's part of the projection.
    """
    params = dict(params)
    noise = params.pop("noise")
    x, unravel = ravel_pytree(params)
    J = jax.jacfwd(lambda x: errors(unravel(x), data))(x)
    count = J.shape[1] * J.shape[2]
    own = student_t_information(3)[0] * jnp.einsum("knci,kncj->kij", J, J)
    share = own / jnp.square(noise)[:, None, None]
    used = jnp.trace(jnp.linalg.inv(share[0] + share[1]) @ share, axis1=1, axis2=2)
    noise = noise * jnp.sqrt(count / (count - used))
    share = own / jnp.square(noise)[:, None, None]
    covariance = jnp.linalg.inv(share[0] + share[1])
    of_x = partial(_flat_derived, unravel=unravel, begin=data["begin"])
    D = jax.jacfwd(of_x)(x)
    return Estimate(x, covariance, noise, of_x(x), D @ covariance @ D.T)


def _flat_derived(x: Array, unravel: Any, begin: Array) -> Array:
    return derived(unravel(x), begin)


class Coverage(NamedTuple):
    """How often the reported uncertainty holds the truth, over synthetic data sets.

    Attributes:
        pulls: (estimate − truth)/reported σ of the 8 parameters, the 2 logarithms of noise, the 7 derived, (sets, 17).
        distance: the squared distance of the estimate from the truth by its covariance, (sets,): χ² of 8.
        success: whether each fit succeeded.
    """

    pulls: np.ndarray
    distance: np.ndarray
    success: np.ndarray


def noise_error(count: int) -> float:
    """The standard error of log σ from so many vectors of three components."""
    return (student_t_information(3)[1] * count) ** -0.5


def synthetic(truth: Estimate, unravel: Any, data: dict[str, Any], sets: int, seed: int) -> dict[str, Any]:
    """Data sets of the fitted model: its fixes, with errors from Student's t of the fitted noise levels."""
    rng = np.random.default_rng(seed)
    q, rate = fixes(*model(unravel(truth.x), data["begin"]), data["t"])
    shape = (2, sets, len(q), 3)
    drawn = rng.normal(size=shape) / np.sqrt(rng.chisquare(FREEDOM, (*shape[:3], 1)) / FREEDOM)
    turns, change = jnp.asarray(drawn) * truth.noise[:, None, None, None]

    def turned(turn: Array, q: Array) -> Array:
        return so3.multiply(so3.exp(jnp.deg2rad(turn)), q)

    seen = jax.vmap(jax.vmap(turned), (0, None))(turns, q)
    return repeated(data, sets) | {"q": seen, "rate": rate + change}


def coverage(
    truth: Estimate, unravel: Any, data: dict[str, Any], sets: int, seed: int = 1992, progress: bool = True
) -> Coverage:
    """Fit synthetic data sets of the fitted model, and compare their estimates with it."""
    many = synthetic(truth, unravel, data, sets, seed)
    begin = unravel(truth.x) | {"noise": truth.noise}
    found = fitted(repeated(begin, sets), many, progress)
    assert found.starts is not None
    each = estimates(found.starts.params, many)
    error = each.x - truth.x
    level = jnp.log(each.noise / truth.noise) / noise_error(len(data["t"]))
    of_derived = (each.derived - truth.derived + 180) % 360 - 180  # angles; periods are far below 180
    sigma, of_sigma = (jnp.sqrt(jnp.diagonal(C, axis1=1, axis2=2)) for C in (each.covariance, each.derived_covariance))
    distance = jnp.einsum("si,si->s", error, jnp.linalg.solve(each.covariance, error[..., None])[..., 0])
    pulls = jnp.concatenate([error / sigma, level, of_derived / of_sigma], axis=1)
    return Coverage(np.asarray(pulls), np.asarray(distance), found.starts.success)
