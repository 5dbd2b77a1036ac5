"""A rate gyro on a tumbling body: inertia ratios and biases from noisy readings, in a hundred trials.

The gyro measures only body rates, Ω(t) + bias + noise. They depend on the inertia only by its ratios, so there are
eight unknowns: two ratios, three initial rates, three biases. The data are synthetic, from the exact motion in elliptic
functions; the model is the scheme of order 6. If the reported covariance is correct, each parameter lies within 2σ of
the truth in 95 of 100 trials, and the truth lies in the joint 95 % ellipsoid in 95. Units: s, rad/s.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import chdtri

import lieint_jax as li

TITLE = "A rate gyro on a tumbling body"
TRUTH = {"bias": [0.02, -0.01, 0.015], "inertia": [0.6, 0.8], "rate": [0.5, 0.3, 0.4]}  # rad/s, ratios to Jz, rad/s
GUESS = {"bias": [0.0, 0.0, 0.0], "inertia": [0.63, 0.78]}  # the first reading is the guess of the rate
BOUNDS = {"bias": li.fitting.free, "inertia": li.fitting.inertia_ratios, "rate": li.fitting.free}
NAMES = ("bias x", "bias y", "bias z", "Jx/Jz", "Jy/Jz", "Ωx(0)", "Ωy(0)", "Ωz(0)")  # rad/s, ratios, rad/s
NOISE = 0.002  # rad/s, the standard deviation of each reading
EVERY, READINGS = 0.5, 80  # s between readings, and their number
RATIOS = slice(3, 5)  # the places of the inertia ratios among the eight numbers


def main(trials: int = 100, out: Path | None = None, seed: int = 4, pictures: bool = True) -> None:
    """Fit all trials at once, and count how often their errors include the truth.

    Args:
        trials: the number of synthetic data sets of 80 readings, at least 2.
        out: the picture; by default gyro.png, or gyro-2.png where that exists.
        seed: of the noise.
        pictures: draw the readings of the first trial, and the ratios of all of them.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("gyro.png")
    truth = jax.tree.map(jnp.array, TRUTH, is_leaf=lambda x: isinstance(x, list))
    noise = np.random.default_rng(seed).normal(size=(trials, READINGS, 3))
    data = exact_readings(truth) + NOISE * jnp.asarray(noise)
    guesses = {name: jnp.tile(jnp.array(value), (trials, 1)) for name, value in GUESS.items()} | {"rate": data[:, 0]}
    found = li.fit(residuals, guesses, bounds=BOUNDS, starts=True, data=data, standardized=True)
    fits, true = found.starts, np.asarray(ravel_pytree(truth)[0])
    assert fits is not None  # since `starts=True`
    x, sigma = (np.asarray(jax.vmap(lambda p: ravel_pytree(p)[0])(p)) for p in (fits.params, fits.standard_errors))
    columns = true, x.mean(axis=0), x.std(axis=0, ddof=1), sigma.mean(axis=0), (abs(x - true) <= 2 * sigma).mean(axis=0)
    inside = squared_distances(x - true, fits.covariance) <= chdtri(len(true), 0.05)  # the 95 % point of χ²
    print(f"{TITLE}: {trials} synthetic trials of {READINGS} readings, noise {NOISE} rad/s")
    print(f"  {fits.success.sum()} of {trials} fits succeeded; {found.iterations} iterations\n")
    print(f"{'truth':>17}{'mean':>11}{'scatter':>11}{'reported σ':>12}{'within 2σ':>11}")
    for name, t, mean, scatter, reported, within in zip(NAMES, *columns, strict=True):
        print(f"  {name:<6}{t:>9.4f}{mean:>11.5f}{scatter:>11.5f}{reported:>12.5f}{100 * within:>10.0f}%")
    print(f"\n  truth inside the joint 95 % ellipsoid: {100 * inside.mean():.0f} % of the trials")
    if pictures:
        fitted = np.asarray(jax.jit(readings)(jax.tree.map(lambda leaf: leaf[0], fits.params))[0])
        covariance = np.asarray(fits.covariance).mean(axis=0)[RATIOS, RATIOS]
        print("pictures:", *li.plots.save(draw(data[0], fitted, x[:, RATIOS], true[RATIOS], covariance), out))


def readings(params):
    """The readings of a noise-free gyro, (readings, 3), by the scheme, and whether all steps converged."""
    body = li.systems.RigidBody(jnp.append(params["inertia"], 1.0))
    start = body.state(angular_velocity=params["rate"])
    path = li.integrate(li.schemes.preprocessed(body, 6), start, EVERY, READINGS)
    return jax.vmap(body.angular_velocity)(path.state)[1:] + params["bias"], path.info.converged


def exact_readings(params):
    """The readings of a noise-free gyro, (readings, 3), by the closed form of the motion."""
    body = li.systems.RigidBody(jnp.append(params["inertia"], 1.0))
    start = body.state(angular_velocity=params["rate"])
    t = EVERY * jnp.arange(1, READINGS + 1)
    return jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(t) + params["bias"]


def residuals(params, data):
    """Calculated less observed rates in units of the noise, and whether all steps converged."""
    model, converged = readings(params)
    return (model - data) / NOISE, converged


def squared_distances(errors, covariances):
    """The squared distances eᵀC⁻¹e, (n,), of errors (n, p) by their covariances, (n, p, p) or (1, p, p)."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


@li.plots.style()
def draw(data, fitted, estimates, truth, covariance):
    """Plot the readings of one trial, and all estimates of the ratios with the ellipse of 95 % probability."""
    fig, [[left, right]] = li.plots.figure(2)
    fig.suptitle(TITLE)
    t = EVERY * np.arange(1, READINGS + 1)
    li.plots.series(left, t, dict(zip("xyz", fitted.T, strict=True)), "body rate (rad/s)", "s")
    left.plot(t, data, ".", ms=3, color=li.plots.INK, alpha=0.35, label="readings")
    handles, labels = left.get_legend_handles_labels()
    left.legend(handles[:4], labels[:4])
    left.set_title("readings of the first trial and the fitted motion")
    radius, angle = np.sqrt(chdtri(2, 0.05)), np.linspace(0, 2 * np.pi, 145)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)])
    inside = (squared_distances(estimates - truth, covariance[None]) <= radius**2).sum()
    right.plot(*estimates.T, ".", ms=4, color=li.plots.BLUE, label="estimates")
    right.plot(*truth, "x", ms=9, mew=2, color=li.plots.RED, label="truth")
    label = f"95 % ellipse of the mean reported\ncovariance: {inside} of {len(estimates)} inside"
    right.plot(*(truth[:, None] + np.linalg.cholesky(covariance) @ circle), color=li.plots.INK, lw=1, label=label)
    right.set(xlabel="$J_x/J_z$", ylabel="$J_y/J_z$", title=f"inertia ratios, {len(estimates)} trials")
    right.locator_params(axis="x", nbins=5)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.3 * (high - low))  # room for the legend
    right.legend(loc="upper left")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
