"""The material constants λ and μ of an elastic body, estimated from its vibration.

A pseudo-rigid ball, stretched and released, rotates and vibrates. Its strain C = FᵀF is observed with noise, and the
constants of its material are fitted. The data are computed from the equations of motion by collocation of order 16; the
model is the energy-momentum scheme of order 2. The fit uses forward derivatives; as a check, the gradient in reverse
mode, by undoing steps, must vanish at the estimate.
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
from lieint_jax.adjoints import reversible
from lieint_jax.app.studies.inference import table
from lieint_jax.fitting import Fit, fit, positive
from lieint_jax.runs import integrate
from lieint_jax.systems import PseudoRigidBody
from lieint_jax.types import State

TRUTH = {"lam": jnp.array(20.0), "mu": jnp.array(6.0)}
NOISE = 0.005  # standard deviation of each component of C
DT, _EVERY, _SEEN = 0.01, 10, 40


class MaterialFit(NamedTuple):
    """The results of the study."""

    fit: Fit  # the least-squares fit, with a covariance
    # |gradient of the loss| at the estimate over that at the guess, in reverse mode by `reversible`
    gradient_ratio: float
    times: np.ndarray  # the times of the observations, (n,)
    data: np.ndarray  # observed C, (n, 6): xx, yy, zz, yz, xz, xy
    fitted: np.ndarray  # fitted C, (n, 6)


def start(params: dict[str, Array]) -> tuple[PseudoRigidBody, State]:
    """The ball with the constants `params`, and its initial state: stretched by a fifth and rotating."""
    body = PseudoRigidBody(jnp.full(3, 2.0), systems.mooney_rivlin(params["lam"], params["mu"]))
    F = jnp.array([[1.2, 0.05, 0.0], [0.0, 0.95, 0.1], [0.0, 0.0, 0.9]])
    return body, body.state(F, angular_velocity=jnp.array([0.3, 0.2, 1.0]))


def strains(params: dict[str, Array], saves: int, derivative: str) -> tuple[Array, Array]:
    """C at every `_EVERY`-th step, (saves, 6), and whether all steps converged; `derivative`: forward or reverse."""
    body, state = start(params)
    integrator = integrate if derivative == "forward" else reversible
    path = integrator(schemes.additive(body), state, DT, saves * _EVERY, save_every=_EVERY)
    return _components(jax.vmap(body.strain)(path.state))[1:], jnp.all(path.info.converged)


def exact_strains(times: np.ndarray) -> Array:
    """C at `times`, (n, 6), by collocation of order 16."""
    body, state = start(TRUTH)
    advance = jax.jit(lambda state, t: diagnostics.flow(body, state, t, 4))
    observed, now = [], 0.0
    for t in times:
        state, now = advance(state, t - now), t
        observed.append(body.strain(state))
    return _components(jnp.stack(observed))


def _components(C: Array) -> Array:
    """The components xx, yy, zz, yz, xz, xy of symmetric matrices (…, 3, 3), (…, 6)."""
    return C[..., (0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)]


def run(quick: bool = False, progress: bool = True) -> MaterialFit:
    """Fit from a guess with errors of a quarter; `quick` observes for half the time."""
    saves = _SEEN // (2 if quick else 1)
    times = DT * _EVERY * np.arange(1, saves + 1)
    clean = exact_strains(times)
    data = clean + NOISE * jnp.asarray(np.random.default_rng(6).normal(size=clean.shape))
    guess = {"lam": jnp.array(25.0), "mu": jnp.array(4.5)}

    def residuals(params: dict[str, Array], derivative: str = "forward") -> tuple[Array, Array]:
        model, converged = strains(params, saves, derivative)
        return (model - data) / NOISE, converged

    found = fit(residuals, guess, bounds=positive, iterations=30, standardized=True, progress=progress)
    reverse = jax.jit(jax.grad(lambda p: jnp.sum(residuals(p, "reverse")[0] ** 2) / 2))
    first, last = (float(jnp.linalg.norm(ravel_pytree(reverse(p))[0])) for p in (guess, found.params))
    fitted = jax.jit(lambda p: strains(p, saves, "forward")[0])(found.params)
    return MaterialFit(found, last / first, times, np.asarray(data), np.asarray(fitted))


def text(found: MaterialFit) -> str:
    """The report of the study, as text."""
    numbers = ((TRUTH[key], found.fit.params[key], found.fit.standard_errors[key]) for key in TRUTH)
    rows = [(name, f"{t:.4f}", f"{x:.5f}", f"{e:.5f}") for name, (t, x, e) in zip("λμ", numbers, strict=True)]
    lines = [
        f"λ and μ of an elastic ball from {len(found.times)} observations of its strain, noise {NOISE} a component",
        f"  {found.fit.outcome}",
        f"  the gradient in reverse mode, by undoing steps, is {found.gradient_ratio:.1e} of that at the guess\n",
    ]
    return "\n".join([*lines, *table([("", "truth", "estimate", "± 1 sigma"), *rows])])


@plots.style()
def draw(found: MaterialFit) -> Figure:
    """Plot observed and fitted strains."""
    fig, axes = plots.figure(1)
    ax, names = axes[0, 0], ("$C_{xx}$", "$C_{yy}$", "$C_{zz}$")
    plots.series(ax, found.times, dict(zip(names, found.fitted.T, strict=False)), "strain $C$")
    ax.plot(found.times, found.data[:, 0], ".", ms=4, color=plots.PURPLE, label="observed")
    ax.plot(found.times, found.data[:, 1:3], ".", ms=4, color=plots.PURPLE)
    ax.set_title("observed strain, and that of the fitted constants")
    ax.legend()
    return fig
