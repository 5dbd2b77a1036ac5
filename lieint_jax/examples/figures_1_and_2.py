"""Figures 1 and 2 of the paper: Poisson errors of three scalings κ, and energy.

Every scaling κ of the midpoint rule conserves the energy and the momentum of a free rigid body to round-off. Only the
symplectic one also conserves the Poisson bracket: its error |σ| is zero. The errors of the Cayley and the exponential
scalings grow with time, and a tenth of the step has a hundredth of them. All quantities are without units.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

BODIES = {"A": (1.0, 2.0, 3.0), "S": (1.0, 1.0, 2.0)}  # asymmetric and symmetric, as in the caption of Figure 2
OMEGA = (0.2, 0.0, 1.0)  # initial angular velocity in the body
LABELS = {  # of the scalings κ, in TeX
    "cayley": r"$\kappa = 1$, Cayley",
    "exponential": r"$\kappa = \tan(|\bar\Theta|/2)\,/\,(|\bar\Theta|/2)$, exponential",
    "symplectic": r"$\kappa = 2\,/\,(1 + \sqrt{1 - |\bar\Theta|^2})$, symplectic",
}


def main(figure: Literal[1, 2] = 1, dt: float = 0.05, duration: float = 50.0, out: Path | None = None) -> None:
    """Integrate both bodies with the three scalings κ, and draw Figure 1 or 2.

    Args:
        figure: the number in the paper; 1: errors against time, 2: the largest ones, also at a tenth of the step.
        dt: the step size.
        duration: the time over which the errors are measured.
        out: the picture; by default figure-1.png, or figure-1-2.png where that exists.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path(f"figure-{figure}.png")
    sizes = (dt,) if figure == 1 else (dt, dt / 10)
    cases = [Case(body, kappa.name, size, duration) for size in sizes for body in BODIES for kappa in li.maps.KAPPAS]
    runs = {case: errors(case) for case in cases}
    print((text_1 if figure == 1 else text_2)(runs))
    print("pictures:", *li.plots.save((draw_1 if figure == 1 else draw_2)(runs), out))


class Case(NamedTuple):
    """A body, a scaling κ, a step size and a duration."""

    body: str
    kappa: str
    dt: float
    duration: float = 50.0


def errors(case):
    """The Poisson errors |σ| and the changes of energy of a case, at every step, (n + 1,) each."""
    [kappa] = [kappa for kappa in li.maps.KAPPAS if kappa.name == case.kappa]
    body = li.systems.rigid_body(BODIES[case.body])
    step, state, n = li.schemes.so3_midpoint(body, kappa), body.state(angular_velocity=OMEGA), case.duration / case.dt

    def measure():
        sigma = jax.vmap(li.groups.so3.vee)(li.diagnostics.poisson_error(step, state, case.dt, round(n)))
        run = li.integrate(step, state, case.dt, round(n))
        return jnp.linalg.norm(sigma, axis=1), li.Run.of(step, run).energy_error()

    return tuple(np.asarray(x) for x in jax.jit(measure)())


def text_1(runs):
    """The largest Poisson errors, one line for each run."""
    rows = [f"  J = {BODIES[x.body]}  {x.kappa:<12} max|σ| = {sigma.max():.3g}" for x, (sigma, _) in runs.items()]
    first = next(iter(runs))
    return "\n".join([f"Figure 1: Poisson errors over t = {first.duration:g} at Δt = {first.dt:g}", *rows])


def text_2(runs):
    """The largest Poisson errors and the ranges of energy, as a table."""
    rows = [
        f"  {x.dt:<6g} {x.body}  {x.kappa:<12} {sigma.max():>10.3g} {np.ptp(energy):>12.2g}"
        for x, (sigma, energy) in runs.items()
    ]
    head = f"  {'Δt':<6} J  {'κ':<12} {'max|σ|':>10} {'max H−min H':>12}"
    duration = next(iter(runs)).duration
    return "\n".join([f"Figure 2: A is {inertia('A')}, S is {inertia('S')}; t = {duration:g}", head, *rows])


@li.plots.style()
def draw_1(runs):
    """Plot the Poisson errors of each body against time."""
    (fig, axes), dt = li.plots.figure(2), next(iter(runs)).dt
    for ax, body in zip(axes[0], BODIES, strict=True):
        curves = {LABELS[x.kappa]: sigma for x, (sigma, _) in runs.items() if x.body == body}
        li.plots.series(ax, dt * np.arange(len(next(iter(curves.values())))), curves, "Poisson error |σ|")
    li.plots.letter_panels(axes, [inertia(body) for body in BODIES])
    li.plots.legend_below(axes)
    fig.suptitle(f"Poisson errors of the scalings κ at Δt = {dt:g}: only the symplectic κ has none")
    return fig


@li.plots.style()
def draw_2(runs):
    """Plot the largest Poisson errors and the ranges of energy of all runs as bars."""
    fig, axes = li.plots.figure(2)
    least = np.finfo(float).eps / 10  # a bar for a range of zero, which has no logarithm
    quantities = {
        "max |σ|": [sigma.max() for sigma, _ in runs.values()],
        "max H − min H": [max(np.ptp(energy), least) for _, energy in runs.values()],
    }
    groups = list(dict.fromkeys(f"{inertia(x.body)}\nΔt = {x.dt:g}" for x in runs))
    for ax, values in zip(axes[0], quantities.values(), strict=True):
        for k, (label, color) in enumerate(
            zip(LABELS.values(), (li.plots.INK, li.plots.RED, li.plots.BLUE), strict=True)
        ):
            ax.bar(np.arange(len(groups)) + 0.27 * (k - 1), values[k::3], 0.25, color=color, label=label)
        ax.set_xticks(range(len(groups)), groups, fontsize="small")
        ax.set_yscale("log")
        ax.set_ylim(1e-17, 10 * max(values))
        li.plots.round_off(ax)
    li.plots.letter_panels(axes, [f"{label}, t ≤ {next(iter(runs)).duration:g}" for label in quantities])
    li.plots.legend_below(axes)
    return fig


def inertia(body):
    """The moments of inertia of a body, in words."""
    return "J = diag({:g}, {:g}, {:g})".format(*BODIES[body])


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
