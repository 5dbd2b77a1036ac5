"""Didymos and Dimorphos after DART: period, libration and change of speed after the impact.

On 2022-09-26 the spacecraft DART struck Dimorphos, the moon of the asteroid Didymos. Since then its orbit is eccentric
by a few percent, its period is 33 minutes shorter, and the moon librates. The report gives the change of speed that
explains this period. Units: m, kg, s; gravity is of second order in size over distance. At the start the moon lies on
the x axis and moves along y; the barycenter is at rest.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "Didymos and Dimorphos after DART"
THOMAS, CHENG = "Thomas et al. 2023, Nature 616:448", "Cheng et al. 2023, Nature 616:457"
NAIDU = "Naidu et al. 2024, Planet. Sci. J. 5:74"
# [state] is the example state of the public two-body code of Davis & Scheeres; Didymos comes first, then Dimorphos.
G = 6.67408e-11  # m³/(kg s²) [state]
MASSES = (522941787070.36884, 4842963890.0586843)  # kg [state]
# This primary is rounder than the oblate one in [NAIDU]: (C − (A + B)/2)/m is 2210 m² here and 14 200 m² there. So the
# line of apsides regresses. With a round moon it advances by 1.9° a day: the shape of the moon causes the regression.
MOMENTS = (
    (31348424975008636.0, 31920248302583308.0, 32790416201495100.0),
    (10438985934293.97, 14689757387650.04, 16572197488200.17),
)  # kg m² [state]
RATES = (7.7226958052846407e-4, 1.4880755e-4)  # rad/s about z [state]: 2.26 h; the moon as before, when synchronous
DISTANCE = 1180.0  # m [state]
# The speed in [state] is 0.17277588 m/s; with it the orbital period of these bodies, from the mean rate of the
# longitude, is 11.814 h. This speed gives the period before the impact, and with SPEED_CHANGE the one after it.
SPEED, SPEED_CHANGE = 0.17329064, -2.7268  # m/s across the line of centers; mm/s
# Assumptions, 1σ of each component. That of the velocity is the error of the published change of speed. Those of
# Dimorphos stand for the uncertainty of its shape and attitude, and for the effect of the impact on its spin.
SPREAD = {"velocity": 1e-4, "attitude": np.deg2rad(1.0), "rate": 1.5e-6, "axes": 0.03}  # m/s, rad, rad/s (1 %), 3 %
BEFORE = li.report.Published(11.9216, None, f"value before the impact, see {THOMAS}")
AFTER = li.report.Published(11.372, 0.0057, THOMAS)  # ± 0.017 at 3 sigma
ROUND = "The primary of this state is rounder than the published one: with the oblate one of 394 and 290 m the line of "
ROUND += "apsides advances by 6.2 °/d. A member's rate depends on the amplitude of its secondary's libration."
APSIDES = li.report.Published(6.7, 0.2, NAIDU, ROUND)
HOUR, DAY = 3600.0, 86400.0
PARTS = ("orbit of two points", "primary's spin", "secondary's spin", "shapes, V + G m₁m₂/r")


def main(
    members: int = 1000,
    steps: int = 960,
    dt: float = 1800.0,
    speed_change: float = SPEED_CHANGE,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 65803,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate both bodies, and find the change of speed between the two published periods.

    Args:
        members: the number of pairs; each has its own moon, the first the nominal one.
        steps: the number of steps, even; 960 of 1800 s are 20 days, 42 orbits.
        dt: the step size in s; half of 1800 s changes Dimorphos' position by 1.3 mm in 20 days.
        speed_change: of Dimorphos by the impact, in mm/s; negative is slower.
        out: the store of the run; by default didymos.zarr, or didymos-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the distance and the libration, the errors, and the motion of the first member.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("didymos.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    noise = jax.random.normal(jax.random.key(seed), (members, 4, 3)).at[0].set(0.0)
    step, states = jax.jit(jax.vmap(pair, (0, None)))(noise, speed_change / 1000)
    run = li.run(step, states, dt, steps, save_every=2, own_step=True, store=store, resume=resume)
    motion, parts = li.measure.relative_motion(run), li.measure.pair_energies(run)
    _, *momenta = li.report.changes(run)
    changed = [
        li.report.Change("energy, over |energy of the orbit|", parts.total, abs(parts.orbit[0])),
        li.report.Change("energy, over |energy|", parts.total, abs(parts.total[0])),
        *momenta,
    ]
    faces, upright = li.measure.is_librating(motion.libration), np.rad2deg(motion.obliquity).max(axis=0) < 30
    shares = ", ".join(f"{np.ptp(E[:, 0]) / abs(parts.orbit[0, 0]):.3g}" for E in parts[:4])
    remarks = [
        f"  exchanged energies, greatest − least, of the nominal member over |orbit's energy|: {shares}",
        f"  periods and rates: mean rates of longitudes about L over {motion.t[-1] / DAY:.4g} d, by least squares",
        f"  {faces.sum()} of {members} members: one end of the secondary's x axis stays toward the primary",
        f"  {upright.sum()} of {members} members: its z axis stays within 30° of the orbit's normal",
        *impact(speed_change / 1000, dt, steps),
    ]
    spread = "relative velocity 0.1 mm/s; of the secondary: attitude 1°, angular velocity 1.5e-06 rad/s, semi-axes 3 %"
    about = {"changed": changed, "remarks": remarks, "spread": spread}
    print(li.report.text(TITLE, run, measured(motion, parts), **about))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw(motion), out.with_name(f"{out.stem}-orbit.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


def pair(noise, speed_change):
    """The step of a member, whose moon has its own moments, and its initial state, for normal deviates (4, 3)."""
    so3, m, J = li.groups.so3, jnp.array(MASSES), jnp.array(MOMENTS)
    second = (jnp.sum(J[1]) / 2 - J[1]) * (1 + SPREAD["axes"] * noise[1]) ** 2  # moments of mass along the axes
    J = J.at[1].set(jnp.sum(second) - second)
    bodies = li.systems.rigid_bodies(m, J, li.potentials.maccullagh(G, m, J))
    v = jnp.array([0.0, SPEED, 0.0]).at[1].add(speed_change) + SPREAD["velocity"] * noise[0]
    shares = jnp.stack([-m[1], m[0]])[:, None] / (m[0] + m[1])
    attitudes = jnp.stack([so3.identity, so3.exp(SPREAD["attitude"] * noise[2])])
    rates = jnp.zeros((2, 3)).at[:, 2].set(jnp.array(RATES)).at[1].add(SPREAD["rate"] * noise[3])
    d = jnp.array([DISTANCE, 0.0, 0.0])
    state = bodies.state(shares * d, attitudes, velocities=shares * v, angular_velocities=rates)
    return li.schemes.kepler_splitting(bodies, (8, 6, 4)), state


def measured(motion, parts):
    """Periods, precessions and librations of the members, with published values."""
    mean_rate, Row, orbit = li.measure.mean_rate, li.report.Row, li.measure.apsides(motion)
    lines, degrees = li.measure.librations(motion), np.rad2deg(DAY)  # a day, of rad/s
    spins = [2 * np.pi / mean_rate(motion.t, x) / HOUR for x in (motion.spin_1, motion.spin_2)]
    is_inclined = motion.inclination.max(axis=0) > 1e-9  # less is round-off
    normal = np.where(is_inclined, degrees * mean_rate(motion.t, motion.node), np.nan)
    largest = [abs(x).max(axis=0) for x in (motion.libration, motion.out_of_plane, motion.obliquity)]
    return [
        Row("orbital period (h)", orbit.period / HOUR, AFTER),
        Row("primary's spin period (h)", spins[0], BEFORE._replace(value=2.26)),
        Row("secondary's spin period (h)", spins[1]),
        Row("eccentricity of the mean ellipse", orbit.eccentricity),
        Row("precession of the line of apsides (°/d)", degrees * orbit.precession_rate, APSIDES),
        Row("precession of the orbit's normal about L (°/d)", normal),
        Row("libration of the secondary, largest (°)", np.rad2deg(largest[0])),
        Row("  its line at the orbit's anomalistic frequency (°)", np.rad2deg(lines.forced)),
        Row("  its strongest line below that (°)", np.rad2deg(lines.free)),
        Row("  the frequency of that line, over the orbit's", orbit.period / lines.free_period),
        Row("line of centers from its equator, largest (°)", np.rad2deg(largest[1])),
        Row("its obliquity, largest (°)", np.rad2deg(largest[2])),
        *(
            Row(f"exchanged energy, {x} (J)", np.ptp(E, axis=0), digits=".3g")
            for x, E in zip(PARTS, parts, strict=False)
        ),
    ]


def impact(given, dt, steps):
    """The lines on the change of speed that changes the published period before the impact into the one after it."""

    def period(change):
        step, state = pair(jnp.zeros((4, 3)), change)
        q = (run := li.integrate(step, state, dt, steps, save_every=2)).state.q
        d = q[:, 1] - q[:, 0]
        return 2 * jnp.pi / li.measure.mean_rate(run.t, jnp.unwrap(jnp.arctan2(d[:, 1], d[:, 0])))

    # the derivative is that of the whole model, by a tangent vector along the run, not of Kepler's formula
    measure = jax.jit(jax.vmap(lambda change: jax.jvp(period, (change,), (jnp.ones_like(change),))))
    T, changes, correction = HOUR * np.array([BEFORE.value, AFTER.value]), np.full(2, given), np.inf
    for _ in range(5):  # Newton's method
        found, slope = measure(changes)
        correction = (T - found) / slope
        changes = changes + correction
    changes = np.where(abs(correction) < 1e-9, changes, np.nan)
    [unchanged, _], [_, slope] = measure(np.array([0.0, changes.mean()]))
    mu, T = G * sum(MASSES), np.append(T, T.mean())  # from here on, of two points, which begin at an apsis
    a = np.cbrt(mu * (T / (2 * np.pi)) ** 2)
    v = np.sqrt(mu * (2 / DISTANCE - 1 / a))
    rows = {
        "period without the change of speed of this run": f"{unchanged / HOUR:>11.4f} h",
        "change of speed between the two published periods": f"{1000 * np.diff(changes)[0]:>11.3f} mm/s",
        "  for two points": f"{1000 * (v[1] - v[0]):>11.3f} mm/s",
        "derivative of the period by the speed, half-way": f"{slope / HOUR / 1000:>11.4f} h/(mm/s)",
        "  for two points, ΔT/T = 3 a v Δv/GM": f"{3 * (a * v * T)[2] / mu / HOUR / 1000:>11.4f} h/(mm/s)",
    }
    head = f"\n  published: orbital period {BEFORE.value:g} h before the impact, {AFTER.value:g} h after ({THOMAS})"
    speed = f"  published: change of speed -2.70 ± 0.10 mm/s ({CHENG})"
    return [head, *(f"  {name:<54}{value}" for name, value in rows.items()), speed]


@li.plots.style()
def draw(motion):
    """Plot the distance and the libration of the moon."""
    fig, [axes] = li.plots.figure(2)
    libration = np.rad2deg(motion.libration)
    for ax, x, label in zip(axes, (motion.distance, libration), ("distance (m)", "libration (°)"), strict=True):
        li.plots.member_series(ax, motion.t / DAY, x, label, "d")
        ax.margins(y=0.25)  # room for the legend
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
