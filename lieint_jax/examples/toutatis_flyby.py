"""4179 Toutatis, a flyby: how much the Earth's torque of 2004 changed its spin.

The asteroid passed the Earth at 4 lunar distances on 2004-09-29. Its phase and orientation then are unknown, so the
members have random ones: the report gives the order of magnitude of the changes of momentum and of the mean rates of
precession and rotation. In torque-free motion all of these are constant. Times are in days, distances in kilometers.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

so3 = li.groups.so3
TITLE = "4179 Toutatis: the Earth's torque in the flyby of 2004-09-29"
INERTIA = (3.110, 3.150, 1.0)  # principal moments over that of the long axis, z, as fitted by toutatis_fit
ANGLES, RATE = (150.129, 61.731, 240.322), (11.841, 35.054, -98.625)  # 3-1-3 (°), °/d, 1992-11-09 17:49:47, the same
LATER = 30.979317  # d from then to 1992-12-10 17:20, the first time from which the phases are drawn
BUSCH = "Busch et al. 2012, AGU Fall Meeting, P31A-1873"
AU, DAY = 149597870.7, 86400.0  # km, s
DISTANCE = 0.01036  # au, least distance [BUSCH]
ORBIT = (2.5321, 0.6288, np.deg2rad(0.446))  # au, eccentricity, inclination: JPL's Small-Body Database, not checked
EARTH_SPEED = 29.7847  # km/s, of a circular orbit of 1 au
TO_2008 = 1516.0  # d, from the flyby to the radar fix of 2008-11-23


def main(
    members: int = 1000,
    steps: int = 800,
    distance: float = DISTANCE,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 2004,
    pictures: bool = True,
) -> None:
    """Integrate flybys of random phases and orientations, and compare the spin before and after.

    Args:
        members: the number of flybys.
        steps: the number of steps over 24 days.
        distance: the least distance in au.
        out: the store of the run; by default toutatis_flyby.zarr, or toutatis_flyby-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the phases and orientations.
        pictures: draw the changes of the mean rates.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("toutatis_flyby.zarr", resume)
    body = li.systems.rigid_body(INERTIA)
    state = body.state(so3.from_euler_313(jnp.deg2rad(jnp.array(ANGLES))), angular_velocity=np.deg2rad(RATE))
    speed = EARTH_SPEED * float(li.orbits.encounter_speed(*ORBIT))  # km/s at infinity
    orbit = li.orbits.hyperbola(li.orbits.EARTH_GM * DAY**2, distance * AU, speed * DAY)
    step = li.schemes.splitting(li.systems.gravity_gradient(body.inertia, orbit))
    rng = np.random.default_rng(seed)
    phases, rotations = jnp.asarray(rng.uniform(0, 1000, members)), rng.normal(size=(members, 4))
    rotations = jnp.asarray(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))

    def begin(phase, rotation):
        later = body.solution(state, LATER + phase)
        attitude, momentum = so3.multiply(rotation, later.q), so3.Ad(rotation, later.p)
        return li.core.State(attitude, momentum, jnp.asarray(-12.0), jnp.zeros(()))  # time 0 is the least distance

    states = jax.jit(jax.vmap(begin))(phases, rotations)
    run = li.run(step, states, 24 / steps, steps, save_every=steps, store=out, resume=resume)
    periods = jax.jit(jax.vmap(lambda z: li.fitting.tumbling.mean_periods(body, z)))
    before, after = (jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), run.state) for k in (0, -1))
    change = np.asarray(360 / periods(after) - 360 / periods(before))  # of the mean rates (°/d), (members, 2)
    directions = [z.p / jnp.linalg.norm(z.p, axis=1, keepdims=True) for z in (before, after)]
    turn = np.rad2deg(2 * np.arcsin(np.linalg.norm(directions[1] - directions[0], axis=1) / 2))
    size = np.linalg.norm(after.p - before.p, axis=1) / np.linalg.norm(before.p, axis=1)
    rms, most = np.sqrt((change**2).mean(axis=0)), np.abs(change[:, 0]).max()
    print(f"{TITLE}, in order of magnitude")
    print(f"  {members} members of random phases and orientations, {steps} steps of {24 / steps:g} d, {step.name}")
    print(f"  a hyperbola of least distance {distance:.5f} au, {speed:.2f} km/s at infinity")
    print(f"  nominal member: {run.error(1).summary}")
    print("  (elements quoted from JPL's Small-Body Database, not checked there; the Earth on a circle)")
    print(f"  momentum: changes by {100 * np.sqrt((size**2).mean()):.2f} % rms, rotates by {turn.max():.2f}° at most")
    print(f"  precession rate: {rms[0]:.3f} °/d rms, {most:.2f} at most; rotation rate: {rms[1]:.4f} rms")
    print(f"  published: 0.08 °/d at most   ({BUSCH})")
    print(f"  By the fix of 2008 this change of rate adds up to {TO_2008 * rms[0]:.0f}° rms, {TO_2008 * most:.0f}° at")
    print("  most, even from a state known exactly.")
    if pictures:
        print("pictures:", *li.plots.save(draw(change, turn), out.with_name(f"{out.stem}-changes.png")))


@li.plots.style()
def draw(change, turn):
    """Plot the distributions of the changes of both mean rates, and of the rotation of the momentum."""
    fig, [axes] = li.plots.figure(3)
    labels = (
        "change of the precession rate (°/d)",
        "change of the rotation rate (°/d)",
        "rotation of the momentum (°)",
    )
    for ax, x, label in zip(axes, (*change.T, turn), labels, strict=True):
        ax.hist(x, 40, color=li.plots.BLUE)
        ax.set(xlabel=label, ylabel="members")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
