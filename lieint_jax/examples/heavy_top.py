"""A fast heavy top: nutation and precession, compared with the closed form.

A symmetric top under gravity, its center of mass above the fixed point, precesses about the vertical and nutates. It is
released without precession, so that the path of its axis has cusps. Times are in seconds.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A fast heavy top"
INERTIA = (5.0, 5.0, 1.0)  # about the fixed point [Simo & Wong 1991, Int. J. Numer. Methods Eng. 31:19]
WEIGHT = (0.0, 0.0, 20.0)  # weight times the vector to the center of mass, in the body [the same]
TILT, SPIN = 0.3, 50.0  # rad from the vertical, rad/s about the axis [the same]
SPREAD = np.deg2rad([1.0, 15.0])  # 1σ of attitude (rad) and spin (rad/s), an assumption, to show neighboring motions


def main(
    members: int = 200,
    steps: int = 10_000,
    dt: float = 0.01,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1991,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the top and compare its nutation with the closed form.

    Args:
        members: the number of initial states; the first is the nominal one.
        steps: the number of steps, a multiple of 5.
        dt: the step size in s; at 0.01 the closed form is met to 12 digits.
        out: the store of the run; by default heavy_top.zarr, or heavy_top-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the path of the axis, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("heavy_top.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    so3 = li.groups.so3
    top = li.systems.heavy_top(INERTIA, WEIGHT)
    step = li.schemes.nystrom(top, 6)

    def state(noise):
        tilt = so3.exp(jnp.array([TILT, 0.0, 0.0]))
        turn, change = SPREAD[:, None] * noise
        return top.state(so3.multiply(so3.exp(turn), tilt), angular_velocity=jnp.array([0.0, 0.0, SPIN]) + change)

    noise = jax.random.normal(jax.random.key(seed), (members, 2, 3)).at[0].set(0.0)
    run = li.run(step, jax.jit(jax.vmap(state))(noise), dt, steps, save_every=5, store=store, resume=resume)
    start = jax.tree.map(lambda x: x[0], run.member(0).state)
    closed, found = li.systems.lagrange_motion(top, start), li.measure.nutation(run)
    low, high = np.rad2deg(closed.inclination)
    rows = [
        li.report.Row("nutation period (s)", found.period, closed_form=closed.nutation_period),
        li.report.Row("mean precession (rad/s)", found.precession_rate, closed_form=closed.precession_rate),
        li.report.Row("least inclination (°)", np.rad2deg(found.least), closed_form=low),
        li.report.Row("greatest inclination (°)", np.rad2deg(found.greatest), closed_form=high),
    ]
    print(
        li.report.text(
            TITLE,
            run,
            rows,
            changed=li.report.changes(run),
            remarks=["  closed form: elliptic integrals; the difference is the scheme's error, or round-off"],
            spread="attitude 1°, angular velocity 15°/s",
        )
    )
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_path(run, closed), out.with_name(f"{out.stem}-path.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


@li.plots.style()
def draw_path(run, closed):
    """Plot the axis on the sphere for a revolution about the vertical, all members at the end, and its inclination."""
    fig, axes = li.plots.figure(2)
    left = fig.add_subplot(1, 2, 1, projection="3d")
    axes[0, 0].remove()
    t = np.linspace(0.0, min(2 * np.pi / abs(closed.precession_rate), run.t[-1]), 4000)
    path, ends = (axis_in_space(q) for q in (run.member(0).at(t).q, run.state.q[-1]))
    bounds, up = np.rad2deg(closed.inclination), np.array([0.0, 0.0, 1.0])
    li.plots.on_sphere(
        (left, axes[0, 1]), t, path, float(run.t[-1]), ends, up, unit="s", pole_label="up", bounds=bounds
    )
    axes[0, 1].set_title("inclination; dashed, the bounds in closed form")
    fig.suptitle(TITLE)
    return fig


def axis_in_space(q):
    """The directions in space of the top's axis, (n, 3), at attitudes (n, 4)."""
    return np.asarray(jax.vmap(li.groups.so3.Ad, (0, None))(jnp.asarray(q), jnp.array([0.0, 0.0, 1.0])))


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
