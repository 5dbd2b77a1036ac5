"""The paper's figures, recomputed: each function writes a PNG and a PDF and returns a table of the numbers drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import plots
from lieint_jax.diagnostics import delay, energy_error, poisson_error
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS
from lieint_jax.runs import integrate
from lieint_jax.schemes import additive, so3_midpoint
from lieint_jax.systems import mooney_rivlin, pseudo_rigid_body, rigid_body, saint_venant_kirchhoff
from lieint_jax.types import State, Step

BODIES = {"A": (1.0, 2.0, 3.0), "S": (1.0, 1.0, 2.0)}  # asymmetric and symmetric, as in the caption of Fig. 2
DURATION, OMEGA = 50.0, (0.2, 0.0, 1.0)
STEPS = 4000  # of Figures 3 to 5
LABELS = {  # of the scalings κ by their names, in TeX
    "cayley": r"$\kappa = 1$, Cayley",
    "exponential": r"$\kappa = \tan(|\bar\Theta|/2)\,/\,(|\bar\Theta|/2)$, exponential",
    "symplectic": r"$\kappa = 2\,/\,(1 + \sqrt{1 - |\bar\Theta|^2})$, symplectic",
}


class Run(NamedTuple):
    """One integration for Figures 1 and 2 and Appendix A: ‖σ_n‖, H_n − H₀ and Λ_n, (3, 3), at every step."""

    body: str
    kappa: str
    dt: float
    poisson: np.ndarray
    energy: np.ndarray
    rotations: np.ndarray


def free_body_run(body: str, kappa_index: int, dt: float) -> Run:
    """Integrate from Ω₀ = (0.2, 0, 1) to t = 50, and measure the Poisson error and the energy."""
    system = rigid_body(BODIES[body])
    step = so3_midpoint(system, KAPPAS[kappa_index])
    state = system.state(angular_velocity=OMEGA)
    n = round(DURATION / dt)

    def measure() -> tuple[jax.Array, ...]:
        sigma, run = jax.vmap(so3.vee)(poisson_error(step, state, dt, n)), integrate(step, state, dt, n)
        return jnp.linalg.norm(sigma, axis=1), energy_error(system, run), jax.vmap(so3.to_matrix)(run.state.q)

    return Run(body, step.kappa.name, dt, *map(np.asarray, jax.jit(measure)()))


def _inertia(body: str) -> str:
    return f"J = diag{tuple(int(x) for x in BODIES[body])}"


@plots.style()
def figure_1(out: Path) -> str:
    """Poisson errors at Δt = 0.05, both bodies: the paper's Figure 1, and a line of the symplectic κ, which is at 0."""
    fig, axes = plots.figure(2)
    lines = []
    for ax, body in zip(axes[0], BODIES, strict=True):
        runs = [free_body_run(body, k, 0.05) for k in range(len(KAPPAS))]
        t = 0.05 * np.arange(len(runs[0].poisson))
        plots.series(ax, t, {LABELS[run.kappa]: run.poisson for run in runs}, "Poisson error |σ|")
        lines += [f"  J = {BODIES[body]}  {run.kappa:<12} max|σ| = {run.poisson.max():.3g}" for run in runs]
    plots.letter_panels(axes, [_inertia(body) for body in BODIES])
    plots.legend_below(axes)
    fig.suptitle("Poisson errors of the scalings κ at Δt = 0.05: only the symplectic κ has none")
    plots.save(fig, out / "figure-1.png")
    return "\n".join(["Figure 1: Poisson errors over t = 50 at Δt = 0.05", *lines])


@plots.style()
def figure_2(out: Path) -> str:
    """Largest Poisson errors and energy changes at Δt = 0.05 and 0.005, as in the paper's Figure 2."""
    runs = [free_body_run(body, k, dt) for dt in (0.05, 0.005) for body in BODIES for k in range(3)]
    groups = [(body, dt) for dt in (0.05, 0.005) for body in BODIES]
    fig, axes = plots.figure(2)
    quantities = {
        "max |σ|": [run.poisson.max() for run in runs],
        "max H − min H": [max(np.ptp(run.energy), np.finfo(float).eps / 10) for run in runs],
    }
    for ax, values in zip(axes[0], quantities.values(), strict=True):
        for k, kappa in enumerate(KAPPAS):
            color = (plots.INK, plots.RED, plots.BLUE)[k]
            ax.bar(np.arange(4) + 0.27 * (k - 1), values[k::3], 0.25, color=color, label=LABELS[kappa.name])
        ax.set_xticks(range(4), [f"{_inertia(body)}\nΔt = {dt}" for body, dt in groups], fontsize="small")
        ax.set_yscale("log")
        ax.set_ylim(1e-17, 10 * max(values))
        plots.round_off(ax)
    plots.letter_panels(axes, [f"{label}, t ≤ {DURATION:g}" for label in quantities])
    plots.legend_below(axes)
    plots.save(fig, out / "figure-2.png")
    rows = [
        f"  {run.dt:<6} {run.body}  {run.kappa:<12} {run.poisson.max():>10.3g} {np.ptp(run.energy):>12.2g}"
        for run in runs
    ]
    head = f"  {'Δt':<6} J  {'κ':<12} {'max|σ|':>10} {'max H−min H':>12}"
    return "\n".join(["Figure 2: A is J = diag(1,2,3), S is J = diag(1,1,2); t = 50", head, *rows])


@plots.style()
def showtop(out: Path) -> str:
    """Appendix A's `showtop`: the path of the tips of the body axes in space, the energy, and the Poisson error |σ|."""
    run = free_body_run("A", 0, 0.05)
    fig, axes = plots.figure(3)
    axes[0, 0].remove()
    tips = fig.add_subplot(1, 3, 1, projection="3d")
    for k, color in enumerate((plots.INK, plots.RED, plots.BLUE)):
        tips.plot(*run.rotations[:, :, k].T, color=color, lw=0.7, label=f"axis {k + 1}")
    plots.cube(tips).set(xlabel="x", ylabel="y", zlabel="z")
    tips.legend(loc="upper right")
    t = run.dt * np.arange(len(run.energy))
    for ax, y, label in zip(axes[0, 1:], (run.energy, run.poisson), ("H − H₀", "Poisson error |σ|"), strict=True):
        plots.series(ax, t, {"": y}, label)
    titles = [f"tips of the body axes, {_inertia(run.body)}", "energy", "Poisson error"]
    plots.letter_panels(np.array([tips, *axes[0, 1:]]), titles)
    fig.suptitle(f"Free body by the scheme with {LABELS[run.kappa]}, Δt = {run.dt}")
    plots.save(fig, out / "figure-showtop.png")
    return (
        f"showtop (Appendix A): {run.kappa} κ, t = {DURATION:g}, Δt = {run.dt}\n"
        f"  max |H − H₀| = {np.abs(run.energy).max():.2g}, max|σ| = {run.poisson.max():.3g}"
    )


class Panel(NamedTuple):
    """One panel of Figures 3 to 5: a delay plot of the energy, or of the displacement ‖F − 1‖²."""

    name: str  # number of the figure and letter of the panel in the paper
    dt: float  # time step
    lag: int  # N of the delay plot
    Phi: float  # P₀ = π̂F₀ with π = (0, 0, Phi)
    printed: float  # the variation, max − min, printed in the caption
    displacement: bool = False  # whether the displacement is plotted, not the energy
    F33: float | None = None  # None for F₀ = 1; else F₀ = ((1.01, 0.01, 0), (0.01, 1.01, 0), (0, 0, F33))
    steps: int = STEPS  # the number of steps, at most STEPS
    note: str = ""  # a remark for the table


_UNSTABLE = "1500 steps; later, growing rounding errors break the symmetry of this motion"
_EXCHANGED = "with F33 = 0.9 in place of 0.99, and the captions of (a) and (b) exchanged"
PANELS = {
    3: (
        Panel("3a", 0.005, 3, 0.4, 4.0e-8),
        Panel("3b", 0.005, 3, 2.0, 1.8e-5),
        Panel("3c", 0.005, 3, 6.0, 2.3e-3),
        Panel("3d", 0.005, 3, 10.0, 1.6e-1),
    ),
    4: (
        Panel("4a", 0.05, 3, 6.0, 3.9e-1),
        Panel("4b", 0.05, 5, 6.0, 3.9e-1),
        Panel("4c", 0.05, 3, 10.0, 6.2, steps=1500, note=_UNSTABLE),
        Panel("4d", 0.05, 5, 10.0, 6.2, steps=1500, note=_UNSTABLE),
    ),
    5: (
        Panel("5a", 0.005, 3, 0.0, 2.0e-2, F33=0.9, note=_EXCHANGED),
        Panel("5b", 0.05, 5, 0.0, 1.6, F33=0.9, note=_EXCHANGED),
        Panel("5c", 0.001, 3, 0.0, 3.1e-4, True, F33=0.99, note="St Venant–Kirchhoff, (6.13): not reproduced"),
        Panel("5d", 0.05, 5, 10.0, 32.1, True, steps=1500, note=_UNSTABLE),
    ),
}


class DelayRun(NamedTuple):
    """The series that a panel shows, at every step, and whether every step converged."""

    series: np.ndarray
    converged: bool


def delay_run(panel: Panel) -> DelayRun:
    """Integrate a panel of Figures 3 to 5.

    E = 2·1; λ = 2000, μ = 6; by the implicit midpoint rule (6.17), except for 5c: by (6.13), which gives γ = ½ for its
    material.
    """
    saint_venant = panel.name == "5c"
    body = pseudo_rigid_body(np.full(3, 2.0), (saint_venant_kirchhoff if saint_venant else mooney_rivlin)(2000.0, 6.0))
    F = np.eye(3) if panel.F33 is None else np.array([[1.01, 0.01, 0], [0.01, 1.01, 0], [0, 0, panel.F33]])
    state = body.state(F, momentum=so3.hat(jnp.array([0.0, 0.0, panel.Phi])) @ F)
    step = additive(body, "average" if saint_venant else "symplectic")
    energy, displacement, converged = (np.asarray(x)[: panel.steps + 1] for x in _series(step, state, panel.dt))
    return DelayRun(displacement if panel.displacement else energy, bool(converged.all()))


@jax.jit
def _series(step: Step, state: State, dt: float) -> tuple[jax.Array, jax.Array, jax.Array]:
    run = integrate(step, state, dt, STEPS)
    displacement = jnp.sum((run.state.q - jnp.eye(3)) ** 2, axis=(1, 2))
    return jax.vmap(step.system.energy)(run.state), displacement, run.info.converged


@plots.style()
def _delay_figure(number: int, out: Path) -> str:
    fig, axes = plots.figure(2, 2, subplot_kw={"projection": "3d"})
    lines = [f"Figure {number}: variation max − min", f"  {'':<4} {'ours':>9} {'printed':>9}   all converged"]
    for ax, panel in zip(axes.flat, PANELS[number], strict=True):
        run = delay_run(panel)
        symbol, kind = ("d", "d = ‖F − 1‖²") if panel.displacement else ("H", "H")
        plots.delay_plot(ax, np.asarray(delay(jnp.asarray(run.series), panel.lag)), symbol)
        variation = np.ptp(run.series)
        ax.set_title(
            f"({panel.name[1]}) Δt = {panel.dt:g}, N = {panel.lag}, π₃ = {panel.Phi:g}\n"
            f"max {kind[0]} − min {kind[0]} = {_tex(variation)}; in the paper {_tex(panel.printed)}"
        )
        verdict = "yes" if run.converged else "NO"
        lines.append(f"  {panel.name:<4} {variation:>9.3g} {panel.printed:>9.3g}   {verdict:<4} {panel.note}".rstrip())
    shown = " or ".join(dict.fromkeys("d = ‖F − 1‖²" if panel.displacement else "energy H" for panel in PANELS[number]))
    at = "at the steps n, n + N and n + 2N, less the middle of its range"
    fig.suptitle(f"Delay plots of the midpoint rule: {shown} {at}")
    plots.save(fig, out / f"figure-{number}.png")
    return "\n".join(lines)


def _tex(x: float) -> str:
    """A number with two digits, in TeX."""
    mantissa, _, power = f"{x:.1e}".partition("e")
    return f"{x:.2g}" if x >= 1e-2 else rf"${mantissa}\times10^{{{int(power)}}}$"


FIGURES: dict[str, Callable[[Path], str]] = {"1": figure_1, "2": figure_2, "showtop": showtop} | {
    str(number): partial(_delay_figure, number) for number in PANELS
}
