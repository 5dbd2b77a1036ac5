"""A spherical pendulum: its swing, compared with the closed form.

A bob on a rod of one meter is pushed sideways. Its path is a rosette, which precesses about the vertical. The scheme
conserves energy and the momentum about the vertical. SI units; a rod of length l has the mass m l² and the gravity g/l.
"""

from pathlib import Path

import jax
import numpy as np

import lieint_jax as li

TITLE = "A spherical pendulum"
MASS = 1.0  # kg
GRAVITY = 9.80665  # m/s², standard gravity [3rd General Conference on Weights and Measures 1901]
DOWN = np.array([0.0, 0.0, -1.0])
DIRECTION = np.array([0.8, 0.0, -0.6])  # from the pivot to the bob
VELOCITY = np.array([0.0, 0.6, 0.0])  # m/s
SPREAD = (np.deg2rad(1.0), 0.02)  # 1σ of the direction (rad) and of the velocity (m/s), an assumption


def main(
    members: int = 200,
    steps: int = 10_000,
    dt: float = 0.01,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1994,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the pendulum and compare its swing with the closed form.

    Args:
        members: the number of initial states; the first is the nominal one.
        steps: the number of steps, a multiple of 5.
        dt: the step size in s; at 0.01 the closed form is met to 12 digits.
        out: the store of the run; by default pendulum.zarr, or pendulum-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the path of the bob, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("pendulum.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    bob = li.systems.pendulum(MASS, GRAVITY, DOWN)
    step = li.schemes.compose(li.schemes.sphere_midpoint(bob), 6)

    def state(noise):
        q = li.groups.so3.Ad(li.groups.so3.exp(SPREAD[0] * noise[0]), DIRECTION)
        v = VELOCITY + SPREAD[1] * noise[1]
        return bob.state(q, velocity=v - q * (q @ v) / (q @ q))  # a velocity is tangent to the sphere

    noise = jax.random.normal(jax.random.key(seed), (members, 2, 3)).at[0].set(0.0)
    run = li.run(step, jax.jit(jax.vmap(state))(noise), dt, steps, save_every=5, store=store, resume=resume)
    start = jax.tree.map(lambda x: x[0], run.member(0).state)
    # The pendulum is the axis of a top without spin; the inclination of the top is measured from the upward direction.
    closed, found = li.systems.lagrange_motion(*li.systems.pendulum_as_top(bob, start)), li.measure.nutation(run)
    bounds = 180 - np.rad2deg(closed.inclination)[::-1]
    rows = [
        li.report.Row("lowest point to lowest point (s)", found.period, closed_form=closed.nutation_period),
        li.report.Row("mean rate about γ (rad/s)", found.precession_rate, closed_form=-closed.precession_rate),
        li.report.Row("least angle from γ (°)", np.rad2deg(found.least), closed_form=bounds[0]),
        li.report.Row("greatest angle from γ (°)", np.rad2deg(found.greatest), closed_form=bounds[1]),
    ]
    changed = [*li.report.changes(run), li.report.Change("constraints |q| = 1, q·π = 0", run.constraint_error())]
    print(
        li.report.text(
            TITLE,
            run,
            rows,
            changed=changed,
            remarks=["  closed form: elliptic integrals; γ is the direction of gravity"],
            spread="direction 1°, velocity 0.02 m/s",
        )
    )
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(
            draw_path(run, bounds, 12 * closed.nutation_period), out.with_name(f"{out.stem}-path.png")
        )
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


@li.plots.style()
def draw_path(run, bounds, end):
    """Plot a dozen swings of the bob on the sphere, seen from below, and its angle from the vertical."""
    fig, [axes] = li.plots.figure(2)
    axes[0].remove()
    left = fig.add_subplot(1, 2, 1, projection="3d")
    t = np.linspace(0.0, min(end, run.t[-1]), 4000)
    path, ends = np.asarray(run.member(0).at(t).q), np.asarray(run.state.q[-1])
    look = {"unit": "s", "pole_label": "γ, down", "bounds": bounds}
    li.plots.on_sphere((left, axes[1]), t, path, float(run.t[-1]), ends, DOWN, **look)
    axes[1].set_title("dashed: its bounds in closed form")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
