"""99942 Apophis passes the Earth, 2029-04-13: its spin after the flyby, phase by phase.

The asteroid tumbles, and the Earth's tide changes this tumbling. The change depends on two phases at the perigee, six
Earth radii from the center, which the published states do not give: the members cover all of them uniformly. Units: km
for the orbit, h since the perigee, moments of inertia over the greatest one; axes of space: ecliptic, J2000. Model: a
rigid body in the field of a point mass, to second order in size over distance, on a given hyperbola.
"""

from datetime import datetime
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "99942 Apophis passes the Earth, 2029-04-13"
PRAVEC, SOUCHAY = "Pravec et al. 2014, Icarus 233:48", "Souchay et al. 2014, A&A 563:A24: 21:46 ± 1 min TDB"
DURECH, BENSON = "Ďurech et al. 2026, arXiv 2604.24566", "Benson et al. 2023, Icarus 390:115324, arXiv 2210.13365"
GM = 398600.4418 * 3600.0**2  # km³/h², of the Earth [IERS Conventions 2010, Technical Note 36, table 1.1]
# The elements, those of an ephemeris service, are ecliptic: so the direction of approach agrees to 0.1° with that of
# heliocentric orbits of the Earth and of Apophis; read as equatorial, it differs by 16°. UTC is 69 s behind TDB here.
PERIGEE, ECCENTRICITY, DATE = 38011.48649129103, 4.253901873212790, datetime(2029, 4, 13, 21, 45, 4)  # km, UTC
ANGLES = (162.8561543134850, 152.0019490904037, 32.56762207107416)  # °: inclination, node, argument of the perigee
# Least and middle moment, precession period P_φ and rotation period P_ψ (h), longitude and latitude of the angular
# momentum (°), each with 3σ below and above [PRAVEC]. An assumption: the errors of the pole are along the parallel and
# the meridian, as the abstract does not orient the ellipse. Periods and moments give the energy and the momentum.
SPIN = ((0.61, 0.08, 0.11), (0.965, 0.015, 0.009), (27.38, 0.07, 0.07), (263, 6, 6), (250, 27, 27), (-75, 14, 14))
HOURS = 96.0  # before and after the perigee; 192 h change P_φ by less than 0.003 h, and the pole by less than 0.004°
NOTES = """
  Only the abstracts of the two papers were read. All models of Ďurech et al. have about the same orientation in 2029:
  their likelihood of the short-axis mode refers to some phases only; that of this run is an average over all phases."""


def main(
    members: int = 10_000,
    steps: int = 640,
    phases: int = 36,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 99942,
    pictures: bool = True,
) -> None:
    """Integrate the passage, and compare the spin after it with the spin before it and with what is expected.

    Args:
        members: the number of bodies, with random phases; the first is the nominal one, at phases 0.
        steps: the number of steps, a multiple of 40; they are shorter near the perigee.
        phases: the number of rotation phases of the map, over 180°; it has twice as many precession phases, over 360°.
        out: the store of the run; by default apophis.zarr, or apophis-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the map of both phases.
    """
    jax.config.update("jax_enable_x64", True)
    out, known = out or li.report.new_path("apophis.zarr", resume), np.array(SPIN, float)
    orbit = li.orbits.shared(li.orbits.kepler(GM, PERIGEE / (1 - ECCENTRICITY), ECCENTRICITY, *np.deg2rad(ANGLES)))
    spins, _ = jax.jit(jax.vmap(lambda k: draw(jax.random.key(seed), k, known)))(jnp.arange(members))
    start = jax.jit(jax.vmap(lambda spin: passage(orbit, -HOURS, *spin)))

    def integrate(bodies, count, **options):
        (step, states), times = bodies, li.orbits.graded_times(orbit, -HOURS, HOURS, count)
        return li.run(step, states._replace(t=states.t[0]), times=times, own_step=True, **options)

    bodies = start(spins)
    run = integrate(bodies, steps, save_every=40, store=li.StoreOptions(out, {"title": TITLE}, "h"), resume=resume)
    phi, psi = (x.ravel() * np.pi / phases for x in np.mgrid[: 2 * phases, :phases])
    nominal = [jnp.repeat(x[:1], phi.size, axis=0) for x in spins[:3]]
    mapped = integrate(start((*nominal, phi, psi)), steps, save_every=steps, progress=False)
    (before, after), (_, on_map) = before_and_after(run), before_and_after(mapped)
    remarks = [
        "\n  members: both phases uniform; moments, periods and pole by their published errors, which are 3 sigma",
        *after_lines(after),
        *map_lines(on_map, phi, psi),
        f"\n  {(~np.asarray(mapped.converged)).sum()} bodies of the map had a step that did not converge\n{NOTES}\n",
    ]
    print(li.report.text(TITLE, run, before_rows(orbit, before), remarks=remarks))
    if pictures:
        print("pictures:", *li.plots.save(draw_map(on_map, phi, psi), out.with_name(f"{out.stem}-map.png")))


def draw(key, k, known):
    """Moments, periods, pole and phases of the k-th member, the nominal one for k = 0; whether the first draw failed.

    Some moments within the errors have no short-axis mode with such periods: the first good one of 16 draws is used.
    """
    key = jax.random.fold_in(key, k)
    noise = jnp.where(k == 0, 0.0, jax.random.normal(key, (16, 6)))
    drawn = known[:, 0] + jnp.where(noise < 0, known[:, 1], known[:, 2]) / 3 * noise
    is_body = (drawn[:, 0] > 0) & (drawn[:, 0] < drawn[:, 1]) & (drawn[:, 1] < 1)
    J, P, z = jnp.concatenate([drawn[:, :2], jnp.ones((16, 1))], axis=1), drawn[:, 2:4], jnp.array([0.0, 0.0, 1.0])
    momenta = jax.vmap(lambda J, P: li.systems.tumbling_state(J, P[0], P[1], z, long_axis=False).p)(J, P)
    good = is_body & jnp.isfinite(momenta).all(axis=1)
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
    phases = {"phi": phi, "psi": psi, "toward": orbit(0.0)[0]}
    near = li.systems.tumbling_state(J, P[0], P[1], pole, long_axis=False, **phases)
    state = li.systems.rigid_body(J).solution(near, t)
    step = li.schemes.compose(li.schemes.splitting(li.systems.gravity_gradient(J, orbit, mu=GM)), 8)
    return step, state._replace(t=jnp.asarray(t), work=jnp.zeros(()))


def invariants(step, state):
    """What the free motion from a state keeps: periods, mode, momentum, spin rate 2H/|L|, energy, pole."""
    free, size = step.system.free, jnp.linalg.norm(state.p)
    rate = 2 * free.energy(state) / size
    found = dict(zip(("precession", "rotation", "long_axis"), free.periods(state), strict=True))
    return found | {"momentum": size, "rate": rate, "excitation": rate / size, "pole": state.p / size}  # J₃ is 1


def before_and_after(run):
    """The invariants before the passage, and those after it with their changes; angles in degrees."""
    found = {key: np.asarray(x) for key, x in run.map(invariants).items()}
    before, after = ({key: x[k] for key, x in found.items()} for k in (0, -1))
    (x, y, z), (x1, y1, z1) = before["pole"].T, after["pole"].T
    after["angle"] = np.rad2deg(2 * np.arcsin(np.linalg.norm(after["pole"] - before["pole"], axis=1) / 2))
    after |= {"longitude increases": x * y1 > y * x1, "latitude decreases": abs(z1) < abs(z)}
    return before, after | {f"{key} ratio": after[key] / before[key] for key in ("momentum", "rate")}


def before_rows(orbit, before):
    """The orbit and the spin before the passage, with published values."""
    Row, Published, P, Q = li.report.Row, li.report.Published, before["precession"], before["rotation"]
    (r, v), far = (np.linalg.norm(x) for x in orbit(0.0)), np.sqrt(GM * (ECCENTRICITY - 1) / PERIGEE)
    clock, light = DATE.hour + DATE.minute / 60 + DATE.second / 3600, Published(30.56, 0.01, PRAVEC)
    return [
        Row("distance at the perigee (km)", r, Published(38000, None, DURECH)),
        Row("speed at the perigee (km/s)", v / 3600),
        Row("speed far away (km/s)", far / 3600),
        Row("time of the perigee (h, UTC)", clock, Published(21.75, 0.02, SOUCHAY)),
        Row("precession period P_φ (h)", P, (Published(27.38, 0.07, PRAVEC), Published(27.374, 0.001, DURECH))),
        Row("rotation period P_ψ (h)", Q, (Published(263.0, 6.0, PRAVEC), Published(262.2, 0.1, DURECH))),
        Row("1/(1/P_φ − 1/P_ψ), strongest in light curves (h)", 1 / (1 / P - 1 / Q), light),
        Row("energy over the least at this |L|", before["excitation"], Published(1.024, 0.013, PRAVEC)),
    ]


def after_lines(after):
    """How the members are distributed after the passage, next to what was expected."""
    rate, angle = after["rate ratio"], after["angle"]
    low, high, least, most = np.quantile(rate, (0.05, 0.95, 0, 1))
    conditions = angle >= 10, after["longitude increases"], after["latitude decreases"], ~after["long_axis"]
    shifted, increases, closer, short = (f"{100 * x.mean():.3g} %" for x in conditions)
    return [
        f"\n  published expectations, and the members of the run; [1] {BENSON}; [2] {DURECH}",
        "  [1] effective spin rate could halve or double",
        f"    here: × {low:.2f} to × {high:.2f} (5 to 95 %), × {least:.2f} to × {most:.2f} in all",
        "  [1] pole likely to shift by 10° or more, to increase in longitude, and to move closer to the ecliptic plane",
        f"    here: median {np.median(angle):.1f}°; ≥ 10° in {shifted}; increases in {increases}; closer in {closer}",
        f"  [2] short-axis mode preserved with a high likelihood\n    here: the same in {short}",
    ]


def map_lines(after, phi, psi):
    """The least and greatest changes of the nominal body over its phases."""
    rate = after["rate ratio"]
    values = {"P_φ after (h)": after["precession"], "effective spin rate over that before": rate}
    values["rotation of the pole (°)"] = after["angle"]
    return [
        f"\n  {f'nominal body, {rate.size} pairs of phases':<52}{'value':>9}   at φ, ψ and at φ + 180°, ψ + 180° (°)",
        *(
            f"  {f'{name}, {which}':<52}{x[k]:>9.3f}   {np.rad2deg(phi[k]):.0f}, {np.rad2deg(psi[k]):.0f}"
            for name, x in values.items()
            for which, k in (("least", x.argmin()), ("most", x.argmax()))
        ),
    ]


@li.plots.style()
def draw_map(after, phi, psi):
    """Map the spin rate of the nominal body after the passage over both phases."""
    fig, [[ax]] = li.plots.figure(size=(6.5, 4.0))
    x, y = np.rad2deg(np.unique(phi)), np.rad2deg(np.unique(psi))
    rate, is_long = (z.reshape(len(x), len(y)).T for z in (after["rate ratio"], after["long_axis"].astype(float)))
    fig.colorbar(ax.pcolormesh(x, y, rate, cmap="PuOr_r", shading="gouraud", rasterized=True), ax=ax)
    ax.contour(x, y, is_long, [0.5], colors=li.plots.INK)
    ax.set(xlabel="precession phase φ at the perigee (°)", ylabel="rotation phase ψ (°)", xticks=range(0, 361, 90))
    ax.set_title("effective spin rate $2H/|L|$ over that before; line: to a long-axis mode")
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
