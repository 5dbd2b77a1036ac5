"""A spinning spheroid in water: the spin that makes its heading stable.

A neutrally buoyant spheroid, three times as long as it is wide, moves along its long axis through water at rest and
spins about this axis. Without spin it would turn broadside to its motion; with enough spin its heading is stable.
Units: meters, seconds, and the mass of the spheroid. Other semi-axes are an option.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A spinning spheroid in water"
LAMB = "Lamb, Hydrodynamics, 6th ed., §§114-115 (table of added masses), 124-128"  # and Leonard 1997, Automatica 33:331
SPREAD = (0.05, 0.02)  # 1σ of the angular velocity (rad/s) and of the velocity (m/s), an assumption


def main(
    members: int = 200,
    steps: int = 4000,
    semi_axes: tuple[float, float, float] = (1.0, 1.0, 2.99),
    spin: float = 8.0,
    speed: float = 1.0,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1869,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the spheroid, and measure how far its axis strays.

    Args:
        members: the number of initial states; the first is the nominal one.
        steps: the number of steps of 0.025 s, a multiple of 20.
        semi_axes: of the ellipsoid in m; those of the default are a row of Lamb's table.
        spin: the angular velocity about the third axis, in rad/s.
        speed: the velocity along the third axis, in m/s.
        out: the store of the run; by default kirchhoff.zarr, or kirchhoff-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the path of the center, the tilt of the axes, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("kirchhoff.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    body = li.systems.kirchhoff(semi_axes)
    step = li.schemes.group_midpoint(body, li.maps.exponential)
    noise = jax.random.normal(jax.random.key(seed), (members, 6)).at[0].set(0.0)
    velocities = jnp.array([0.0, 0.0, spin, 0.0, 0.0, speed]) + jnp.repeat(jnp.array(SPREAD), 3) * noise
    states = jax.jit(jax.vmap(lambda v: body.state(velocity=v)))(velocities)
    run = li.run(step, states, 0.025, steps, save_every=20, store=store, resume=resume)
    x, P = np.asarray(run.state.q[..., :3, 3]), np.asarray(run.state.p[0, :, 3:])
    along = np.einsum("mi,mi->m", x[-1] - x[0], P) / np.linalg.norm(P, axis=-1) / run.t[-1]
    tilt = np.rad2deg(li.measure.tilt(run))
    rows = [
        li.report.Row("mean speed along the impulse (/s)", along),
        li.report.Row("third axis strays by (°)", tilt.max(axis=0)),
    ]
    casimirs = np.asarray(run.map(lambda step, state: step.system.casimirs(state)))
    changed = [
        *li.report.changes(run),
        li.report.Change("Π·P and |P|², relative", casimirs, abs(casimirs[0]).max(axis=0)),
    ]
    spread = f"angular velocity {SPREAD[0]} rad/s, velocity {SPREAD[1]} m/s"
    print(li.report.text(TITLE, run, rows, changed=changed, remarks=remarks(run, semi_axes), spread=spread))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw(run, tilt), out.with_name(f"{out.stem}-path.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


def remarks(run, semi_axes):
    """Whether the spin is stable, and the added mass and inertia of the water."""
    body, start = run.system, jax.tree.map(lambda x: jnp.asarray(x[0]), run.member(0).state)
    Pi, needed = np.asarray(body.body_momentum(start)), li.systems.kirchhoff_spin(body)
    ratio = abs(Pi[2] / Pi[5])
    squares, metric = np.square(semi_axes), np.diag(np.asarray(body.metric))
    table = {
        "in the axes of the ellipsoid": semi_axes,
        "added mass ÷ displaced": metric[3:] - 1,
        "added inertia ÷ displaced": metric[:3] / ((squares.sum() - squares) / 5) - 1,
    }
    return [
        f"  |Π₃/P₃| = {ratio:.4f}, needed to move along the third axis: {needed:.4f} [Lamb §128]: "
        f"{'stable' if ratio > needed else 'not stable'}\n",
        *(f"  {name:<34}" + "".join(f"{x:>10.3f}" for x in values) for name, values in table.items()),
        f"  [{LAMB}]",
    ]


@li.plots.style()
def draw(run, tilt):
    """Plot the paths of the centers of the nominal and the last member, and the tilts of all third axes."""
    fig, [axes] = li.plots.figure(2)
    axes[0].remove()
    left = fig.add_subplot(1, 2, 1, projection="3d")
    last = len(run.failed) - 1
    paths = {"nominal member": run.state.q[:, 0, :3, 3], f"member {last}": run.state.q[:, -1, :3, 3]}
    li.plots.space_paths(left, {name: np.asarray(path) for name, path in paths.items()})
    left.set_title("paths of the center, in m")
    li.plots.member_series(axes[1], np.asarray(run.t), tilt, "third axis strays by (°)", "s")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
