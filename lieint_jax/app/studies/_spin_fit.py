"""The robust fit of a torque-free spin state to one or many sets of radar fixes, with noise levels and covariance."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from lieint_jax.app.studies._pulls import squared_distances
from lieint_jax.app.studies._radar import errors, path, path_of_fits
from lieint_jax.app.studies._tumbling import longitude_latitude, mean_periods, model, rotate
from lieint_jax.fitting import (
    DEGREES_OF_FREEDOM,
    Fit,
    fit,
    free,
    inertia_ratios,
    interval,
    student_t,
    student_t_curvature,
    student_t_noise_error,
)
from lieint_jax.groups import so3
from lieint_jax.types.shapes import PyTree

LEAST, MOST = 0.01, 100.0  # bounds of the noise levels, ° and °/d
BOUNDS = {"attitude": free, "inertia": inertia_ratios, "noise": interval(LEAST, MOST), "rate": free}

Unravel = Callable[[Array], dict[str, Array]]  # the parameters of a vector


class Estimate(NamedTuple):
    """A spin state with its uncertainty; for several, every field has a leading axis.

    Attributes:
        x: the parameters attitude (°), inertia (ratios), rate (°/d) as a vector, (8,).
        covariance: the covariance of x, (8, 8).
        noise: the noise levels of attitudes (°) and rates (°/d), corrected for the fitted parameters, (2,).
        derived: the quantities of `derived_quantities`, (12,).
        derived_covariance: the covariance of `derived`, to first order, (12, 12).
    """

    x: Array
    covariance: Array
    noise: Array
    derived: Array
    derived_covariance: Array


def residuals(params: dict[str, Array], data: dict[str, Array]) -> list[tuple[Array, Array]]:
    """The residuals of least squares for errors by Student's t with data["freedom"] degrees of freedom, and noise."""
    spin, noise = split_noise(params)
    e = errors(path_of_fits(spin, data), data)
    return [student_t(e[k], noise[k], LEAST, data["freedom"]) for k in range(2)]


def split_noise(params: dict[str, Array]) -> tuple[dict[str, Array], Array]:
    """Separate the parameters of the motion from the noise levels."""
    return {name: leaf for name, leaf in params.items() if name != "noise"}, params["noise"]


def fit_spins(guesses: dict[str, Array], data: dict[str, Array], progress: bool = True) -> Fit:
    """Run many fits at once; each leaf of `guesses` and `data` has a leading axis."""
    return fit(residuals, guesses, bounds=BOUNDS, starts=True, data=data, tolerance=1e-9, progress=progress)


def repeat(tree: PyTree, times: int) -> PyTree:
    """Repeat every leaf of a tree along a new leading axis of length `times`."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (times, *jnp.shape(leaf))), tree)


def derived_quantities(params: dict[str, Array], begin: Array, at_epoch: Array) -> Array:
    """The quantities that are compared with published values, (12,).

    Mean periods of precession and rotation (d); longitude and latitude of the angular momentum (°); the two ratios of
    inertia; Euler 3-1-3 angles (°) and body rate (°/d) at the published epoch, from `at_epoch`, attitude and rate (7,).
    """
    body, state = model(params, begin)
    euler = jnp.rad2deg(so3.to_euler_313(at_epoch[:4])) % 360
    return jnp.concatenate(
        [mean_periods(body, state), longitude_latitude(state.p), params["inertia"], euler, at_epoch[4:]]
    )


def estimates(params: dict[str, Array], data: dict[str, Array]) -> Estimate:
    """The estimates of many fits, with their covariances; each leaf has a leading axis."""
    several = jax.tree.map(np.asarray, (params, data))  # slices of NumPy arrays need no dispatch by JAX
    count = len(several[0]["noise"])
    each = [estimate(*jax.tree.map(lambda leaf: leaf[k], several)) for k in range(count)]  # noqa: B023
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


@jax.jit
def estimate(params: dict[str, Array], data: dict[str, Array]) -> Estimate:
    """The estimate of one fit, with its covariance: the inverse of the observed information.

    The information is that of the linearized motion: the second derivatives of the errors are left out. For the fixes
    of 1992 they change the standard errors by up to 2 %.

    The maximum-likelihood σ of the fit is too small, since the parameters are fitted to the same errors. So σₖ² is
    multiplied by n/(n − m): n is the number of components of kind k, attitudes or rates, and m, the number of
    parameters that they determine, is the trace of the projection onto kind k.
    """
    spin, noise = split_noise(params)
    x, unravel = ravel_pytree(spin)
    times = {"begin": data["begin"], "t": jnp.append(data["t"], data["epoch"])}

    def errors_and_derived(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        found = path_of_fits(unravel(x), times)
        values = errors(found[:-1], data), derived_quantities(unravel(x), data["begin"], found[-1])
        return values, values

    (J, D), (e, of_x) = jax.jacfwd(errors_and_derived, has_aux=True)(x)

    def information(noise: Array) -> Array:
        curvature = jnp.stack([student_t_curvature(e[k], noise[k], data["freedom"]) for k in range(2)])
        return jnp.einsum("knci,kncd,kndj->kij", J, curvature, J)

    share, count = information(noise), e.shape[1] * e.shape[2]
    used = jnp.trace(jnp.linalg.inv(share[0] + share[1]) @ share, axis1=1, axis2=2)
    noise = noise * jnp.sqrt(count / (count - used))
    share = information(noise)
    covariance = jnp.linalg.inv(share[0] + share[1])
    return Estimate(x, covariance, noise, of_x, D @ covariance @ D.T)


class Coverage(NamedTuple):
    """How often the reported uncertainty includes the truth, over synthetic data sets.

    Attributes:
        pulls: (estimate − truth)/reported σ of the 8 parameters, the 2 logarithms of noise, the 12 derived, (sets, 22).
        mahalanobis_squared: the squared distance of the estimate from the truth by its covariance, (sets,), expected
            to be χ² of 8 degrees of freedom.
        success: whether each fit succeeded.
    """

    pulls: np.ndarray
    mahalanobis_squared: np.ndarray
    success: np.ndarray

    @property
    def scatter(self) -> np.ndarray:
        """Root mean square of the pulls of the parameters, and of the noise levels, (2,); 1 for correct errors."""
        return np.sqrt([(self.pulls[:, :8] ** 2).mean(), (self.pulls[:, 8:10] ** 2).mean()])

    def select(self, sets: slice) -> Coverage:
        """The coverage over a part of the sets."""
        return Coverage(*(leaf[sets] for leaf in self))

    def rescale(self, factors: np.ndarray) -> Coverage:
        """The coverage with reported errors enlarged by two factors, for parameters and for noise levels."""
        each = np.where(np.isin(np.arange(self.pulls.shape[1]), (8, 9)), factors[1], factors[0])
        return Coverage(self.pulls / each, self.mahalanobis_squared / factors[0] ** 2, self.success)


def enlarge_errors(estimate: Estimate, factor: float) -> Estimate:
    """Multiply the standard errors of an estimate by a factor."""
    of_x, of_derived = (factor**2 * C for C in (estimate.covariance, estimate.derived_covariance))
    return estimate._replace(covariance=of_x, derived_covariance=of_derived)


def synthetic_data(truth: Estimate, unravel: Unravel, data: dict[str, Array], sets: int, seed: int) -> dict[str, Array]:
    """Synthetic data sets: the fixes of the fitted model, with errors by Student's t of the fitted noise levels."""
    rng = np.random.default_rng(seed)
    found = path(unravel(truth.x), data)
    shape = (2, sets, len(found), 3)
    drawn = rng.normal(size=shape) / np.sqrt(rng.chisquare(DEGREES_OF_FREEDOM, (*shape[:3], 1)) / DEGREES_OF_FREEDOM)
    rotations, changes = jnp.asarray(drawn) * truth.noise[:, None, None, None]

    seen = jax.vmap(jax.vmap(rotate), (0, None))(rotations, found[:, :4])
    return repeat(data, sets) | {"q": seen, "rate": found[:, 4:] + changes}


def coverage(
    truth: Estimate,
    unravel: Unravel,
    data: dict[str, Array],
    sets: int,
    seed: int = 1992,
    progress: bool = True,
) -> Coverage:
    """Fit synthetic data sets of the fitted model, and compare their estimates with the model's parameters."""
    many = synthetic_data(truth, unravel, data, sets, seed)
    begin = unravel(truth.x) | {"noise": truth.noise}
    found = fit_spins(repeat(begin, sets), many, progress)
    assert found.starts is not None
    each = estimates(found.starts.params, many)
    error = each.x - truth.x
    level = jnp.log(each.noise / truth.noise) / student_t_noise_error(len(data["t"]), 3)
    of_derived = (each.derived - truth.derived + 180) % 360 - 180  # angles wrap; periods are far below 180
    sigma, of_sigma = (jnp.sqrt(jnp.diagonal(C, axis1=1, axis2=2)) for C in (each.covariance, each.derived_covariance))
    pulls = jnp.concatenate([error / sigma, level, of_derived / of_sigma], axis=1)
    distance = squared_distances(np.asarray(error), np.asarray(each.covariance))
    return Coverage(np.asarray(pulls), distance, found.starts.success)
