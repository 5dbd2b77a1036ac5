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
        pictures: draw distance, libration and its spectrum, the exchange of energy, and the errors of two schemes.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("kw4.zarr", resume)
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
    run = li.run(made, states, DT, steps, save_every=4, own_step=True, store=out, resume=resume)
    motion, parts = li.measure.relative_motion(run), li.measure.pair_energies(run)
    print(
        li.report.text(
            TITLE,
            run,
            rows(motion),
            changed=changes(run, parts),
            remarks=remarks(motion, parts),
            spread="each mass 12 %",
            time_unit="s",
        )
    )
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        one = run.member(0)
        start = jax.tree.map(lambda x: jnp.asarray(x[0]), one.state)
        drawn = li.plots.save(draw_orbit(motion, one, start), out.with_name(f"{out.stem}-orbit.png"))
        print("pictures:", *drawn, *li.plots.save(draw_energy(one, start), out.with_name(f"{out.stem}-energy.png")))


def rows(motion):
    """Periods, precessions and librations, next to published values."""
    orbit, lines = li.measure.apsides(motion), li.measure.librations(motion)
    spins = [2 * np.pi / li.measure.mean_rate(motion.t, angle) / HOUR for angle in (motion.spin_1, motion.spin_2)]
    inclined = motion.inclination.max(axis=0) > 1e-9  # less is round-off
    node = np.where(inclined, li.measure.mean_rate(motion.t, motion.node), np.nan)
    swing, row = np.rad2deg(abs(swings(motion)).max(axis=0)), li.report.Row
    return [
        row("orbital period (h)", orbit.period / HOUR, PERIOD),
        row("primary's spin period (h)", spins[0], SPIN_PERIOD),
        row("secondary's spin period (h)", spins[1]),
        row("eccentricity of the mean ellipse", orbit.eccentricity),
        row("precession of the line of apsides (°/d)", np.rad2deg(orbit.precession_rate) * DAY),
        row("precession of the orbit's normal about L (°/d)", np.rad2deg(node) * DAY),
        row("libration of the secondary, largest (°)", swing),
        row("  its line at the orbit's anomalistic frequency (°)", np.rad2deg(lines.forced)),
        row("  its strongest line below that (°)", np.rad2deg(lines.free)),
        row("  the frequency of that line, over the orbit's", orbit.period / lines.free_period),
        row("line of centers from its equator, largest (°)", np.rad2deg(abs(motion.out_of_plane).max(axis=0))),
        row("its obliquity, largest (°)", np.rad2deg(motion.obliquity.max(axis=0))),
    ]


def swings(motion):
    """The libration about the multiple of π nearest to its start, (times, members)."""
    return motion.libration - np.pi * np.round(motion.libration[0] / np.pi)


def changes(run, parts):
    """Energy and momenta, relative to sizes that a reader can judge."""
    momentum = np.asarray(run.map(lambda step, z: step.system.momentum(z)))
    P, L = momentum[..., :3], momentum[..., 3:]
    change = li.report.Change
    return [
        change("energy, over |energy of the orbit|", parts.total, abs(parts.orbit[0])),
        change("energy, over |energy|", parts.total, abs(parts.total[0])),
        change("linear momentum, over that of the secondary", P, length(run.state.p[0, :, 1, :3])),
        change("angular momentum, relative", L, length(L[0])),
    ]


def length(x):
    """The lengths of vectors (…, 3), (…, 1)."""
    return np.linalg.norm(x, axis=-1, keepdims=True)


def remarks(motion, parts):
    """How periods are measured, which members stay upright, and how much energy is exchanged."""
    faces = li.measure.is_librating(motion.libration)
    upright, n = np.rad2deg(motion.obliquity).max(axis=0) < UPRIGHT, len(faces)
    names = {
        "orbit of two points": parts.orbit,
        "primary's spin": parts.spin_1,
        "secondary's spin": parts.spin_2,
        "potential of their shapes, V + G m₁m₂/r": parts.shape,
    }
    lines = [
        f"  periods and rates: mean rates of longitudes about L over {motion.t[-1] / DAY:.4g} d, by least squares",
        f"  {faces.sum()} of {n} members: one end of the secondary's x axis stays toward the primary",
        f"  {upright.sum()} of {n} members: its z axis stays within {UPRIGHT:g}° of the orbit's normal",
        f"\n  {'energy exchanged, greatest − least (J)':<52}{'nominal':>11}{'± ensemble':>12}   over |orbit's energy|",
    ]
    for name, energy in names.items():
        exchanged = np.ptp(energy, axis=0)
        spread = f"{exchanged.std(ddof=1):.2g}" if n > 1 else "—"
        lines.append(f"  {name:<52}{exchanged[0]:>11.3g}{spread:>12}   {exchanged[0] / abs(parts.orbit[0, 0]):.3g}")
    return lines


@li.plots.style()
def draw_orbit(motion, one, start):
    """Plot the distance and the libration of the members, and the spectrum of the nominal one's libration."""
    plots, days = li.plots, motion.t / DAY
    fig, [axes] = plots.figure(3)
    fig.suptitle(TITLE)
    panels = {"distance (m)": motion.distance, "libration of the moon (°)": np.rad2deg(swings(motion))}
    for ax, (label, x) in zip(axes, panels.items(), strict=False):
        if x.shape[1] > 1:
            low, high = np.percentile(x, [5, 95], axis=1)
            ax.fill_between(days, low, high, color=plots.GRAY, lw=0, label=f"90 % of {x.shape[1]} members")
        ax.plot(days, x[:, 0], color=plots.BLUE, lw=0.8, label="nominal member")
        ax.set(xlabel="t (d)", ylabel=label)
        ax.margins(x=0.01, y=0.15)
    axes[0].legend(loc="upper right", ncols=2)
    # A run that is 8 times as long resolves the lines of the spectrum.
    long = li.run(one.step, start, DT, 8 * one.facts.num_steps, save_every=4, progress=False)
    found = li.measure.relative_motion(long)
    f, amplitude = li.measure.spectrum(found.t, np.rad2deg(found.libration))
    orbit, (A, B, C) = li.measure.apsides(found), np.asarray(one.system.inertias[1])
    shown = (f > 0) & (f * orbit.period < 3)
    axes[2].semilogy(f[shown] * orbit.period, amplitude[shown], color=plots.INK, lw=0.7)
    free = np.sqrt(3 * (B - A) / C)  # of a small swing on a circle, over the orbit's
    marks = {"from apsis to apsis": orbit.period / orbit.anomalistic_period, "free libration, √(3(B−A)/C)": free}
    for (label, x), color in zip(marks.items(), (plots.RED, plots.GREEN), strict=True):
        axes[2].axvline(x, color=color, ls="--", lw=0.9, label=label)
    axes[2].set(xlim=(0, 3), xlabel="frequency over that of the orbit", ylabel="amplitude of the libration (°)")
    axes[2].set_title(f"nominal member, {found.t[-1] / DAY:.4g} d")
    axes[2].legend(loc="upper right")
    return fig


@li.plots.style()
def draw_energy(one, start):
    """Plot the exchange of energy in 75 hours, four orbits, and the errors of two schemes; of the nominal member."""
    fig, [[left, right]] = li.plots.figure(2)
    fig.suptitle(TITLE)
    brief = li.run(one.step, start, DT / 4, 600, progress=False)  # the primary rotates once in 22 steps
    parts = li.measure.pair_energies(brief)
    names = {"orbit": parts.orbit, "primary's spin": parts.spin_1, "secondary's spin": parts.spin_2}
    names["shapes, V + Gm₁m₂/r"] = parts.shape
    curves = {name: (x - x[0]) / abs(parts.orbit[0]) for name, x in names.items()}
    li.plots.series(left, brief.t / DAY, curves, "change over |energy of the orbit|", "d")
    left.set_title("exchange of energy")
    left.margins(y=0.25)
    left.legend(loc="upper center", ncols=2)
    errors = {}
    for step in (one.step, li.schemes.bodies_energy_momentum(one.system)):
        made = li.run(step, start, DT, one.facts.num_steps, save_every=4, progress=False)
        L = np.asarray(made.map(lambda step, z: step.system.momentum(z)[3:]))
        errors[f"H, {step.name}"] = made.energy_error() / abs(one.system.energy(start))
        errors[f"L, {step.name}"] = np.linalg.norm(L - L[0], axis=1) / np.linalg.norm(L[0])
    li.plots.log_error(right, made.t / DAY, errors, "relative change", "d")
    right.set_title("energy H and angular momentum L")
    right.set_ylim(top=1e3 * right.get_ylim()[1])  # room for the legend
    right.legend(loc="upper center", ncols=2)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
