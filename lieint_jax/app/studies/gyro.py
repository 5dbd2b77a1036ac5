"""Inertia ratios and biases of a tumbling body, estimated from a noisy rate gyro in a hundred trials.

The gyro measures only body rates, Ω(t) + bias + noise. They depend on the inertia only by its ratios, so there are
eight unknowns: two ratios, three initial rates, three biases. The data are synthetic, from the exact motion in elliptic
functions; the model is the scheme of order 6. If the reported covariance is correct, each parameter lies within 2σ of
the truth in 95 of 100 trials, and the truth lies in the joint 95 % ellipsoid in 95.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

from lieint_jax import schemes
from lieint_jax.app import plots
from lieint_jax.app.studies._pulls import ELLIPSOID, squared_distances
from lieint_jax.fitting import Fit, fit, free, inertia_ratios
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBody

TRUTH = {
    "bias": jnp.array([0.02, -0.01, 0.015]),  # rad/s
    "inertia": jnp.array([0.6, 0.8]),  # ratios to the third moment
    "rate": jnp.array([0.5, 0.3, 0.4]),  # rad/s
}
NOISE = 0.002  # rad/s, standard deviation of each reading
_EVERY, _READINGS = 0.5, 80  # seconds between readings, and their number
_NAMES = ("bias x", "bias y", "bias z", "Jx/Jz", "Jy/Jz", "Ωx(0)", "Ωy(0)", "Ωz(0)")


class GyroTrials(NamedTuple):
    """The results of the study.

    Attributes:
        fit: the fit of all trials; `fit.starts` holds the single fits.
        estimates: estimated parameters, (trials, 8), in the order of `_NAMES`.
        truth: true parameters, (8,).
        sigmas: reported standard errors, (trials, 8).
        covariance: the mean of the reported covariances, (8, 8).
        within_2_sigma: the share of trials with each parameter within 2σ of the truth, (8,).
        inside_ellipsoid: the share of trials with the truth in the joint 95 % ellipsoid.
        readings: the times, the readings, and the fitted rates with bias of the first trial.
    """

    fit: Fit
    estimates: np.ndarray
    truth: np.ndarray
    sigmas: np.ndarray
    covariance: np.ndarray
    within_2_sigma: np.ndarray
    inside_ellipsoid: float
    readings: tuple[np.ndarray, np.ndarray, np.ndarray]


def rates(params: dict[str, Array]) -> tuple[Array, Array]:
    """The readings of a noise-free gyro, (readings, 3), by the scheme, and whether all steps converged."""
    body = _body(params)
    start = body.state(angular_velocity=params["rate"])
    path = integrate(schemes.preprocessed(body, 6), start, _EVERY, _READINGS)
    rate = jax.vmap(body.angular_velocity)(path.state)[1:]
    return rate + params["bias"], jnp.all(path.info.converged)


def exact_rates(params: dict[str, Array]) -> Array:
    """The readings of a noise-free gyro, (readings, 3), by the closed form of the motion."""
    body = _body(params)
    start = body.state(angular_velocity=params["rate"])
    t = _EVERY * jnp.arange(1, _READINGS + 1)
    return jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(t) + params["bias"]


def residuals(params: dict[str, Array], data: Array) -> tuple[Array, Array]:
    """The difference of model and data in units of the noise, (readings, 3), and whether all steps converged."""
    model, converged = rates(params)
    return (model - data) / NOISE, converged


def run(quick: bool = False, trials: int = 100, seed: int = 4, progress: bool = True) -> GyroTrials:
    """Fit all trials at once, each from a guess with errors of about a tenth; `quick` runs 12 trials."""
    trials = 12 if quick else trials
    noise = np.random.default_rng(seed).normal(size=(trials, _READINGS, 3))
    data = exact_rates(TRUTH) + NOISE * jnp.asarray(noise)
    guess = {"bias": jnp.zeros(3), "inertia": jnp.array([0.63, 0.78]), "rate": jnp.array([0.5, 0.3, 0.4])}
    guesses = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (trials, *leaf.shape)), guess)
    guesses["rate"] = data[:, 0]
    bounds = {"bias": free, "inertia": inertia_ratios, "rate": free}
    best = fit(residuals, guesses, bounds=bounds, starts=True, data=data, standardized=True, progress=progress)
    assert best.starts is not None
    assert best.starts.covariance is not None
    estimates = np.asarray(jax.vmap(lambda p: ravel_pytree(p)[0])(best.starts.params))
    truth = np.asarray(ravel_pytree(TRUTH)[0])
    error = estimates - truth
    sigmas = np.sqrt(np.diagonal(best.starts.covariance, axis1=1, axis2=2))
    square = squared_distances(error, best.starts.covariance)
    t = _EVERY * np.arange(1, _READINGS + 1)
    fitted = rates(jax.tree.map(lambda leaf: leaf[0], best.starts.params))[0]
    return GyroTrials(
        best,
        estimates,
        truth,
        sigmas,
        np.asarray(best.starts.covariance).mean(axis=0),
        (np.abs(error) <= 2 * sigmas).mean(axis=0),
        float((square <= ELLIPSOID).mean()),
        (t, np.asarray(data[0]), np.asarray(fitted)),
    )


def _body(params: dict[str, Array]) -> RigidBody:
    return RigidBody(jnp.append(params["inertia"], 1.0))


def text(found: GyroTrials) -> str:
    """The report of the study, as text."""
    trials = len(found.estimates)
    starts = found.fit.starts
    assert starts is not None
    lines = [
        f"A rate gyro on a tumbling body: {trials} synthetic trials of {_READINGS} readings, noise {NOISE} rad/s",
        f"  {int(starts.success.sum())} of {trials} fits succeeded; {found.fit.iterations} iterations\n",
        f"  {'':<8}{'truth':>9}{'mean':>11}{'scatter':>11}{'reported σ':>12}{'within 2σ':>11}",
    ]
    mean, scatter, sigma = found.estimates.mean(axis=0), found.estimates.std(axis=0, ddof=1), found.sigmas.mean(axis=0)
    lines += [
        f"  {name:<8}{t:>9.4f}{m:>11.5f}{s:>11.5f}{r:>12.5f}{100 * w:>10.0f}%"
        for name, t, m, s, r, w in zip(_NAMES, found.truth, mean, scatter, sigma, found.within_2_sigma, strict=True)
    ]
    return "\n".join(
        [*lines, f"\n  truth inside the joint 95 % ellipsoid: {100 * found.inside_ellipsoid:.0f} % of the trials"]
    )


@plots.style()
def draw(found: GyroTrials) -> Figure:
    """Plot the readings of one trial, and all estimates of the ratios with the ellipse of 95 % probability."""
    fig, axes = plots.figure(2)
    t, data, fitted = found.readings
    left, right = axes[0]
    plots.series(left, t, dict(zip("xyz", fitted.T, strict=True)), "body rate (rad/s)", "s")
    left.plot(t, data, ".", ms=3, color=plots.INK, alpha=0.35, label="readings")
    handles, labels = left.get_legend_handles_labels()
    left.legend(handles[:4], labels[:4])
    left.set_title("readings of the first trial and the fitted motion")
    ellipse, inside = _ellipse(found)
    estimates, truth = found.estimates[:, 3:5], found.truth[3:5]
    right.plot(*estimates.T, ".", ms=4, color=plots.BLUE, label="estimates")
    right.plot(*truth, "x", ms=9, mew=2, color=plots.RED, label="truth")
    label = f"95 % ellipse of the mean reported\ncovariance: {inside} of {len(estimates)} inside"
    right.plot(*ellipse.T, color=plots.INK, lw=1, label=label)
    right.set(xlabel="$J_x/J_z$", ylabel="$J_y/J_z$", title=f"inertia ratios, {len(estimates)} trials")
    right.locator_params(axis="x", nbins=5)
    right.margins(y=0.1)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
    right.legend(loc="upper left")
    return fig


def _ellipse(found: GyroTrials) -> tuple[np.ndarray, int]:
    """The 95 % ellipse (n, 2) of both ratios about the truth, and the number of estimates inside."""
    chol = np.linalg.cholesky(found.covariance[3:5, 3:5])
    angle = np.linspace(0, 2 * np.pi, 145)
    radius = np.sqrt(-2 * np.log(0.05))  # of χ² with two degrees of freedom
    offsets = np.linalg.solve(chol, (found.estimates - found.truth)[:, 3:5].T)
    ellipse = found.truth[3:5] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ chol.T
    return ellipse, int((np.linalg.norm(offsets, axis=0) <= radius).sum())
