"""99942 Apophis passes the Earth, 2029-04-13: its spin after the flyby, phase by phase.

The asteroid tumbles, and the Earth's tide changes this tumbling. The change depends on two phases at the perigee, six
Earth radii from the center, which the published states do not give: the members cover all of them uniformly. Units: km
for the orbit, h since the perigee, moments of inertia over the greatest one; axes of space: ecliptic, J2000. Model: a
rigid body in the field of a point mass, to second order in size over distance, on a given hyperbola.
"""

from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE, Published = "99942 Apophis passes the Earth, 2029-04-13", li.report.Published
PRAVEC, LEE = "Pravec et al. 2014, Icarus 233:48", "Lee et al. 2022, A&A 661:L3"
DURECH, BENSON = "Ďurech et al. 2026, arXiv 2604.24566", "Benson et al. 2023, Icarus 390:115324, arXiv 2210.13365"
SOUCHAY = "Souchay et al. 2014, A&A 563:A24: 21:46 ± 1 min TDB"
GM = 398600.4418 * 3600.0**2  # km³/h², of the Earth [IERS Conventions 2010, Technical Note 36, table 1.1]
# The elements, those of an ephemeris service, are ecliptic: so the direction of approach agrees to 0.1° with that of
# heliocentric orbits of the Earth and of Apophis; read as equatorial, it differs by 16°. UTC is 69 s behind TDB here.
PERIGEE, ECCENTRICITY, DATE = 38011.48649129103, 4.253901873212790, datetime(2029, 4, 13, 21, 45, 4)  # km, UTC
ANGLES = (162.8561543134850, 152.0019490904037, 32.56762207107416)  # °: inclination, node, argument of the perigee
# Least and middle moment, precession period P_φ and rotation period P_ψ (h), longitude and latitude of the angular
# momentum (°), each with 3σ below and above. The errors of the pole are along the parallel and the meridian, an
# assumption: the abstract does not orient the ellipse. Periods and moments give the energy and the angular momentum.
SPIN = {
    "pravec": [
        (0.61, 0.08, 0.11),
        (0.965, 0.015, 0.009),
        (27.38, 0.07, 0.07),
        (263, 6, 6),
        (250, 27, 27),
        (-75, 14, 14),
    ],
    "lee": [(0.64, 0, 0), (0.97, 0, 0), (27.38547, 0, 0), (264.178, 0, 0), (275, 0, 0), (-85, 0, 0)],
}
SPIN["durech"] = [*SPIN["pravec"][:2], (27.374, 0.001, 0.001), (262.2, 0.1, 0.1), *SPIN["pravec"][4:]]
TOGETHER = "Periods of light curves are known more precisely than independent draws of P_φ and P_ψ reproduce them."
PUBLISHED = {
    "distance at the perigee (km)": (Published(38000, None, DURECH),),
    "speed at the perigee (km/s)": (),
    "speed far away (km/s)": (),
    "time of the perigee (h, UTC)": (Published(21.75, 0.02, SOUCHAY),),
    "precession period P_φ (h)": (Published(27.38, 0.07, PRAVEC), Published(27.374, 0.001, DURECH)),
    "rotation period P_ψ (h)": (Published(263.0, 6.0, PRAVEC), Published(262.2, 0.1, DURECH)),
    "1/(1/P_φ − 1/P_ψ), strongest in light curves (h)": (Published(30.56, 0.01, PRAVEC, TOGETHER),),
    "energy over the least at this |L|": (Published(1.024, 0.013, PRAVEC),),
}
NOTES = """
  Differences from published expectations: of 10 000 members the spin rate is halved in one (× 0.490) and doubled in
  none. Only the abstracts of the two papers were read. Benson et al. use refined moments and spin from optical and
  radar observations. All models of Ďurech et al. have about the same orientation in 2029, so their likelihood of the
  short-axis mode refers to some phases only; that of this run is an average over all phases.

  The model omits the Earth's oblateness, the tides of Sun and Moon, higher orders of Apophis' shape, and changes of
  its shape. Arcs of ± 192 h instead of ± 96 h change P_φ by less than 0.003 h, and the pole by less than 0.004°."""


def main(
    members: int = 10_000,
    steps: int = 640,
    hours: float = 96.0,
    spin: Literal["pravec", "lee", "durech"] = "pravec",
    phases: int = 36,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 99942,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the passage, and compare the spin after it with the spin before it and with what is expected.

    Args:
        members: the number of bodies, with random phases; the first is the nominal one, at phases 0.
        steps: the number of steps, a multiple of 40; they are shorter near the perigee.
        hours: the length of the run before and after the perigee, in h.
        spin: whose moments, periods and pole; lee without errors, durech with other periods than pravec.
        phases: the number of rotation phases of the map, over 180°; it has twice as many precession phases, over 360°.
        out: the store of the run; by default apophis.zarr, or apophis-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the map of both phases, and the members after the passage.
        certificate: measure what the scheme conserves along the first member, in even steps.
    """
    jax.config.update("jax_enable_x64", True)
    out, known = out or li.report.new_path("apophis.zarr"), np.array(SPIN[spin], float)
    orbit = li.orbits.kepler(GM, PERIGEE / (1 - ECCENTRICITY), ECCENTRICITY, *np.deg2rad(ANGLES))
    orbit = li.orbits.shared(orbit)
    spins, redrawn = jax.jit(jax.vmap(lambda k: draw(jax.random.key(seed), k, known)))(jnp.arange(members))
    start = jax.jit(jax.vmap(lambda spin: passage(orbit, -hours, *spin)))

    def integrate(step, states, count, **options):
        times = li.orbits.graded_times(orbit, -hours, hours, count)
        return li.run(step, states._replace(t=states.t[0]), times=times, own_step=True, **options)

    step, states = start(spins)
    run = integrate(step, states, steps, save_every=40, store=out, resume=resume)
    phi, psi = (x.ravel() * np.pi / phases for x in np.mgrid[: 2 * phases, :phases])
    nominal = [jnp.repeat(x[:1], phi.size, axis=0) for x in spins[:3]]
    mapped = integrate(*start((*nominal, phi, psi)), steps, save_every=steps, progress=False)
    few = jax.tree.map(lambda x: x[:256], (step, states))
    twice = integrate(*few, 2 * steps, save_every=2 * steps, progress=False)
    error = jax.vmap(li.groups.so3.angle)(*(jnp.asarray(x.state.q[-1, :256]) for x in (run, twice))).max()
    failed = sum((~np.asarray(x.converged)).sum() for x in (mapped, twice))
    found, on_map = change(run), change(mapped)
    dates = " to ".join(f"{DATE + timedelta(hours=x):%Y-%m-%d %H:%M}" for x in (-hours, hours))
    remarks = [
        f"\n  from {dates} UTC; perigee {DATE:%Y-%m-%d %H:%M:%S} UTC; published errors of the spin are 3 sigma",
        f"  {100 * redrawn.mean():.3g} % of the moments were drawn again: no short-axis mode has such periods",
        *after_lines(*found),
        *map_lines(*on_map, np.rad2deg(phi), np.rad2deg(psi)),
        f"\n  attitude at the end, {steps} steps and twice as many: {error:.1e} rad, largest of 256 members",
        f"  {failed} of the members of the map and of these had a step that did not converge\n{NOTES}\n",
    ]
    spread = "both phases uniform; moments, periods and pole by the published errors"
    print(li.report.text(TITLE, run, before_rows(orbit, found[0]), remarks=remarks, spread=spread, time_unit="h"))
    if certificate:
        one = jax.tree.map(lambda x: x[0], (step, states))
        print(f"\nEven steps, nominal member:\n{li.diagnostics.certify(*one, 2 * hours / steps, steps)}")
    if pictures:
        drawn = li.plots.save(draw_map(*on_map, 2 * phases), out.with_name(f"{out.stem}-map.png"))
        print("pictures:", *drawn, *li.plots.save(draw_after(*found), out.with_name(f"{out.stem}-after.png")))


def draw(key, k, known):
    """Moments, periods, pole and phases of the k-th member, the nominal one for k = 0; whether the first draw failed.

    Some moments within the errors have no short-axis mode with such periods: the first good one of 16 draws is used.
    """
    key = jax.random.fold_in(key, k)
    noise = jnp.where(k == 0, 0.0, jax.random.normal(key, (16, 6)))
    drawn = known[:, 0] + jnp.where(noise < 0, known[:, 1], known[:, 2]) / 3 * noise
    is_body = (drawn[:, 0] > 0) & (drawn[:, 0] < drawn[:, 1]) & (drawn[:, 1] < 1)
    J = jnp.where(is_body[:, None], drawn[:, :2], jnp.array([0.5, 0.75]))
    J, P, z = jnp.concatenate([J, jnp.ones((16, 1))], axis=1), drawn[:, 2:4], jnp.array([0.0, 0.0, 1.0])

    def has_mode(J, P):
        found = li.systems.rigid_body(J).periods(li.systems.tumbling_state(J, *P, z, long_axis=False))
        return ~found.long_axis & jnp.allclose(jnp.stack(found[:2]), P, rtol=1e-6)

    good = is_body & jax.vmap(has_mode)(J, P)
    first, (east, north) = jnp.argmax(good), jnp.deg2rad(drawn[0, 4:] - known[4:, 0])
    (a, b), arc = jnp.deg2rad(known[4:, 0]), jnp.hypot(east, north)
    up = jnp.array([jnp.cos(b) * jnp.cos(a), jnp.cos(b) * jnp.sin(a), jnp.sin(b)])
    to_east = jnp.array([-jnp.sin(a), jnp.cos(a), 0.0])
    pole = jnp.cos(arc) * up + jnp.sinc(arc / jnp.pi) * (east * to_east + north * jnp.cross(up, to_east))
    phi, psi = jnp.where(k == 0, 0.0, 2 * jnp.pi * jax.random.uniform(jax.random.fold_in(key, 1), (2,)))
    return (jnp.where(good.any(), J[first], jnp.nan), P[first], pole, phi, psi), ~good[0]


def passage(orbit, t, J, P, pole, phi, psi):
    """The step of a member, and its state at time t by the free motion to the phases φ and ψ at the perigee.

    φ is the angle about the angular momentum from the line Earth–body to the long axis; ψ is 2π times the part of P_ψ
    that has passed since the momentum lay between the axes x and z of the body, nearest to x.
    """
    look = {"phi": phi, "psi": psi, "toward": orbit(0.0)[0]}
    state = li.systems.rigid_body(J).solution(li.systems.tumbling_state(J, *P, pole, long_axis=False, **look), t)
    step = li.schemes.compose(li.schemes.splitting(li.systems.gravity_gradient(J, orbit, mu=GM)), 8)
    return step, state._replace(t=jnp.asarray(t), work=jnp.zeros(()))


def invariants(step, state):
    """What the free motion from a state keeps: periods, mode, momentum, spin rate 2H/|L|, energy, pole."""
    free, size = step.system.free, jnp.linalg.norm(state.p)
    rate = 2 * free.energy(state) / size
    found = {"momentum": size, "rate": rate, "excitation": rate / size, "pole": state.p / size}
    return free.periods(state)._asdict() | found  # the greatest moment is 1


def change(run):
    """The invariants before and after the passage, and their changes; angles in degrees."""
    found = {key: np.asarray(x) for key, x in run.map(invariants).items()}
    before, after = ({key: x[k] for key, x in found.items()} for k in (0, -1))
    longitude, latitude = np.rad2deg([np.arctan2(*found["pole"].T[1::-1]), np.arcsin(found["pole"].T[2])])
    changed = {key: after[key] / before[key] for key in ("momentum", "rate")}
    changed["angle"] = np.rad2deg(2 * np.arcsin(np.linalg.norm(after["pole"] - before["pole"], axis=1) / 2))
    changed["longitude"] = (longitude[:, -1] - longitude[:, 0] + 180) % 360 - 180
    return before, after, changed | {"latitude": abs(latitude[:, -1]) - abs(latitude[:, 0])}


def before_rows(orbit, before):
    """The orbit and the spin before the passage, with published values."""
    (r, v), far = (np.linalg.norm(x) for x in orbit(0.0)), np.sqrt(GM * (ECCENTRICITY - 1) / PERIGEE)
    clock, P, Q = DATE.hour + DATE.minute / 60 + DATE.second / 3600, before["precession"], before["rotation"]
    values = r, v / 3600, far / 3600, clock, P, Q, 1 / (1 / P - 1 / Q), before["excitation"]
    return [li.report.Row(name, x, known) for (name, known), x in zip(PUBLISHED.items(), values, strict=True)]


def after_lines(before, after, changed):
    """How the members are distributed after the passage, and what was expected."""
    P, rate, angle, long_axis = after["precession"], changed["rate"], changed["angle"], after["long_axis"]
    modes = {"P_φ of short-axis modes (h)": P[~long_axis], "P_φ of long-axis modes (h)": P[long_axis]}
    rows = {"P_φ (h)": P, "P_ψ (h)": after["rotation"]} | modes | {"|L| over that before": changed["momentum"]}
    rows |= {"effective spin rate 2H/|L| over that before": rate}
    rows |= {"energy over the least at this |L|": after["excitation"], "rotation of the pole (°)": angle}
    rows |= {"pole's longitude changed by (°)": changed["longitude"]}
    rows |= {"pole's distance from the ecliptic changed by (°)": changed["latitude"]}
    lines = [f"\n  {'after, members of the run':<52}{'5 %':>9}{'median':>9}{'95 %':>9}{'least':>9}{'most':>9}"]
    for name, x in rows.items():
        numbers = np.quantile(x, (0.05, 0.5, 0.95, 0, 1)) if x.size else [np.nan] * 5
        lines.append(f"  {name:<52}" + "".join(f"{value:>9.3f}" for value in numbers))
    low, high, least, most = np.quantile(rate, (0.05, 0.95, 0, 1))
    closer, mode = 100 * np.mean(changed["latitude"] < 0), 100 * np.mean(~long_axis)
    return [
        *lines,
        f"  {mode:.1f} % end in a short-axis mode, {100 - mode:.1f} % in a long-axis mode",
        "\n  published expectations, and the members of the run",
        f"  effective spin rate could halve or double  ({BENSON})",
        f"    here: × {low:.2f} to × {high:.2f} (5 to 95 %), × {least:.2f} to × {most:.2f} in all; halved or less in "
        f"{100 * np.mean(rate <= 0.5):.3g} %, doubled or more in {100 * np.mean(rate >= 2):.3g} %",
        f"  pole likely to shift by 10° or more  ({BENSON})",
        f"    here: median {np.median(angle):.1f}°; 10° or more in {100 * np.mean(angle >= 10):.3g} %",
        f"  pole likely to increase in longitude  ({BENSON})",
        f"    here: it increases in {100 * np.mean(changed['longitude'] > 0):.3g} %",
        f"  pole likely to move closer to the ecliptic plane  ({BENSON})\n    here: it moves closer in {closer:.3g} %",
        f"  short-axis mode preserved with a high likelihood  ({DURECH})\n    here: the same in {mode:.3g} %",
    ]


def map_lines(before, after, changed, phi, psi):
    """The least and greatest changes of the nominal body over its phases."""
    rate, long_axis = changed["rate"], after["long_axis"]
    lines = [
        f"\n  {f'nominal body, {rate.size} pairs of phases':<52}{'value':>9}   at φ, ψ and at φ + 180°, ψ + 180° (°)"
    ]
    values = {"P_φ after (h)": after["precession"], "effective spin rate over that before": rate}
    for name, x in (values | {"rotation of the pole (°)": changed["angle"]}).items():
        for which, k in (("least", x.argmin()), ("most", x.argmax())):
            lines.append(f"  {f'{name}, {which}':<52}{x[k]:>9.3f}   {phi[k]:.0f}, {psi[k]:.0f}")
    shares = {"spin rate halved or less": rate <= 0.5, "spin rate below × 0.75": rate <= 0.75}
    shares |= {"spin rate above × 1.5": rate >= 1.5, "spin rate doubled or more": rate >= 2}
    shares["long-axis mode after"] = long_axis
    return lines + [f"  {name:<52}{100 * x.mean():>7.1f} %" for name, x in shares.items()]


@li.plots.style()
def draw_map(before, after, changed, n):
    """Map spin rate, periods and rotation of the pole after the passage of the nominal body over both phases."""
    fig, axes = li.plots.figure(2, 2, sharex=True, sharey=True)
    panels = {"effective spin rate $2H/|L|$ over that before": (changed["rate"], "PuOr_r")}
    panels["precession period $P_\\phi$ (h)"] = after["precession"], "viridis"
    panels["rotation period $P_\\psi$ (h), at most 500"] = np.minimum(after["rotation"], 500), "cividis"
    panels["rotation of the pole (°)"] = changed["angle"], "magma"

    def full_circle(x):  # a rotation by 180° about its short axis, at φ + 180° and ψ + 180°, gives the same passage
        half = x.reshape(n, -1)
        return np.pad(np.concatenate([half, np.roll(half, n // 2, axis=0)], axis=1), ((0, 1), (0, 1)), mode="wrap").T

    phi, long_axis = np.linspace(0, 360, n + 1), full_circle(after["long_axis"].astype(float))
    for ax, (title, (x, colors)) in zip(axes.flat, panels.items(), strict=True):
        image = ax.pcolormesh(phi, phi, full_circle(x), cmap=colors, shading="gouraud", rasterized=True)
        fig.colorbar(image, ax=ax)
        lines = ax.contour(phi, phi, full_circle(x), 6, colors=li.plots.INK, linewidths=0.6)
        ax.clabel(lines, fmt="%g", fontsize="x-small")
        ax.contourf(phi, phi, long_axis, [0.5, 1.5], hatches=["///"], colors="none").set(edgecolor="white", linewidth=0)
        ax.set(title=title, xticks=range(0, 361, 90), yticks=range(0, 361, 90))
    fig.supxlabel("precession phase φ at the perigee (°)")
    fig.supylabel("rotation phase ψ at the perigee (°)")
    fig.suptitle(f"{TITLE}: nominal body; hatched: a long-axis mode after the passage")
    return fig


@li.plots.style()
def draw_after(before, after, changed):
    """Plot the distributions of the members after the passage."""
    fig, [axes] = li.plots.figure(3)
    panels = {"precession period $P_\\phi$ (h)": (after["precession"], {"before": before["precession"][0]})}
    panels["effective spin rate $2H/|L|$ over that before"] = changed["rate"], {"before": 1.0}
    panels["rotation of the pole (°)"] = changed["angle"], {}
    modes = {"short-axis mode": ~after["long_axis"], "long-axis mode": after["long_axis"]}
    for ax, (label, (x, marks)) in zip(axes, panels.items(), strict=True):
        li.plots.histogram(ax, {name: x[mode] for name, mode in modes.items()}, label, marks, shown=0.99)
    fig.suptitle(f"{TITLE}: {len(after['rate'])} members, uniform phases; the highest 1 % not shown")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
