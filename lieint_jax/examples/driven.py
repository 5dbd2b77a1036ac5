"""A gravity-gradient satellite in an eccentric orbit: its swings about the vertical.

The gravity gradient pulls the long boom of the satellite, its axis of least inertia, toward the vertical. The boom
swings about it; members with too much spin tumble. The scheme conserves the energy less the work of the orbit. Units:
km and s for the orbit, kg m² for the inertia (another unit of inertia gives the same motion).
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A gravity-gradient satellite in an eccentric orbit"
INERTIA = (1.0, 10.0, 10.5)  # about the center of mass: least along the boom, x; an assumption
MU = 398600.4418  # km³/s², of the Earth [IERS Conventions 2010, Technical Note 36, table 1.1]
SEMI_MAJOR_AXIS = 7578.0  # km: 442 km above the Earth at periapsis
ANGLES = {"inclination": np.deg2rad(51.6), "node": np.deg2rad(40.0), "periapsis": np.deg2rad(90.0)}
ATTITUDE = np.deg2rad([90.0, 3.0, -90.0])  # Euler angles 3-1-3 from the axes of the orbit: 3° out of its plane
# An assumption: the errors of the release, 1σ of each component. The mean motion of the orbit is 0.055°/s.
SPREAD = np.deg2rad([10.0, 0.02])  # attitude (rad), angular velocity (rad/s)


def main(
    members: int = 200,
    steps: int = 8000,
    steps_per_orbit: int = 400,
    eccentricity: float = 0.1,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1966,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the satellite, and measure how far its axes are from those of the orbit.

    Args:
        members: the number of initial states; the first is at rest relative to the orbit's axes.
        steps: the number of steps, a multiple of 20.
        steps_per_orbit: the period of the orbit, 6565 s, over the step size.
        eccentricity: of the orbit, below 1.
        out: the store of the run; by default driven.zarr, or driven-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the boom in the axes of the orbit, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out, so3 = out or li.report.new_path("driven.zarr", resume), li.groups.so3
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    orbit = li.orbits.kepler(MU, SEMI_MAJOR_AXIS, eccentricity, **ANGLES)
    satellite = li.systems.gravity_gradient(INERTIA, orbit)
    step = li.schemes.top_energy_momentum(satellite, li.maps.kappa_cayley)
    dt = 2 * np.pi / float(orbit.mean_motion) / steps_per_orbit
    noise = jax.random.normal(jax.random.key(seed), (members, 2, 3)).at[0].set(0.0)

    def state(noise):
        axes, rate = li.measure.orbit_axes(orbit, jnp.asarray(0.0))  # outward, along the motion, normal; in space
        turn, change = SPREAD[:, None] * noise
        q = so3.multiply(so3.from_matrix(axes), li.attitude.from_euler("ZXZ", ATTITUDE))
        Omega = so3.Ad_star(q, rate) + change
        return satellite.state(so3.multiply(so3.exp(turn), q), angular_velocity=Omega, t=0.0, work=0.0)

    run = li.run(step, jax.jit(jax.vmap(state))(noise), dt, steps, save_every=20, store=store, resume=resume)
    angles = li.measure.orbit_angles(run)
    least, greatest = (np.rad2deg(np.minimum(x, np.pi - x)) for x in (angles.vertical, angles.normal))
    rows = [
        li.report.Row(f"{name}, {word} (°)", values, digits=".3f")
        for name, x in {
            "least inertia's axis from the vertical": least,
            "greatest inertia's axis from the orbit's normal": greatest,
        }.items()
        for word, values in {"mean": x.mean(axis=0), "largest": x.max(axis=0)}.items()
    ]
    H = np.asarray(run.map(lambda step, z: step.system.energy(z)))
    [less_work, *_] = li.report.changes(run)
    changed = [li.report.Change("energy, on which the orbit works", H, abs(H).max(axis=0)), less_work]
    librating = li.measure.is_librating(angles.vertical).sum()
    print(
        li.report.text(
            TITLE,
            run,
            rows,
            changed=changed,
            remarks=[f"  {librating} of {members} members librate: their boom never crosses the horizon"],
            spread="attitude 10°, angular velocity 0.02°/s",
        )
    )
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_pointing(run, orbit), out.with_name(f"{out.stem}-pointing.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


def boom(orbit, t, q):
    """The directions of the boom in the axes of the orbit, (times, 3): outward, along the motion, normal."""

    def direction(t, q):
        return li.measure.orbit_axes(orbit, t)[0].T @ li.groups.so3.to_matrix(q)[:, 0]

    return np.asarray(jax.jit(jax.vmap(direction))(jnp.asarray(t), jnp.asarray(q)))


@li.plots.style()
def draw_pointing(run, orbit):
    """Plot the boom in the axes of the orbit, as a path on the sphere, and its angle from the vertical."""
    fig, [axes] = li.plots.figure(2)
    axes[0].remove()
    left, period = fig.add_subplot(1, 2, 1, projection="3d"), 2 * np.pi / float(orbit.mean_motion)
    t = np.linspace(0.0, run.t[-1], 4000)
    path, end = boom(orbit, t, run.member(0).at(t).q), np.full(len(run.failed), run.t[-1])
    ends, eye = boom(orbit, end, run.state.q[-1]), np.array([1.0, 0.6, 0.4])
    look: dict[str, Any] = {"pole_label": "vertical", "angle_label": "angle from the vertical (°)", "eye": eye}
    li.plots.on_sphere((left, axes[1]), t / period, path, end[0] / period, ends, np.eye(3)[0], unit="orbits", **look)
    left.set_title("the boom in the orbit's axes, nominal member")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
