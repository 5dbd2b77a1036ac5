"""Finite-time Lyapunov exponents of a chaotic heavy top, from the linearization of the step itself.

The tangent flow maps a frame, W ← L_n W with L_n the derivative of the step in (δθ, δπ), and a QR decomposition after
each step makes it orthonormal again; the logarithms of R's diagonal add up to the exponents times t. Their sum is zero
to round-off for a symplectic step, and in the limit they come in pairs ±λ. On a chaotic motion one pair does not vanish
in the limit; the others tend to zero like log(t)/t: one belongs to the flow's direction and energy, one to the rotation
about the vertical and its momentum.

Two independent methods check the exponents: the variational equations of the vector field, by another integrator
(`exponents_of_flow`), and two neighboring trajectories that separate and are rescaled (`exponent_of_neighbors`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from lieint_jax import _discover, diagnostics, plots, schemes, systems
from lieint_jax.runs import saves
from lieint_jax.types import State, Step

_BLOCKS = 10


class LyapunovSpectrum(NamedTuple):
    """The results of the study."""

    t: np.ndarray  # times, (n,)
    exponents: np.ndarray  # finite-time exponents at these times, (n, 6), 1/time unit
    total: float  # sum of the exponents at the end
    pair_defect: float  # largest |λ_i + λ_{7−i}| at the end, with the exponents in descending order
    short_run: np.ndarray  # exponents at the end of a short run by `exponents`, (6,)
    variational: np.ndarray  # exponents at the same time from the variational equations, (6,)
    two_trajectories: float  # the largest exponent over the whole run by two neighbors
    # the largest exponent over the second half of the run, and its standard error from `_BLOCKS` blocks
    limit: tuple[float, float]


def exponents(step: Step, state: State, dt: float, num_steps: int, save_every: int = 1) -> tuple[Array, Array]:
    """Finite-time Lyapunov exponents at even intervals, by `diagnostics.lyapunov` with a QR decomposition each step.

    Returns:
        Times (n,), and exponents (n, 2d) in units of 1/time, in the order of the frame, descending in the limit.
    """
    num_saves, dim = saves(num_steps, save_every), step.system.phase_space.dim
    found = diagnostics.lyapunov(step, state, dt, num_steps, vectors=np.eye(dim), batches=num_saves)
    t = dt * save_every * jnp.arange(1, num_saves + 1)
    return t, jnp.cumsum(found.growth, axis=0) / t[:, None]


def run(quick: bool = False, progress: bool = True) -> LyapunovSpectrum:
    """Compute the exponents of an asymmetric heavy top by Strang splitting; `quick` runs for a fifth of the time."""
    from tqdm import tqdm  # where it is used: the package imports in a moment

    top, state, _ = _discover.modules_with("examples", systems)["heavy_top"].examples()["asymmetric_top"]
    dt, steps = 0.05, 4000 if quick else 20_000
    step = schemes.splitting(top)
    fine, short = 0.005, 20.0
    precise = schemes.compose(step, 6)
    compute = jax.jit(exponents, static_argnums=(2, 3, 4))
    parts = (
        lambda: compute(step, state, dt, steps, steps // 200),
        lambda: compute(precise, state, 10 * fine, round(short / fine / 10), 1)[1][-1],
        lambda: jax.jit(diagnostics.exponents_of_flow, static_argnums=(2, 3))(top, state, short, 100),
        lambda: jax.jit(diagnostics.exponent_of_neighbors, static_argnums=(2, 3))(step, state, dt, steps),
    )
    bar = tqdm(parts, unit="part", disable=None if progress else True, leave=False)
    (t, values), short_values, independent, neighbors = (jax.block_until_ready(part()) for part in bar)
    last = np.sort(np.asarray(values[-1]))[::-1]
    ends = slice(len(t) // 2 - 1, None, len(t) // (2 * _BLOCKS))
    rates = np.asarray(jnp.diff((values[:, 0] * t)[ends]) / jnp.diff(t[ends]))
    return LyapunovSpectrum(
        np.asarray(t),
        np.asarray(values),
        float(last.sum()),
        float(np.abs(last + last[::-1]).max()),
        np.asarray(short_values),
        np.asarray(independent),
        float(neighbors),
        (float(rates.mean()), float(rates.std(ddof=1) / np.sqrt(_BLOCKS))),
    )


def text(found: LyapunovSpectrum) -> str:
    """The report of the study, as text."""

    def row(values: np.ndarray) -> str:
        return "(" + ", ".join(f"{x:9.5f}" for x in values) + ")"

    lines = [
        "Lyapunov exponents of a chaotic heavy top, J = (1, 2, 2.5), E = (0.5, 0.4, 1)",
        f"  to t = 20, order 6:            {row(found.short_run)}",
        f"  the same by the vector field:  {row(found.variational)}",
        f"  largest difference             {np.abs(found.short_run - found.variational).max():.1e}",
        f"  to t = {found.t[-1]:g}, splitting:      {row(found.exponents[-1])}",
        f"  their sum                      {found.total:.1e}; pairs ±λ to {found.pair_defect:.1e}",
        f"  largest by two neighbors      {found.two_trajectories:.5f}",
        "  largest, over the second half  {:.4f} ± {:.4f}, a standard error".format(*found.limit),
    ]
    return "\n".join(lines)


@plots.style()
def draw(found: LyapunovSpectrum) -> Figure:
    """Plot the exponents against time."""
    fig, axes = plots.figure(1)
    curves = {f"$\\lambda_{k + 1}$": found.exponents[:, k] for k in range(found.exponents.shape[1])}
    plots.series(axes[0, 0], found.t, curves, "finite-time exponent").axhline(0, lw=0.5, color=plots.GRAY)
    return fig
