"""Figures 3 to 5 of the paper: the energy of pseudo-rigid bodies, in delay plots.

The symplectic midpoint rule does not conserve the energy of a pseudo-rigid body. Each panel plots it at the steps n,
n + N and n + 2N as a point in space, and its caption has the variation, max − min, next to the one printed in the
paper. The variations agree but for panel 5c; where the printed initial state or caption is in error, a note says what
stands in its place. All quantities are without units.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

EULER_TENSOR = (2.0, 2.0, 2.0)  # E
LAME = (2000.0, 6.0)  # λ, μ
STEPS = 4000  # of a panel, unless it has its own number


class Panel(NamedTuple):
    """One panel: a delay plot of the energy, or of the displacement ‖F − 1‖²."""

    name: str  # number of the figure and letter of the panel in the paper
    dt: float  # step size
    lag: int  # N of the delay plot
    Phi: float  # P₀ = π̂F₀ with π = (0, 0, Phi)
    printed: float  # the variation, max − min, printed in the caption
    displacement: bool = False  # whether the displacement is plotted, not the energy
    F33: float | None = None  # None for F₀ = 1; else F₀ = ((1.01, 0.01, 0), (0.01, 1.01, 0), (0, 0, F33))
    steps: int = STEPS
    note: str = ""  # a remark for the table


UNSTABLE = "1500 steps; later, growing rounding errors break the symmetry of this motion"
EXCHANGED = "with F33 = 0.9 in place of 0.99, and the captions of (a) and (b) exchanged"
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
        Panel("4c", 0.05, 3, 10.0, 6.2, steps=1500, note=UNSTABLE),
        Panel("4d", 0.05, 5, 10.0, 6.2, steps=1500, note=UNSTABLE),
    ),
    5: (
        Panel("5a", 0.005, 3, 0.0, 2.0e-2, F33=0.9, note=EXCHANGED),
        Panel("5b", 0.05, 5, 0.0, 1.6, F33=0.9, note=EXCHANGED),
        Panel("5c", 0.001, 3, 0.0, 3.1e-4, True, F33=0.99, note="St Venant–Kirchhoff, (6.13): not reproduced"),
        Panel("5d", 0.05, 5, 10.0, 32.1, True, steps=1500, note=UNSTABLE),
    ),
}


def main(figure: Literal[3, 4, 5] = 3, out: Path | None = None) -> None:
    """Integrate the four motions of a figure, compare their variations with the printed ones, and draw it.

    Args:
        figure: the number in the paper.
        out: the picture; by default figure-3.png, or figure-3-2.png where that exists.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path(f"figure-{figure}.png")
    found = {panel: series(panel) for panel in PANELS[figure]}
    print(f"Figure {figure}: variation max − min\n  {'':<4} {'ours':>9} {'printed':>9}   all converged")
    for panel, (x, converged) in found.items():
        verdict = "yes" if converged else "NO"
        row = f"  {panel.name:<4} {np.ptp(x):>9.3g} {panel.printed:>9.3g}   {verdict:<4} {panel.note}"
        print(row.rstrip())
    print("pictures:", *li.plots.save(draw(found), out))


def series(panel):
    """What a panel shows, at every step, (steps + 1,), and whether every step converged.

    The scheme is the implicit midpoint rule (6.17), except for 5c: there it is (6.13), which gives γ = ½ for its
    material.
    """
    saint_venant = panel.name == "5c"
    material = li.systems.saint_venant_kirchhoff if saint_venant else li.systems.mooney_rivlin
    body = li.systems.pseudo_rigid_body(jnp.array(EULER_TENSOR), material(*LAME))
    F = jnp.eye(3)
    if panel.F33 is not None:
        F = jnp.array([[1.01, 0.01, 0.0], [0.01, 1.01, 0.0], [0.0, 0.0, panel.F33]])
    state = body.state(F, momentum=li.groups.so3.hat(jnp.array([0.0, 0.0, panel.Phi])) @ F)
    step = li.schemes.additive(body, "average" if saint_venant else "symplectic")
    x, converged = measure(step, state, panel.dt, panel.displacement)
    return np.asarray(x[: panel.steps + 1]), bool(converged[: panel.steps + 1].all())


@jax.jit
def measure(step, state, dt, displacement):
    """The displacement or else the energy, and whether each step converged; compiled once for equal schemes."""
    run = li.integrate(step, state, dt, STEPS)
    distance = jnp.sum((run.state.q - jnp.eye(3)) ** 2, axis=(1, 2))
    return jnp.where(displacement, distance, jax.vmap(step.system.energy)(run.state)), run.info.converged


@li.plots.style()
def draw(found):
    """Plot the four panels as points (x_n, x_{n+N}, x_{n+2N})."""
    fig, axes = li.plots.figure(2, 2, subplot_kw={"projection": "3d"})
    for ax, (panel, (x, _)) in zip(axes.flat, found.items(), strict=True):
        symbol = "d" if panel.displacement else "H"
        li.plots.delay_plot(ax, x, panel.lag, symbol)
        ax.set_title(
            f"({panel.name[1]}) Δt = {panel.dt:g}, N = {panel.lag}, π₃ = {panel.Phi:g}\n"
            f"max {symbol} − min {symbol} = {tex(np.ptp(x))}; in the paper {tex(panel.printed)}"
        )
    shown = " or ".join(dict.fromkeys("d = ‖F − 1‖²" if panel.displacement else "energy H" for panel in found))
    at = "at the steps n, n + N and n + 2N, less the middle of its range"
    fig.suptitle(f"Delay plots of the midpoint rule: {shown} {at}")
    return fig


def tex(x):
    """A number with two digits, in TeX."""
    mantissa, _, power = f"{x:.1e}".partition("e")
    return f"{x:.2g}" if x >= 1e-2 else rf"${mantissa}\times10^{{{int(power)}}}$"


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
