"""A spinning elastic ball: its vibration, with the delay plots of the paper's Figure 3c.

An elastic ball spins so fast that it flattens and vibrates. A pseudo-rigid body deforms homogeneously, x = F X. The
average rule conserves its energy and momentum; the implicit midpoint rule does not conserve the energy. The paper does
not name its units.
"""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A spinning elastic ball"
PAPER = "Lewis & Simo 1994, caption of Figure 3c"
SECOND_MOMENTS = (2.0, 2.0, 2.0)  # of mass; not given in the paper, inferred from its captions
LAM, MU = 2000.0, 6.0  # Lamé's constants times the volume [PAPER]
SPIN = (0.0, 0.0, 3.0)  # the paper's momentum 6 [PAPER], which is half the physical one, (tr(E)1 − E) ω = 4 × 3
DT, LAG = 0.005, 3  # the step size, and the delay of the delay plots in steps [PAPER]
SPREAD = (0.01, 0.05)  # 1σ of each entry of F, and of the angular velocity, an assumption
LONGEST = 4000  # steps that are compared with the midpoint rule


def main(
    members: int = 100,
    steps: int = 4000,
    rule: Literal["average", "symplectic", "energy", "energy_momentum"] = "average",
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1994,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the ball, and compare its energy with that of the implicit midpoint rule.

    Args:
        members: the number of initial states; the first is that of the paper.
        steps: the number of steps of 0.005, a multiple of 4.
        rule: of the scheme `additive`; "symplectic" is the implicit midpoint rule.
        out: the store of the run; by default pseudo_rigid.zarr, or pseudo_rigid-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw delay plots, energies and errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("pseudo_rigid.zarr", resume)
    ball = li.systems.pseudo_rigid_body(jnp.array(SECOND_MOMENTS), li.systems.mooney_rivlin(LAM, MU))
    step = li.schemes.additive(ball, rule)
    noise = jax.random.normal(jax.random.key(seed), (members, 4, 3)).at[0].set(0.0)

    def state(noise):
        F = jnp.eye(3) + SPREAD[0] * noise[:3]
        return ball.state(F, angular_velocity=jnp.array(SPIN) + SPREAD[1] * noise[3])

    run = li.run(step, jax.jit(jax.vmap(state))(noise), DT, steps, save_every=4, store=out, resume=resume)
    start = jax.tree.map(lambda x: jnp.asarray(x[0]), run.member(0).state)
    rules = {f"the rule {rule!r}": step, "implicit midpoint rule": li.schemes.additive(ball, "symplectic")}
    found = {name: li.run(s, start, DT, min(steps, LONGEST), progress=False) for name, s in rules.items()}
    energy = {name: np.asarray(one.map(lambda step, z: step.system.energy(z))) for name, one in found.items()}
    remarks = [
        f"  {'least det F':<34}{np.linalg.det(run.state.q).min():>10.3g}   above 0, or flagged",
        f"\n  energy of the nominal member, {min(steps, LONGEST)} steps, max − min",
        *(f"  {name:<34}{np.ptp(H):>12.3g}" for name, H in energy.items()),
    ]
    remarks[-1] += f"   published 0.0023  ({PAPER})"
    if not all(one.converged for one in found.values()):
        remarks.append("  NOT all of these steps converged: values after the first failure are wrong")
    spread = "F {}, angular velocity {}".format(*SPREAD)
    print(li.report.text(TITLE, run, changed=li.report.changes(run), remarks=remarks, spread=spread))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_torus(*found.values()), out.with_name(f"{out.stem}-torus.png"))
        drawn += li.plots.save(draw_energy(next(iter(found.values())), energy), out.with_name(f"{out.stem}-energy.png"))
        print("pictures:", *drawn)


def displacement(run):
    """‖F − 1‖² at the saved times."""
    return np.sum((np.asarray(run.state.q) - np.eye(3)) ** 2, axis=(1, 2))


@li.plots.style()
def draw_torus(one, midpoint):
    """Draw delay plots as in the paper's Figures 3 to 5: of the midpoint rule's energy, and of the displacement."""
    fig, [axes] = li.plots.figure(2, subplot_kw={"projection": "3d"})
    H = np.asarray(midpoint.map(lambda step, z: step.system.energy(z)))
    panels = {"energy H of the midpoint rule": ("H", H), "displacement d = ‖F − 1‖²": ("d", displacement(one))}
    for ax, (title, (symbol, x)) in zip(axes, panels.items(), strict=True):
        li.plots.delay_plot(ax, x, LAG, symbol)
        ax.set_title(f"{title},\nless the middle of its range, at the steps n, n + N, n + 2N; N = {LAG}")
    fig.suptitle(TITLE)
    return fig


@li.plots.style()
def draw_energy(one, energy):
    """Plot the energy errors by both rules, and the displacement."""
    fig, [axes] = li.plots.figure(2)
    size = max(float(abs(H[0])) for H in energy.values())
    errors = {name: H - H[0] for name, H in energy.items()}
    li.plots.log_error(axes[0], np.asarray(one.t), errors, "energy error", size=size, of="|H₀|")
    li.plots.series(axes[1], np.asarray(one.t), {"": displacement(one)}, "displacement ‖F − 1‖²")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
