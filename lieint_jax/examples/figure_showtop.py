"""The driver `showtop` of Appendix A: the path of the body axes of a free body.

The appendix of the paper prints a program that integrates a free rigid body, and draws the path of the tips of its axes
in space. The energy stays at round-off; the Poisson error |σ| grows unless the scaling κ is the symplectic one. All
quantities are without units.
"""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

INERTIA, OMEGA = (1.0, 2.0, 3.0), (0.2, 0.0, 1.0)  # principal moments; initial angular velocity in the body
LABELS = {  # of the scalings κ, in TeX
    "cayley": r"$\kappa = 1$, Cayley",
    "exponential": r"$\kappa = \tan(|\bar\Theta|/2)\,/\,(|\bar\Theta|/2)$, exponential",
    "symplectic": r"$\kappa = 2\,/\,(1 + \sqrt{1 - |\bar\Theta|^2})$, symplectic",
}


def main(
    kappa: Literal["cayley", "exponential", "symplectic"] = "cayley",
    dt: float = 0.05,
    duration: float = 50.0,
    out: Path | None = None,
) -> None:
    """Integrate the body, and draw the tips of its axes, the energy, and the Poisson error.

    Args:
        kappa: the scaling κ of the midpoint rule; the appendix has that of Cayley.
        dt: the step size.
        duration: the time of the motion.
        out: the picture; by default figure-showtop.png, or figure-showtop-2.png where that exists.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("figure-showtop.png")
    so3, steps = li.groups.so3, round(duration / dt)
    body = li.systems.rigid_body(INERTIA)
    [scaling] = [known for known in li.maps.KAPPAS if known.name == kappa]
    step, state = li.schemes.so3_midpoint(body, scaling), body.state(angular_velocity=OMEGA)
    run = li.integrate(step, state, dt, steps)
    sigma = jax.jit(lambda z: jax.vmap(so3.vee)(li.diagnostics.poisson_error(step, z, dt, steps)))(state)
    energy, poisson = np.asarray(li.Run.of(step, run).energy_error()), np.asarray(jnp.linalg.norm(sigma, axis=1))
    print(f"showtop (Appendix A): {kappa} κ, t = {duration:g}, Δt = {dt:g}")
    print(f"  max |H − H₀| = {np.abs(energy).max():.2g}, max|σ| = {poisson.max():.3g}")
    rotations = np.asarray(jax.vmap(so3.to_matrix)(run.state.q))
    fig = draw(np.asarray(run.t), rotations, energy, poisson)
    fig.suptitle(f"Free body by the scheme with {LABELS[kappa]}, Δt = {dt:g}")
    print("pictures:", *li.plots.save(fig, out))


@li.plots.style()
def draw(t, rotations, energy, poisson):
    """Plot the paths of the columns of the rotation matrices, (n, 3, 3), the energy, and the Poisson error."""
    fig, axes = li.plots.figure(3)
    axes[0, 0].remove()
    tips = fig.add_subplot(1, 3, 1, projection="3d")
    for k, color in enumerate((li.plots.INK, li.plots.RED, li.plots.BLUE)):
        tips.plot(*rotations[:, :, k].T, color=color, lw=0.7, label=f"axis {k + 1}")
    li.plots.cube(tips).set(xlabel="x", ylabel="y", zlabel="z")
    tips.legend(loc="upper right")
    for ax, y, label in zip(axes[0, 1:], (energy, poisson), ("H − H₀", "Poisson error |σ|"), strict=True):
        li.plots.series(ax, t, {"": y}, label)
    titles = ["tips of the body axes, J = diag({:g}, {:g}, {:g})".format(*INERTIA), "energy", "Poisson error"]
    li.plots.letter_panels(np.array([tips, *axes[0, 1:]]), titles)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
