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

from lieint_jax import plots, schemes
from lieint_jax.app.studies.inference import table
from lieint_jax.fitting import Fit, inertia_ratios, inference
from lieint_jax.fitting.inference import Estimate, Params, Problem, Unknown
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBody

TRUTH = {
    "bias": jnp.array([0.02, -0.01, 0.015]),  # rad/s
    "inertia": jnp.array([0.6, 0.8]),  # ratios to the third moment
    "rate": jnp.array([0.5, 0.3, 0.4]),  # rad/s
}
NOISE = 0.002  # rad/s, standard deviation of each reading
_EVERY, _READINGS = 0.5, 80  # seconds between readings, and their number


class GyroTrials(NamedTuple):
    """The results of the study."""

    fit: Fit  # the fit of all trials; `fit.starts` holds the single fits
    estimates: np.ndarray  # estimated parameters, (trials, 8), in the order of `PROBLEM.names`
    truth: np.ndarray  # true parameters, (8,)
    sigmas: np.ndarray  # reported standard errors, (trials, 8)
    covariance: np.ndarray  # the mean of the reported covariances, (8, 8)
    within_2_sigma: np.ndarray  # the share of trials with each parameter within 2σ of the truth, (8,)
    inside_ellipsoid: float  # the share of trials with the truth in the joint 95 % ellipsoid
    # the times, the readings, and the fitted rates with bias of the first trial
    readings: tuple[np.ndarray, np.ndarray, np.ndarray]


def rates(params: Params) -> tuple[Array, Array]:
    """The readings of a noise-free gyro, (readings, 3), by the scheme, and whether all steps converged."""
    body = RigidBody(jnp.append(params["inertia"], 1.0))
    start = body.state(angular_velocity=params["rate"])
    path = integrate(schemes.preprocessed(body, 6), start, _EVERY, _READINGS)
    rate = jax.vmap(body.angular_velocity)(path.state)[1:]
    return rate + params["bias"], jnp.all(path.info.converged)


def exact_rates(params: Params) -> Array:
    """The readings of a noise-free gyro, (readings, 3), by the closed form of the motion."""
    body = RigidBody(jnp.append(params["inertia"], 1.0))
    start = body.state(angular_velocity=params["rate"])
    t = _EVERY * jnp.arange(1, _READINGS + 1)
    return jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(t) + params["bias"]


def errors(params: Params, data: Array) -> tuple[Array, Array]:
    """The difference of model and data, (readings, 3), and whether all steps converged."""
    model, converged = rates(params)
    return model - data, converged


PROBLEM = Problem(
    {
        "bias": Unknown(("bias x", "bias y", "bias z"), (0.0, 0.0, 0.0)),
        "inertia": Unknown(("Jx/Jz", "Jy/Jz"), (0.63, 0.78), inertia_ratios),
        "rate": Unknown(("Ωx(0)", "Ωy(0)", "Ωz(0)"), (0.5, 0.3, 0.4)),
    },
    errors,
    data=None,
    noise=NOISE,
)


def run(quick: bool = False, trials: int = 100, seed: int = 4, progress: bool = True) -> GyroTrials:
    """Fit all trials at once, each from a guess with errors of about a tenth; `quick` runs 12 trials."""
    trials = 12 if quick else trials
    noise = np.random.default_rng(seed).normal(size=(trials, _READINGS, 3))
    data = exact_rates(TRUTH) + NOISE * jnp.asarray(noise)
    guesses = inference.repeat(PROBLEM.guess, trials) | {"rate": data[:, 0]}
    best = inference.fit_starts(PROBLEM, guesses, data, progress=progress, standardized=True, tolerance=1e-10)
    each, truth = inference.estimates(PROBLEM, best, data), np.asarray(ravel_pytree(TRUTH)[0])
    assert best.starts is not None
    test = inference.compare(PROBLEM, Estimate.exact(truth), each, best.starts.success)
    within, inside = (
        inference.shares(test.pulls).within_2 / 100,
        test.mahalanobis_squared <= inference.chi_square_point(8),
    )
    fitted = np.asarray(rates(PROBLEM.unravel(each.x[0]))[0])
    readings = _EVERY * np.arange(1, _READINGS + 1), np.asarray(data[0]), fitted
    mean = each.covariance.mean(axis=0)
    return GyroTrials(best, each.x, truth, each.sigmas, mean, within, float(inside.mean()), readings)


def text(found: GyroTrials) -> str:
    """The report of the study, as text."""
    x, starts = found.estimates, found.fit.starts
    assert starts is not None
    columns = found.truth, x.mean(axis=0), x.std(axis=0, ddof=1), found.sigmas.mean(axis=0), found.within_2_sigma
    rows = [
        (name, f"{t:.4f}", *(f"{v:.5f}" for v in values), f"{100 * within:.0f}%")
        for name, t, *values, within in zip(PROBLEM.names, *columns, strict=True)
    ]
    lines = [
        f"A rate gyro on a tumbling body: {len(x)} synthetic trials of {_READINGS} readings, noise {NOISE} rad/s",
        f"  {int(starts.success.sum())} of {len(x)} fits succeeded; {found.fit.iterations} iterations\n",
        *table([("", "truth", "mean", "scatter", "reported σ", "within 2σ"), *rows]),
    ]
    inside = f"{100 * found.inside_ellipsoid:.0f} % of the trials"
    return "\n".join([*lines, f"\n  truth inside the joint 95 % ellipsoid: {inside}"])


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
    radius, ratios = np.sqrt(-2 * np.log(0.05)), slice(3, 5)  # 95 % of χ² with two degrees of freedom
    estimates, truth, covariance = found.estimates[:, ratios], found.truth[ratios], found.covariance[ratios, ratios]
    inside = int((inference.squared_distances(estimates - truth, covariance[None]) <= radius**2).sum())
    right.plot(*estimates.T, ".", ms=4, color=plots.BLUE, label="estimates")
    right.plot(*truth, "x", ms=9, mew=2, color=plots.RED, label="truth")
    label = f"95 % ellipse of the mean reported\ncovariance: {inside} of {len(estimates)} inside"
    right.plot(*inference.ellipse(truth, covariance, radius).T, color=plots.INK, lw=1, label=label)
    right.set(xlabel="$J_x/J_z$", ylabel="$J_y/J_z$", title=f"inertia ratios, {len(estimates)} trials")
    right.locator_params(axis="x", nbins=5)
    right.margins(y=0.1)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
    right.legend(loc="upper left")
    return fig
