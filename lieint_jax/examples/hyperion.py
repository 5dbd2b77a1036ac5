"""Hyperion: where the rotation of this moon of Saturn is chaotic, and whether its observed states are.

The moon, far from round, rotates in an eccentric orbit, where the pull of Saturn on its long axis makes most slow
rotations chaotic: small differences grow by the factor e in some tens of days. The script maps planar motions, measures
Lyapunov exponents in the plane, out of it and in space, and those of the states that Voyager 2 and Cassini observed.
Units: the orbit's mean motion n and semi-major axis are 1; the period converts times to days. Model: Saturn is a point
mass, and the orbit is a fixed ellipse.
"""

import functools
import math
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "Hyperion"
WISDOM = "Wisdom, Peale & Mignard 1984, Icarus 58:137"
BLACK = "Black, Nicholson & Thomas 1995, Icarus 117:149, as in the code of the last source"
HARBISON = "Harbison, Thomas & Nicholson 2011, Celest. Mech. Dyn. Astron. 110:1, as in the code of the last source"
GOLDBERG = (
    "Goldberg & Batygin 2024, Astron. Astrophys. 692:A9, table 1; their code: github.com/goldbergmax/hyperion-rot-orb, "
    "rotation/current_state.ipynb and rotation_tools.py"
)
INERTIA = (0.5956, 0.8594, 1.0)  # homogeneous ellipsoid, semi-axes 190, 145, 114 km; √(3(B−A)/C) = 0.89 [WISDOM]
ECCENTRICITY, PERIOD = 0.1, 21.28  # [WISDOM]; d
PER_ORBIT = 60  # steps; 40, 80 and 160 give the same result: 44 % chaotic, mean exponents 0.121 to 0.124 in the plane
TILT = np.deg2rad(5.0)  # rad, of motions in space from the starts of planar ones
# An assumption, 1σ of each component: the error bars of spin vectors in the authors' notebook are 2° and 1°/d, 0.059 n.
SPREAD = {"attitude": 2.0, "spin axis": 2.0, "spin rate": 0.059}  # °, °, n
PER_ORBIT_AROUND = 180  # 360, or 60 of order 4, give the same result; 60 halve the weak exponents of corrected states
CHAOTIC = 3.0  # a motion counts as chaotic above this many times ln(t)/t, the exponent of regular motions
MAJORITY = 0.95  # share of chaotic members above which a state is chaotic; below 1 − MAJORITY it may be regular
IN_PLANE, OUT_OF_PLANE = (2, 5), (0, 1, 3, 4)  # coordinates (δθ, δπ), which do not mix along a planar motion

# Principal moments about the axes a, b, c, eccentricity, mean anomaly (°) and spin rate (n) at each date.
BODY = (0.314, 0.474, 0.542)  # [GOLDBERG]
DATES = {
    "1981-08-23": ((0.3234, 0.4597, 0.5192), 0.1236, 20.0065, 4.225),  # [BLACK]
    "2005-06-10": (BODY, 0.115, 295.0, 4.433),  # and below: [HARBISON]
    "2005-08-16": (BODY, 0.115, 342.0, 4.255),
    "2005-09-25": (BODY, 0.113, 303.0, 4.255),
}
# Date, assumption on the principal axes, attitude R_z(α) R_x(β) R_z(γ) in degrees, axes a, b, c to space, where x is
# toward pericenter and z normal; and the direction of the angular velocity along a, b, c. Conventions, checked against
# the authors' programs and against each other:
# * Table 1 of [GOLDBERG] gives the axes in the order b, c, a: its third component of the spin axis is the one along the
#   longest axis a, and its moments 0.314, 0.474, 0.542 belong to a, b, c. Its ZXZ angles describe the inverse rotation,
#   from space to body. Read as body to space, they give spin vectors in space that differ from those of [HARBISON] by
#   5° to 61°; inverted, by 0.03°.
# * The attitudes "of the shape model" are those of [HARBISON] as the authors integrate them: body to space, axes a, b,
#   c. The resulting spin vectors in space agree to 5° with those that the notebook draws.
# * The corrected states of table 1 rotate the body in space by Rz(40°) Rx(20°) Rz(10°) at every date, but not the spin
#   vector. Relative to the body this is a different rotation at each date: the three spin axes are 2° to 7° apart in
#   the axes of the shape, and 9° to 20° apart in the corrected axes. No axes fixed in the body agree with both.
# * Therefore a third reading is added: principal axes fixed in the body, which result from those of the shape by the
#   smallest rotation, 25.8°, that aligns a with the mean of the three spin axes, as in the best fit of [HARBISON]
#   ("some 30°").
OBSERVED = [
    ("1981-08-23", "fit of Black et al.", (33.09739, 132.49006, 129.47275), (0.97731561, 0.21091622, -0.01919746)),
    ("2005-06-10", "those of the shape model", (0.2292, 82.5632, 24.4653), (0.8900, 0.0670, 0.4510)),
    ("2005-08-16", "those of the shape model", (108.0025, 121.3525, 67.6090), (0.9070, 0.1620, 0.3890)),
    ("2005-09-25", "those of the shape model", (171.2571, 96.5434, 94.0224), (0.9020, 0.1330, 0.4110)),
    ("2005-06-10", "corrected as in table 1", (306.6477, 67.5241, 38.1620), (0.9833, -0.0105, -0.1817)),
    ("2005-08-16", "corrected as in table 1", (48.8532, 112.3040, 47.5635), (0.9863, -0.1656, 0.0094)),
    ("2005-09-25", "corrected as in table 1", (117.6720, 109.3389, 78.2098), (0.9831, -0.0951, 0.1569)),
    ("2005-06-10", "corrected, fixed in the body", (338.5072, 94.4627, 32.3120), (0.9979, -0.0530, 0.0363)),
    ("2005-08-16", "corrected, fixed in the body", (94.7179, 144.1785, 65.6584), (0.9988, 0.0409, -0.0296)),
    ("2005-09-25", "corrected, fixed in the body", (174.9870, 121.0220, 102.5247), (1.0000, 0.0121, -0.0068)),
]
NOTES = [
    "Published: Harbison et al. find chaos with an e-folding time on the order of 100 days; Goldberg & Batygin, who "
    "correct the principal axes, find none or far weaker chaos.",
    "Table 1 of Goldberg & Batygin was read according to their programs: axes in the order b, c, a, and angles of the "
    "rotation from space to body. No single set of axes in the body agrees with its corrected states: the three spin "
    "axes are 2° to 7° apart before the correction, and 9° to 20° after it. In the last three rows the axes are "
    "rotated in the body instead.",
    "The model omits Titan's perturbations of the orbit and errors of the moments.",
    f"Sources: {WISDOM}; {BLACK}; {HARBISON}; {GOLDBERG}.",
]


def main(
    members: int = 984,
    steps: int = 18_000,
    angles: int = 24,
    greatest_rate: float = 4.0,
    planar_starts: int = 31,
    planar_orbits: int = 2000,
    spatial_starts: int = 16,
    spatial_orbits: int = 1000,
    around: int = 16,
    around_orbits: int = 1500,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1984,
    pictures: bool = True,
) -> None:
    """Integrate planar motions, and measure Lyapunov exponents of them, of motions in space and of observed states.

    Args:
        members: the number of planar motions, a grid of angles and rates at pericenter: a multiple of `angles`.
        steps: the number of steps of the planar motions, 60 an orbit: a multiple of 60.
        angles: the number of starts with one rate, from 0 to π.
        greatest_rate: of the starts, from 0, in mean motions.
        planar_starts: the number of longer planar motions, of those in the large chaotic zone.
        planar_orbits: their length, in orbits.
        spatial_starts: the number of motions in space, of those in the large chaotic zone, tilted by 5°.
        spatial_orbits: their length, in orbits.
        around: the number of members about each observed state; the first is the state itself.
        around_orbits: their length, in orbits.
        out: the store of the planar motions; by default hyperion.zarr, or hyperion-2.zarr where that exists.
        resume: continue the planar motions in `out`.
        seed: of the deviations of the members about observed states.
        pictures: draw the surface of section and a map of the exponents.
    """
    jax.config.update("jax_enable_x64", True)
    if members % angles or steps % PER_ORBIT:
        raise ValueError(
            f"members = {members} must be a multiple of angles = {angles}, and steps = {steps} whole orbits of "
            f"{PER_ORBIT} steps"
        )
    out, orbits = out or li.report.new_path("hyperion.zarr", resume), steps // PER_ORBIT
    store = li.StoreOptions(out, {"title": TITLE}, "1/n")
    step, starts = planar_step_and_starts(members, angles, greatest_rate)
    dt, at_rest = 2 * np.pi / PER_ORBIT, starts._replace(work=jnp.zeros(members))
    run = li.run(step, at_rest, dt, steps, save_every=PER_ORBIT, store=store, resume=resume)
    planes = np.zeros((6, 2))
    planes[IN_PLANE, 0] = planes[OUT_OF_PLANE, 1] = 1
    measured = [exponents(step, starts, orbits, PER_ORBIT, planes)]
    section = np.asarray(measured[0].exponents)
    chaotic, unstable = (section > chaos_limit(orbits)).T
    lines = [
        f"\n  exponents in mean motions n = 2π / {PERIOD:g} d; chaotic: above {CHAOTIC:g} ln(t)/t",
        f"\n  planar motions, {members} starts ({angles} angles × {members // angles} rates) × {orbits} orbits",
        f"  {'chaotic':<58}{percent(chaotic):>8}",
        f"  {'of the regular ones, attitude unstable':<58}{percent(unstable[~chaotic]):>8}",
    ]
    if chaotic.any():
        zone = np.flatnonzero(section[:, 0] > np.median(section[chaotic, 0]) / 2)  # without thin chaotic layers
        plane = exponents(step, select(starts, zone, planar_starts), planar_orbits, PER_ORBIT, planes)
        space = tilted_exponents(step, select(starts, zone, spatial_starts), spatial_orbits)
        spectra = np.sort(np.asarray(space.exponents), axis=1)[:, ::-1]
        names = "in the plane", "out of the plane: attitude unstable if > 0"
        lines += table("planar motions in the chaotic zone", planar_orbits, np.asarray(plane.exponents), names)
        names = "1st", "2nd", "3rd", "4th", "5th", "6th"
        lines += table("motions in space from there", spatial_orbits, spectra, names)
        lines.append(f"  {'largest sum of six':<48}{abs(spectra.sum(axis=1)).max():>10.1e} n")
        measured += [plane, space]
    about = [exponents_about(k, around, around_orbits, seed) for k in range(len(OBSERVED))]
    found, errors = (np.array([np.asarray(x[i])[:, 0] for x in about]) for i in (0, 1))
    lines += observed_lines(found, errors, around_orbits)
    wrapped = textwrap.TextWrapper(118, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    lines += [f"\n{wrapped.fill(x)}" for x in NOTES]
    failed = sum(int((~np.asarray(x.info.converged)).sum()) for x in (*measured, *about))
    lines.append(f"\n  {failed} of these runs had a step that did not converge")
    print(li.report.text(TITLE, run, changed=li.report.changes(run), remarks=lines, error=8))
    if pictures:
        print("pictures:", *li.plots.save(draw(run, section, angles), out.with_name(f"{out.stem}-section.png")))


def moon_step(inertia, eccentricity):
    """The step of a moon in a fixed orbit about a point mass."""
    return li.schemes.splitting(li.systems.gravity_gradient(inertia, li.orbits.kepler(1.0, 1.0, eccentricity)))


def moon_states(step, q, Omega, t):
    """States at attitudes (m, 4) with angular velocities (m, 3) in the body, all at one time."""
    states = jax.vmap(lambda q, Omega: step.system.state(q, angular_velocity=Omega, t=t))(q, Omega)
    return states._replace(t=jnp.asarray(t, states.p.dtype))


def planar_step_and_starts(members, angles, greatest_rate):
    """The step and a grid of planar starts: θ from the line of apsides, and θ̇ about the normal, at pericenter."""
    k, rates = np.arange(members), max(members // angles, 2)
    half, zero = np.pi / angles * (k % angles) / 2, np.zeros(members)
    q = jnp.asarray(np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1))
    Omega = jnp.asarray(np.stack([zero, zero, greatest_rate / (rates - 1) * (k // angles)], axis=1))
    step = moon_step(INERTIA, ECCENTRICITY)
    return step, moon_states(step, q, Omega, 0.0)


def planar_coordinates(state):
    """θ in [0, π) and θ̇ of planar states; an angle at the rounding of π is 0."""
    q, p = np.asarray(state.q), np.asarray(state.p)
    theta = 2 * np.arctan2(q[..., 3], q[..., 0]) % np.pi
    return np.where(theta > np.pi - 1e-9, 0.0, theta), p[..., 2] / INERTIA[2]


def select(states, among, count):
    """At most `count` of the states with the indices `among`, evenly spread."""
    chosen = among[np.unique(np.linspace(0, among.size - 1, count).round().astype(int))]
    return states._replace(q=states.q[chosen], p=states.p[chosen])


def exponents(step, states, orbits, per_orbit, vectors):
    """The Lyapunov exponents of many states, which share their time, for initial tangent vectors (6, k)."""
    program, dt = compiled_exponents(orbits * per_orbit, math.gcd(per_orbit, 20)), 2 * np.pi / per_orbit
    return program(step, states.q, states.p, states.t, dt, jnp.asarray(vectors))


def tilted_exponents(step, states, orbits):
    """The six exponents of motions in space, which start at planar states tilted by 5°."""
    tilt = li.groups.so3.exp(jnp.array([TILT, 0.0, 0.0]))
    q = jax.vmap(lambda q: li.groups.so3.multiply(tilt, q))(states.q)
    return exponents(step, states._replace(q=q), orbits, PER_ORBIT, np.eye(6))


@functools.cache
def compiled_exponents(num_steps, every):
    """One program for all steps, states and tangent vectors of these sizes."""

    def of_one(step, q, p, t, dt, vectors):
        return li.diagnostics.lyapunov(step, li.State(q, p, t), dt, num_steps, every=every, vectors=vectors)

    return li.over_members(of_one, (None, 0, 0, None, None, None))


def exponents_about(k, members, orbits, seed):
    """The largest exponents of members about the k-th observed state."""
    (date, _, euler, axis), rng = OBSERVED[k], np.random.default_rng([seed, k])
    inertia, eccentricity, mean_anomaly, rate = DATES[date]
    step, so3 = moon_step(inertia, eccentricity), li.groups.so3
    rotation, tilt, change = np.split(rng.normal(size=(members, 7)), [3, 6], axis=1)
    rotation[0] = tilt[0] = change[0] = 0
    attitude = li.attitude.from_euler("ZXZ", np.deg2rad(euler))
    turns = jnp.asarray(np.deg2rad(SPREAD["attitude"]) * rotation)
    q = jax.vmap(lambda turn: so3.multiply(so3.exp(turn), attitude))(turns)
    axis = np.array(axis) / np.linalg.norm(axis)
    axes = axis + np.deg2rad(SPREAD["spin axis"]) * (tilt - (tilt @ axis)[:, None] * axis)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    Omega = jnp.asarray((rate + SPREAD["spin rate"] * change) * axes)
    states = moon_states(step, q, Omega, np.deg2rad(mean_anomaly))
    return exponents(step, states, orbits, PER_ORBIT_AROUND, np.ones((6, 1)))


def chaos_limit(orbits):
    """The exponent above which a motion of this length counts as chaotic: regular ones reach about ln(t)/t."""
    t = 2 * np.pi * orbits
    return CHAOTIC * np.log(t) / t


def verdict(exponents, bound):
    """Whether the members about a state are chaotic: nearly all of them, nearly none, or undecided."""
    share = np.mean(exponents > bound)
    return "chaotic" if share >= MAJORITY else "not distinct from regular" if share <= 1 - MAJORITY else "undecided"


def statistics(x):
    """The mean of members, its standard error, their standard deviation, and the e-folding time of the mean."""
    mean, deviation = np.mean(x), np.std(x, ddof=1) if len(x) > 1 else 0.0
    return mean, deviation / len(x) ** 0.5, deviation, f"{PERIOD / (2 * np.pi * mean):.0f} d" if mean > 0 else "—"


def table(space, orbits, values, names):
    """The mean of each exponent over the motions (motions, exponents), its error, spread and e-folding time."""
    title = f"{space}, {len(values)} starts × {orbits} orbits"
    rows = zip(names, map(statistics, values.T), strict=True)
    return [
        f"\n  {title:<68}{'mean ± error':>10}{'spread':>9}{'e-folding':>12}",
        *(f"  {name:<46}{x:>+10.4f} ± {error:.4f}{spread:>10.4f}{time:>12}" for name, (x, error, spread, time) in rows),
    ]


def observed_lines(found, errors, orbits):
    """A line for each observed state: its exponent, that of its members, and the verdict."""
    bound = chaos_limit(orbits)
    lines = [
        f"\n  observed states, {found.shape[1]} members × {orbits} orbits; "
        f"chaotic: largest exponent above {bound:.4f} n",
        "  members, an assumption (1 sigma, each component): attitude {:g}°, spin axis {:g}°, spin rate {:g} n".format(
            *SPREAD.values()
        ),
        f"  {'date':<12}{'principal axes':<32}{'nominal':>17}{'mean of members':>20}{'e-folding':>12}{'chaotic':>9}",
    ]
    for (date, reading, *_), x, error in zip(OBSERVED, found, errors, strict=True):
        mean, its_error, _, time = statistics(x)
        members = f"{mean:>11.4f} ± {its_error:.4f}{time:>12}{percent(x > bound):>9}  {verdict(x, bound)}"
        lines.append(f"  {date:<12}{reading:<32}{x[0]:>8.4f} ± {error[0]:.4f}{members}")
    return lines


def percent(x):
    """The share of true values."""
    return f"{100 * np.mean(x):.0f} %" if x.size else "—"


@li.plots.style()
def draw(run, section, angles):
    """Plot the surface of section at pericenter, and a map of the exponents in the plane."""
    fig, [[left, right]] = li.plots.figure(2, size=(5.0, 5.2))
    chaotic = section[:, 0] > chaos_limit(len(run.t) - 1)
    theta, rate = planar_coordinates(run.state)
    left.scatter(theta[:, chaotic], rate[:, chaotic], s=0.15, color=li.plots.GRAY, lw=0, rasterized=True)
    for m in np.flatnonzero(~chaotic):
        color = li.plots.COLORS[1 + m % (len(li.plots.COLORS) - 1)]
        left.scatter(theta[:, m], rate[:, m], s=0.4, lw=0, rasterized=True, color=color)
    left.set(
        ylabel="spin rate θ̇ / n", title="surface of section at pericenter;\ngray: chaotic motions, colors: regular ones"
    )
    grids = (x.reshape(-1, angles) for x in (theta[0], rate[0], section[:, 0]))
    x, y, value = (np.concatenate([grid, grid[:, :1]], axis=1) for grid in grids)  # θ has the period π
    x[:, -1] += np.pi
    shown = right.pcolormesh(x, y, value, shading="nearest", vmin=0, cmap="magma")
    fig.colorbar(shown, ax=right, label="largest Lyapunov exponent in the plane / n")
    for ax in (left, right):
        ax.set(xlabel="θ, long axis from the line of apsides", xlim=(0, np.pi), ylim=(0, rate[0].max()))
        ax.set_xticks(np.pi * np.arange(5) / 4, ["0", "π/4", "π/2", "3π/4", "π"])
    fig.suptitle(f"{TITLE}: {len(chaotic)} planar motions, {len(run.t) - 1} orbits each")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
