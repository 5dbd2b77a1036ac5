"""The paper's figures, recomputed: each writes a PNG and returns the table that goes with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import plots
from lieint_jax.diagnostics import energy_error, poisson_error
from lieint_jax.groups import so3
from lieint_jax.integrate import integrate
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.schemes import so3_midpoint
from lieint_jax.systems import rigid_body

KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)
BODIES = {"A": (1.0, 2.0, 3.0), "S": (1.0, 1.0, 2.0)}  # asymmetric and symmetric, as in the caption of Fig. 2
DURATION, OMEGA = 50.0, (0.2, 0.0, 1.0)


class Run(NamedTuple):
    """One integration of Figures 1 and 2: ‖σ_n‖ and H_n − H₀ at every step."""

    body: str
    kappa: str
    dt: float
    poisson: np.ndarray
    energy: np.ndarray


def free_body_run(body: str, kappa_index: int, dt: float) -> Run:
    """Integrate Ω₀ = (.2, 0, 1) for t = 50 and follow the Poisson error and the energy."""
    system = rigid_body(BODIES[body])
    step = so3_midpoint(system, KAPPAS[kappa_index])
    state = system.state(angular_velocity=OMEGA)
    n = round(DURATION / dt)

    def measure() -> tuple[jax.Array, jax.Array]:
        sigma = jax.vmap(so3.vee)(poisson_error(step, state, dt, n))
        return jnp.linalg.norm(sigma, axis=1), energy_error(system, integrate(step, state, dt, n))

    poisson, energy = jax.jit(measure)()
    return Run(body, step.kappa.name, dt, np.asarray(poisson), np.asarray(energy))


def figure_1(out: Path) -> str:
    """Poisson errors of Cayley and exponential at Δt = .05, both bodies, as in the paper's Figure 1."""
    fig, axes = plots.figure(2)
    lines = []
    for ax, body in zip(axes[0], BODIES, strict=True):
        runs = [free_body_run(body, k, 0.05) for k in range(2)]
        t = 0.05 * np.arange(len(runs[0].poisson))
        plots.series(ax, t, {run.kappa: run.poisson for run in runs}, "Poisson error |σ|")
        ax.set_title(f"J = diag{tuple(int(x) for x in BODIES[body])}")
        lines += [f"  J = {BODIES[body]}  {run.kappa:<12} max|σ| = {run.poisson.max():.3g}" for run in runs]
    fig.savefig(out / "figure-1.png", dpi=150)
    return "\n".join(["Figure 1: Poisson errors over t = 50 at Δt = 0.05", *lines])


def figure_2(out: Path) -> str:
    """Largest Poisson errors and energy changes at Δt = .05 and .005, as in the paper's Figure 2."""
    runs = [free_body_run(body, k, dt) for dt in (0.05, 0.005) for body in BODIES for k in range(3)]
    groups = [(body, dt) for dt in (0.05, 0.005) for body in BODIES]
    fig, axes = plots.figure(2)
    quantities = {
        "max |σ|": [run.poisson.max() for run in runs],
        "max H − min H": [max(np.ptp(run.energy), np.finfo(float).eps / 10) for run in runs],
    }
    for ax, (label, values) in zip(axes[0], quantities.items(), strict=True):
        for k, kappa in enumerate(KAPPAS):
            colour = (plots.INK, plots.RED, plots.BLUE)[k]
            ax.bar(np.arange(4) + 0.27 * (k - 1), values[k::3], 0.25, color=colour, label=kappa.name)
        ax.set_xticks(range(4), [f"{body}\nΔt={dt}" for body, dt in groups])
        ax.set_yscale("log")
        ax.set_ylim(1e-17, 100 * max(values))
        ax.set_ylabel(label)
        ax.legend(frameon=False, fontsize="small", ncols=3, loc="upper center")
    fig.savefig(out / "figure-2.png", dpi=150)
    rows = [
        f"  {run.dt:<6} {run.body}  {run.kappa:<12} {run.poisson.max():>10.3g} {np.ptp(run.energy):>12.2g}"
        for run in runs
    ]
    head = f"  {'Δt':<6} J  {'κ':<12} {'max|σ|':>10} {'max H−min H':>12}"
    return "\n".join(["Figure 2: A is J = diag(1,2,3), S is J = diag(1,1,2); t = 50", head, *rows])


FIGURES: dict[int, Callable[[Path], str]] = {1: figure_1, 2: figure_2}
