"""The triple asteroid 2001 SN263: periods and precession of two moons that disturb each other.

Alpha, (153591), has an inner moon Gamma and an outer moon Beta. Gravity is that of second order in size over distance:
the flattening of Alpha rotates Gamma's line of apsides. Masses, periods, eccentricities, the angle between the two
orbits, sizes and spins are published, and rounded here. Units are m, kg and s, in the report also hours and days.
"""

import itertools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "The triple asteroid 2001 SN263"
FANG, BECKER = "Fang et al. 2011, Astron. J. 141:154", "Becker et al. 2015, Icarus 248:499"
G, HOUR, DAY = 6.67430e-11, 3600.0, 86400.0
NAMES = ("Alpha", "Gamma", "Beta")
# Gamma has about 1 % of Alpha's mass [FANG]; 0.43 km at 2.3 ± 1.3 g/cm³ give 9.6e10 kg [BECKER]. Beta: 0.77 km at
# 1.0 ± 0.4 g/cm³ [BECKER].
MASSES = np.array([9.175e12, 9.8e10, 2.40e11])  # kg, of Alpha [FANG]
SPREAD = 0.0024  # 1σ of Alpha's mass, relative [FANG]
# Alpha is a homogeneous spheroid of the published size, 2.5 km in diameter [BECKER]. Its axis ratio c/a was chosen so
# that Gamma's line of apsides precesses at the published rate: J₂ = 0.0112 for its radius of 1250 m. Its moons are
# assumed to be spheres of 0.43 and 0.77 km in diameter [BECKER].
SEMI_AXES = np.array([[1261.803, 1261.803, 1226.725], [215.0] * 3, [385.0] * 3])  # m
SPIN_PERIODS = np.array([3.4256, 16.464, 13.43])  # h, of Gamma synchronous, of Beta not [BECKER]
# At pericenter, of Gamma about Alpha (0.686 d, e = 0.016) and of Beta about the barycenter of these two (6.225 d,
# e = 0.015), 14° from Gamma's orbit [FANG]. The semi-major axes, 3805 and 16694 m, follow from periods and masses by
# Kepler's law. Assumptions: Gamma's orbit lies in Alpha's equatorial plane, and both moons are at pericenter at the
# same time, on opposite sides.
POSITIONS = np.array([[0.0, 0.0, 0.0], [3743.769, 0.0, 0.0], [-16403.879, 0.0, 0.0]])  # m
VELOCITIES = np.array([[0.0, 0.0, 0.0], [0.0, 0.4098315, 0.0], [0.0, -0.1877577, -0.0478932]])  # m/s
ORBITAL_PERIODS = {1: li.report.Published(16.46, source=FANG), 2: li.report.Published(149.4, source=FANG)}  # h
PRECESSIONS = {1: li.report.Published(1.1, source=FANG)}  # °/d
ROTATIONS = {0: li.report.Published(3.4256, 0.0002, BECKER), 2: li.report.Published(13.43, 0.01, BECKER)}  # h


def main(
    members: int = 50,
    steps: int = 5400,
    order: Literal[4, 6] = 6,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 153591,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the three bodies, and measure distances, mean orbits and rotations.

    Args:
        members: the number of systems of different masses of Alpha; the first has the published one.
        steps: the number of steps of 20 minutes, even; 5400 are 75 days, 109 orbits of Gamma and 12 of Beta.
        order: of the scheme.
        out: the store of the run; by default sn263.zarr, or sn263-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the masses of the members.
        pictures: draw the paths and distances of the nominal member, the errors, and the motion.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("sn263.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")

    def triple(noise):
        masses = jnp.asarray(MASSES) * (1 + SPREAD * noise * jnp.array([1.0, 0.0, 0.0]))
        squares = SEMI_AXES**2 / 5
        inertias = masses[:, None] * (squares.sum(axis=1, keepdims=True) - squares)
        bodies = li.systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(G, masses, inertias))
        x, v = (y - masses @ y / jnp.sum(masses) for y in (POSITIONS, VELOCITIES))  # the barycenter is at rest
        attitudes = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (3, 1))
        spins = 2 * np.pi / (SPIN_PERIODS[:, None] * HOUR) * np.array([0.0, 0.0, 1.0])
        state = bodies.state(x, attitudes, velocities=v, angular_velocities=jnp.asarray(spins))
        return li.schemes.nystrom(bodies, order), state

    noise = jax.random.normal(jax.random.key(seed), (members,)).at[0].set(0.0)
    made, states = jax.jit(jax.vmap(triple))(noise)
    run = li.run(made, states, 1200.0, steps, save_every=2, own_step=True, store=store, resume=resume)
    rows, distances = [], li.measure.distances(run)
    for (i, j), x in zip(itertools.combinations(NAMES, 2), np.moveaxis(distances, -1, 0), strict=True):
        rows += [row(f"{i}–{j}: least distance (m)", x.min(axis=0)), row("  greatest (m)", x.max(axis=0))]
    for k in (1, 2):
        orbit = li.measure.apsides(li.measure.relative_motion(run, 0, k))
        rotation = np.rad2deg(orbit.precession_rate) * DAY
        rows += [
            row(f"{NAMES[k]} about Alpha: period (h)", orbit.period / HOUR, ORBITAL_PERIODS[k]),
            row("  eccentricity of the mean ellipse", orbit.eccentricity),
            row("  precession of the line of apsides (°/d)", rotation, PRECESSIONS.get(k, ())),
        ]
    periods = 2 * np.pi / li.measure.rotation_rates(run).mean(axis=0).T / HOUR
    for k, name in enumerate(NAMES):
        rows.append(row(f"{name}: rotation period, mean rate (h)", periods[k], ROTATIONS.get(k, ())))
    remarks = [f"  periods: mean rates of longitudes about L over {run.t[-1] / DAY:.4g} d, by least squares"]
    about = {"changed": li.report.changes(run), "remarks": remarks, "spread": "Alpha's mass 0.24 %"}
    print(li.report.text(TITLE, run, rows, **about))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw(run, distances), out.with_name(f"{out.stem}-paths.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


def row(name, values, published=()):
    """A row with six digits."""
    return li.report.Row(name, values, published, digits=".6g")


@li.plots.style()
def draw(run, distances):
    """Plot the paths about the barycenter and the distances of the moons from Alpha, of the nominal member."""
    fig, [[left, right]] = li.plots.figure(2)
    li.plots.paths(left, dict(zip(NAMES, np.moveaxis(np.asarray(run.state.q)[:, 0, :, :3], 1, 0), strict=True)))
    left.set(xlabel="x (m)", ylabel="y (m)", title="about the barycenter")
    moons = {name: distances[:, 0, k] for k, name in enumerate(NAMES[1:])}
    li.plots.series(right, run.t / DAY, moons, "distance from Alpha (m)", "d")
    for curve, look in zip(right.lines, li.plots.STYLES[1:], strict=False):  # the style of each body's path
        curve.set(**look)
    left.legend(loc="upper left", bbox_to_anchor=(1, 1))
    right.legend()
    fig.suptitle(f"{TITLE}, nominal member")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
