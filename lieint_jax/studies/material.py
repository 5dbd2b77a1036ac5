"""λ and μ of an elastic body out of its vibration.

A pseudo-rigid ball, stretched and let go, turns and vibrates. What is seen is its strain C = FᵀF at irregular times,
with noise; what is sought are the constants of its material. The data come from the equations of motion by collocation
of order 16; the model is the energy-momentum scheme of order 2 at observation times between its steps (`observe`), once
by L-BFGS with the derivative by undoing steps, once by least squares with the forward one: two derivatives, two
optimisers, one answer.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

from lieint_jax import diagnostics, plots, schemes, systems
from lieint_jax.studies._bounds import positive
from lieint_jax.studies._fit import Fit, fit
from lieint_jax.studies._reversible import observe
from lieint_jax.systems import PseudoRigidBody
from lieint_jax.types import State

TRUTH = {"lam": jnp.array(20.0), "mu": jnp.array(6.0)}
NOISE = 0.005  # of each component of C
DT, _END, _SEEN = 0.02, 4.0, 40


class Found(NamedTuple):
    """What the study found.

    Attributes:
        fit: by least squares, with a covariance.
        reverse: by L-BFGS with `observe`'s reverse mode.
        times: of the observations.
        data: C observed, (n, 6): xx, yy, zz, yz, xz, xy.
        fitted: C of the fit.
        discretisation: λ and μ of noiseless data by the same fit: the bias of the scheme's own error.
    """

    fit: Fit
    reverse: Fit
    times: np.ndarray
    data: np.ndarray
    fitted: np.ndarray
    discretisation: dict[str, Array]


def start(params: dict[str, Array]) -> tuple[PseudoRigidBody, State]:
    """The ball of these constants, stretched by a fifth and turning."""
    body = PseudoRigidBody(jnp.full(3, 2.0), systems.mooney_rivlin(params["lam"], params["mu"]))
    F = jnp.array([[1.2, 0.05, 0.0], [0.0, 0.95, 0.1], [0.0, 0.0, 0.9]])
    return body, body.state(F, angular_velocity=jnp.array([0.3, 0.2, 1.0]))


def strains(params: dict[str, Array], times: Array, derivative: str) -> tuple[Array, Array]:
    """C at the times, (n, 6), and whether the steps converged."""
    body, state = start(params)
    step = schemes.additive(body)
    seen, info = observe(step, state, DT, times, derivative=derivative)  # pyright: ignore[reportArgumentType]
    return _six(jax.vmap(body.strain)(seen)), jnp.all(info.converged)


def exact_strains(times: np.ndarray) -> Array:
    """C by collocation of order 16, from one time to the next."""
    body, state = start(TRUTH)
    move = jax.jit(lambda state, t: diagnostics.flow(body, state, t, 4))
    seen, now = [], 0.0
    for t in times:
        state, now = move(state, t - now), t
        seen.append(body.strain(state))
    return _six(jnp.stack(seen))


def run(quick: bool = False, progress: bool = True) -> Found:
    """Both fits from a guess that is a quarter off; `quick` observes half the time."""
    rng = np.random.default_rng(6)
    part = 2 if quick else 1
    times = np.sort(rng.uniform(0, _END / part, _SEEN // part))
    clean = exact_strains(times)
    data = clean + NOISE * jnp.asarray(rng.normal(size=clean.shape))
    guess = {"lam": jnp.array(25.0), "mu": jnp.array(4.5)}

    def residuals(params: dict[str, Array], data: Array) -> tuple[Array, Array]:
        seen, converged = strains(params, times, "checkpoint")  # pyright: ignore[reportArgumentType]
        return (seen - data) / NOISE, converged

    def half_square(params: dict[str, Array]) -> tuple[Array, Array]:
        seen, converged = strains(params, times, "reversible")  # pyright: ignore[reportArgumentType]
        return jnp.sum(((seen - data) / NOISE) ** 2) / 2, converged

    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), guess)
    squares = fit(
        residuals, both, bounds=positive, iterations=40, starts=True, data=jnp.stack([data, clean]), progress=progress
    )
    assert squares.starts is not None
    assert squares.starts.covariance is not None
    noisy, noiseless = (jax.tree.map(lambda leaf, k=k: leaf[k], squares.starts.params) for k in (0, 1))
    first = squares._replace(
        params=noisy,
        loss=float(squares.starts.loss[0]),
        success=bool(squares.starts.success[0]),
        covariance=squares.starts.covariance[0],
        starts=None,
    )
    reverse = fit(half_square, guess, "lbfgs", bounds=positive, iterations=40, progress=progress)
    fitted = strains(noisy, times, "checkpoint")[0]  # pyright: ignore[reportArgumentType]
    return Found(first, reverse, times, np.asarray(data), np.asarray(fitted), noiseless)


def _six(C: Array) -> Array:
    i, j = (0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)
    return C[..., i, j]


def text(found: Found) -> str:
    """The report."""
    errors = found.fit.standard_errors
    lines = [
        f"λ and μ of an elastic ball from {len(found.times)} observations of its strain, noise {NOISE} a component",
        f"  least squares, forward derivative:   {found.fit}",
        f"  L-BFGS, derivative by undoing steps: {found.reverse}\n",
        f"  {'':<4}{'truth':>9}{'least squares':>15}{'± 1 sigma':>11}{'L-BFGS':>12}{'without noise':>15}",
    ]
    lines += [
        f"  {symbol:<4}{TRUTH[key]:>9.4f}{found.fit.params[key]:>15.5f}{errors[key]:>11.5f}"
        f"{found.reverse.params[key]:>12.5f}{found.discretisation[key]:>15.5f}"
        for key, symbol in (("lam", "λ"), ("mu", "μ"))
    ]
    return "\n".join([*lines, f"  what is off without noise is the scheme's own error at Δt = {DT}"])


def draw(found: Found) -> Figure:
    """Strains observed and fitted."""
    fig, axes = plots.figure(1)
    plots.series(axes[0, 0], found.times, dict(zip(("Cxx", "Cyy", "Czz"), found.fitted.T, strict=False)), "strain C")
    axes[0, 0].plot(found.times, found.data[:, :3], ".", ms=3, color=plots.GREY)
    return fig


def estimates(found: Found) -> np.ndarray:
    """(λ, μ) of both fits, (2, 2)."""
    return np.stack([ravel_pytree(f.params)[0] for f in (found.fit, found.reverse)])
