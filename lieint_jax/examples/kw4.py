"""The binary asteroid 1999 KW4: the moon's libration, and the precession of the poles.

Moshup (66391) spins so fast that its equator is close to weightlessness, and its moon Squannit is close to it. Gravity
is that of second order in size over distance, which couples the orbit with both rotations. Sizes, densities, distance
and periods are published, but not attitudes: here both poles are tilted, and the moon is rotated about its own, so that
it swings. Units are m, kg and s, in the report also hours and days.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "The binary asteroid 1999 KW4"
OSTRO, FAHNESTOCK = "Ostro et al. 2006, Science 314:1276", "Fahnestock & Scheeres 2008, Icarus 194:410"
G, HOUR, DAY = 6.67430e-11, 3600.0, 86400.0
SEMI_AXES = np.array(  # m, of the primary and of its moon [OSTRO, FAHNESTOCK]
    [[658.5, 658.5 / 1.02, 658.5 / 1.11], [295.0, 295.0 / 1.23, 295.0 / 1.33]]
)
DENSITIES = np.array([1970.0, 1300.0])  # kg/m³ [OSTRO, FAHNESTOCK]
SPIN = 2 * np.pi / (2.765 * HOUR)  # rad/s, of the primary [OSTRO]
SEPARATION = 2548.0  # m [OSTRO]
# By Kepler's law this distance and the period of 17.42 h require a mass of 2.49e12 kg. These bodies have 2.17e12 kg, so
# that their period is about 18.6 h.
PERIOD = li.report.Published(17.42, source=OSTRO)  # h
SPIN_PERIOD = li.report.Published(2.765, source=OSTRO)  # h
SPREAD = 0.12  # 1σ of each mass, relative: an assumption, the errors of the densities
PARTS = ("orbit of two points", "primary's spin", "secondary's spin", "shapes, V + G m₁m₂/r")
DT, UPRIGHT = 1800.0, 30.0  # s; °, a moon of larger obliquity counts as tumbling


def main(
    members: int = 200,
    steps: int = 2880,
    tilt: float = 10.0,
    swing: float = 20.0,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 66391,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the two bodies, and measure the orbit, the precessions, the libration and the exchange of energy.

    Args:
        members: the number of binaries of different masses; the first has the published densities.
        steps: the number of steps of half an hour, a multiple of 4; 2880 are 60 days or 77 orbits.
        tilt: the angle in ° of both poles from the normal of the orbit at the start, an assumption.
        swing: the angle in ° by which the moon is rotated about its pole at the start, an assumption.
        out: the store of the run; by default kw4.zarr, or kw4-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the masses of the members.
        pictures: draw distance and libration, the errors, and the motion of the first member.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("kw4.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    attitudes = li.attitude.from_euler("ZXZ", np.deg2rad([[0.0, tilt, 0.0], [0.0, tilt, swing]]))

    def binary(noise):
        masses = jnp.asarray(DENSITIES * 4 / 3 * np.pi * SEMI_AXES.prod(axis=1)) * (1 + SPREAD * noise)
        squares = SEMI_AXES**2 / 5
        inertias = masses[:, None] * (squares.sum(axis=1, keepdims=True) - squares)
        bodies = li.systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(G, masses, inertias))
        d, total = jnp.array([SEPARATION, 0.0, 0.0]), jnp.sum(masses)
        places = jnp.concatenate([jnp.stack([0 * d, d]), attitudes], axis=1)
        pull = -bodies.force(places)[1, 0] * total / (masses[0] * masses[1])
        speed = jnp.sqrt(pull * SEPARATION)  # of a circle
        shares = jnp.stack([-masses[1], masses[0]])[:, None] / total
        # The moon rotates once in an orbit, about its normal.
        rate = li.groups.so3.Ad_star(attitudes[1], speed / SEPARATION * jnp.array([0.0, 0.0, 1.0]))
        state = bodies.state(
            shares * d,
            attitudes,
            velocities=shares * speed * jnp.array([0.0, 1.0, 0.0]),
            angular_velocities=jnp.stack([jnp.array([0.0, 0.0, SPIN]), rate]),
        )
        return li.schemes.kepler_splitting(bodies, (8, 6, 4)), state

    noise = jax.random.normal(jax.random.key(seed), (members, 2)).at[0].set(0.0)
    made, states = jax.jit(jax.vmap(binary))(noise)
    run = li.run(made, states, DT, steps, save_every=4, own_step=True, store=store, resume=resume)
    motion, parts = li.measure.relative_motion(run), li.measure.pair_energies(run)
    orbit, lines = li.measure.apsides(motion), li.measure.librations(motion)
    spins = [2 * np.pi / li.measure.mean_rate(motion.t, angle) / HOUR for angle in (motion.spin_1, motion.spin_2)]
    inclined = motion.inclination.max(axis=0) > 1e-9  # less is round-off
    node = np.where(inclined, li.measure.mean_rate(motion.t, motion.node), np.nan)
    libration = motion.libration - np.pi * np.round(motion.libration[0] / np.pi)  # about the multiple nearest the start
    row, obliquity = li.report.Row, np.rad2deg(motion.obliquity.max(axis=0))
    rows = [
        row("orbital period (h)", orbit.period / HOUR, PERIOD),
        row("primary's spin period (h)", spins[0], SPIN_PERIOD),
        row("secondary's spin period (h)", spins[1]),
        row("eccentricity of the mean ellipse", orbit.eccentricity),
        row("precession of the line of apsides (°/d)", np.rad2deg(orbit.precession_rate) * DAY),
        row("precession of the orbit's normal about L (°/d)", np.rad2deg(node) * DAY),
        row("libration of the secondary, largest (°)", np.rad2deg(abs(libration).max(axis=0))),
        row("  its line at the orbit's anomalistic frequency (°)", np.rad2deg(lines.forced)),
        row("  its strongest line below that (°)", np.rad2deg(lines.free)),
        row("  the frequency of that line, over the orbit's", orbit.period / lines.free_period),
        row("line of centers from its equator, largest (°)", np.rad2deg(abs(motion.out_of_plane).max(axis=0))),
        row("its obliquity, largest (°)", obliquity),
        *(
            row(f"exchanged energy, {x} (J)", np.ptp(E, axis=0), digits=".3g")
            for x, E in zip(PARTS, parts, strict=False)
        ),
    ]
    _, *momenta = li.report.changes(run)
    changed = [
        li.report.Change("energy, over |energy of the orbit|", parts.total, abs(parts.orbit[0])),
        li.report.Change("energy, over |energy|", parts.total, abs(parts.total[0])),
        *momenta,
    ]
    faces, upright = li.measure.is_librating(motion.libration).sum(), (obliquity < UPRIGHT).sum()
    shares = ", ".join(f"{np.ptp(x[:, 0]) / abs(parts.orbit[0, 0]):.3g}" for x in parts[:4])
    remarks = [
        f"  exchanged energies, greatest − least, of the nominal member over |orbit's energy|: {shares}",
        f"  periods and rates: mean rates of longitudes about L over {motion.t[-1] / DAY:.4g} d, by least squares",
        f"  {faces} of {members} members: one end of the secondary's x axis stays toward the primary",
        f"  {upright} of {members} members: its z axis stays within {UPRIGHT:g}° of the orbit's normal",
    ]
    print(li.report.text(TITLE, run, rows, changed=changed, remarks=remarks, spread="each mass 12 %"))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw(motion, np.rad2deg(libration)), out.with_name(f"{out.stem}-orbit.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


@li.plots.style()
def draw(motion, libration):
    """Plot the distance and the libration of the members in the first ten days."""
    fig, [axes] = li.plots.figure(2)
    panels, first = {"distance (m)": motion.distance, "libration of the moon (°)": libration}, motion.t < 10 * DAY
    for ax, (label, x) in zip(axes, panels.items(), strict=True):
        li.plots.member_series(ax, motion.t[first] / DAY, x[first], label, "d")
        ax.margins(y=0.25)  # room for the legend
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
