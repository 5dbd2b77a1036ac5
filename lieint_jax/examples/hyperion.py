"""Hyperion: where the rotation of this moon of Saturn is chaotic, and whether its observed states are.

The moon, far from round, rotates in an eccentric orbit, where the pull of Saturn on its long axis makes most slow
rotations chaotic: small differences grow by the factor e in some tens of days. The script maps planar motions, measures
Lyapunov exponents in the plane, out of it and in space, and those of the states that Voyager 2 and Cassini observed.
Units: the orbit's mean motion n and semi-major axis are 1; the period converts times to days. Model: Saturn is a point
mass, and the orbit is a fixed ellipse.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "Hyperion"
INERTIA = (0.5956, 0.8594, 1.0)  # homogeneous ellipsoid, semi-axes 190, 145, 114 km; √(3(B−A)/C) = 0.89 [WISDOM]
ECCENTRICITY, PERIOD = 0.1, 21.28  # [WISDOM]; d
ANGLES, GREATEST_RATE = 24, 4.0  # starts with one rate, from 0 to π; n
PER_ORBIT = 60  # steps; 40, 80 and 160 give the same result: 44 % chaotic, mean exponents 0.121 to 0.124 in the plane
TILT = np.deg2rad(5.0)  # rad, of motions in space from the starts of planar ones
PER_ORBIT_OBSERVED = 180  # 360, or 60 of order 4, give the same result; 60 halve the weak exponents of corrected states
CHAOTIC = 3.0  # a motion counts as chaotic above this many times ln(t)/t, the exponent of regular motions
SHARED = (None, 0, 0, None)  # axes of members in step, q, p and t: these share their step and their time
PLANES = np.array([[0, 0, 1, 0, 0, 1], [1, 1, 0, 1, 1, 0]]).T  # (δθ, δπ) in the plane and out of it, which do not mix

# Principal moments about the axes a, b, c, eccentricity, mean anomaly (°) and spin rate (n) at each date.
BODY = (0.314, 0.474, 0.542)  # [GOLDBERG]
DATES = {
    "1981-08-23": ((0.3234, 0.4597, 0.5192), 0.1236, 20.0065, 4.225),  # [BLACK]
    "2005-06-10": (BODY, 0.115, 295.0, 4.433),  # and below: [HARBISON]
    "2005-08-16": (BODY, 0.115, 342.0, 4.255),
    "2005-09-25": (BODY, 0.113, 303.0, 4.255),
}
# Date, assumption on the principal axes, attitude R_z(α) R_x(β) R_z(γ) in degrees, axes a, b, c to space, where x is
# toward pericenter and z normal; and the direction of the angular velocity along a, b, c. Table 1 of [GOLDBERG] gives
# the axes in the order b, c, a, and ZXZ angles of the rotation from space to body: only so do the spin vectors in space
# agree with [HARBISON] and the authors' notebook. The corrected states rotate the body, but not the spin vector.
OBSERVED = [
    ("1981-08-23", "fit of Black et al.", (33.09739, 132.49006, 129.47275), (0.97731561, 0.21091622, -0.01919746)),
    ("2005-06-10", "those of the shape model", (0.2292, 82.5632, 24.4653), (0.8900, 0.0670, 0.4510)),
    ("2005-08-16", "those of the shape model", (108.0025, 121.3525, 67.6090), (0.9070, 0.1620, 0.3890)),
    ("2005-09-25", "those of the shape model", (171.2571, 96.5434, 94.0224), (0.9020, 0.1330, 0.4110)),
    ("2005-06-10", "corrected as in table 1", (306.6477, 67.5241, 38.1620), (0.9833, -0.0105, -0.1817)),
    ("2005-08-16", "corrected as in table 1", (48.8532, 112.3040, 47.5635), (0.9863, -0.1656, 0.0094)),
    ("2005-09-25", "corrected as in table 1", (117.6720, 109.3389, 78.2098), (0.9831, -0.0951, 0.1569)),
]
NOTES = """
  Published: Harbison et al. find chaos with an e-folding time on the order of 100 days; Goldberg & Batygin, who
  correct the principal axes, find none or far weaker chaos. The model omits Titan's perturbations of the orbit and
  errors of the moments.

  Sources: [WISDOM] Wisdom, Peale & Mignard 1984, Icarus 58:137; [BLACK] Black, Nicholson & Thomas 1995, Icarus 117:149,
  and [HARBISON] Harbison, Thomas & Nicholson 2011, Celest. Mech. Dyn. Astron. 110:1, both as in the code of [GOLDBERG]
  Goldberg & Batygin 2024, Astron. Astrophys. 692:A9, table 1; github.com/goldbergmax/hyperion-rot-orb"""


def main(
    members: int = 984,
    steps: int = 18_000,
    spatial_starts: int = 16,
    orbits: int = 1500,
    out: Path | None = None,
    resume: bool = False,
    pictures: bool = True,
) -> None:
    """Integrate planar motions, and measure Lyapunov exponents of them, of motions in space and of observed states.

    Args:
        members: the number of planar motions, a grid of 24 angles and of rates at pericenter: a multiple of 24.
        steps: the number of steps of the planar motions, 60 an orbit: a multiple of 60.
        spatial_starts: the number of motions in space, of those in the large chaotic zone, tilted by 5°.
        orbits: the length of these, and of the motions from observed states.
        out: the store of the planar motions; by default hyperion.zarr, or hyperion-2.zarr where that exists.
        resume: continue the planar motions in `out`.
        pictures: draw the surface of section.
    """
    jax.config.update("jax_enable_x64", True)
    if members % ANGLES or steps % PER_ORBIT:
        raise ValueError(f"members must be a multiple of {ANGLES}, and steps of {PER_ORBIT}; got {members} and {steps}")
    out, revolutions = out or li.report.new_path("hyperion.zarr", resume), steps // PER_ORBIT
    store = li.StoreOptions(out, {"title": TITLE}, "1/n")
    step, starts = planar_step_and_starts(members)
    dt, at_rest = 2 * np.pi / PER_ORBIT, starts._replace(work=jnp.zeros(members))
    run = li.run(step, at_rest, dt, steps, save_every=PER_ORBIT, store=store, resume=resume)
    planar = exponents(step, starts, revolutions, PER_ORBIT, PLANES, SHARED)
    section, measured = np.asarray(planar.exponents), [planar]
    chaotic = section[:, 0] > chaos_limit(revolutions)
    lines = [
        f"\n  exponents in mean motions n = 2π / {PERIOD:g} d; chaotic: above {CHAOTIC:g} ln(t)/t",
        f"\n  planar motions, {members} starts ({ANGLES} angles × {members // ANGLES} rates) × {revolutions} orbits",
        f"  {'chaotic':<46}{100 * chaotic.mean():>8.0f} %",
    ]
    if chaotic.any():
        zone = np.flatnonzero(section[:, 0] > np.median(section[chaotic, 0]) / 2)  # without thin chaotic layers
        names = "in the plane", "out of the plane: attitude unstable if > 0"
        lines += table("planar, in the chaotic zone", revolutions, section[zone], names)
        chosen = zone[np.unique(np.linspace(0, zone.size - 1, spatial_starts).round().astype(int))]
        tilt = li.groups.so3.exp(jnp.array([TILT, 0.0, 0.0]))
        q = jax.vmap(lambda q: li.groups.so3.multiply(tilt, q))(starts.q[chosen])
        tilted = starts._replace(q=q, p=starts.p[chosen])
        measured.append(exponents(step, tilted, orbits, PER_ORBIT, np.eye(6), SHARED))
        spectra = np.sort(np.asarray(measured[1].exponents), axis=1)[:, ::-1]
        names = "1st", "2nd", "3rd", "4th", "5th", "6th"
        lines += table("in space, from there", orbits, spectra, names)
        lines.append(f"  {'largest sum of six':<46}{abs(spectra.sum(axis=1)).max():>10.1e}")
    observed, limit = observed_exponents(orbits), chaos_limit(orbits)
    lines.append(f"\n  observed states, {orbits} orbits; chaotic: largest exponent above {limit:.4f}")
    for (date, axes, *_), [x], [error] in zip(OBSERVED, observed.exponents, observed.errors, strict=True):
        kind = "chaotic" if x > limit else "not distinct from regular"
        lines.append(f"  {date}  {axes:<34}{x:>+10.4f} ± {error:.4f}{e_folding(x):>12}   {kind}")
    failed = sum(int((~np.asarray(x.info.converged)).sum()) for x in (*measured, observed))
    lines += [NOTES, f"\n  {failed} of these runs had a step that did not converge"]
    print(li.report.text(TITLE, run, changed=li.report.changes(run), remarks=lines, error=8))
    if pictures:
        print("pictures:", *li.plots.save(draw(run, chaotic), out.with_name(f"{out.stem}-section.png")))


def planar_step_and_starts(members):
    """The step and a grid of planar starts: θ from the line of apsides, and θ̇ about the normal, at pericenter."""
    k, rates = np.arange(members), max(members // ANGLES, 2)
    half, zero = np.pi / ANGLES * (k % ANGLES) / 2, np.zeros(members)
    q = jnp.asarray(np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1))
    Omega = jnp.asarray(np.stack([zero, zero, GREATEST_RATE / (rates - 1) * (k // ANGLES)], axis=1))
    moon = li.systems.gravity_gradient(INERTIA, li.orbits.kepler(1.0, 1.0, ECCENTRICITY))
    states = jax.vmap(lambda q, Omega: moon.state(q, angular_velocity=Omega, t=0.0))(q, Omega)
    return li.schemes.splitting(moon), states._replace(t=jnp.zeros(()))


def exponents(step, states, orbits, per_orbit, vectors, in_axes):
    """The Lyapunov exponents of many states for initial tangent vectors (6, k)."""
    dt, num_steps = 2 * np.pi / per_orbit, orbits * per_orbit

    def of_one(step, q, p, t):
        return li.diagnostics.lyapunov(step, li.State(q, p, t), dt, num_steps, every=20, vectors=vectors)

    return li.over_members(of_one, in_axes)(step, states.q, states.p, states.t)


def observed_exponents(orbits):
    """The largest exponents of all observed states."""
    bodies = []
    for date, _, euler, axis in OBSERVED:
        inertia, eccentricity, mean_anomaly, rate = DATES[date]
        moon = li.systems.gravity_gradient(inertia, li.orbits.kepler(1.0, 1.0, eccentricity))
        q, Omega = li.attitude.from_euler("ZXZ", np.deg2rad(euler)), rate * np.array(axis) / np.linalg.norm(axis)
        state = moon.state(q, angular_velocity=Omega, t=np.deg2rad(mean_anomaly))
        bodies.append((li.schemes.splitting(moon), state))
    steps, states = jax.tree.map(lambda *x: jnp.stack(x), *bodies)
    return exponents(steps, states, orbits, PER_ORBIT_OBSERVED, np.ones((6, 1)), 0)


def chaos_limit(orbits):
    """The exponent above which a motion of this length counts as chaotic: regular ones reach about ln(t)/t."""
    t = 2 * np.pi * orbits
    return CHAOTIC * np.log(t) / t


def e_folding(exponent):
    """The time in which small differences grow by the factor e."""
    return f"{PERIOD / (2 * np.pi * exponent):.0f} d" if exponent > 0 else "—"


def table(title, orbits, values, names):
    """The mean of each exponent over the motions (motions, exponents), its standard error, and its e-folding time."""
    mean, error = values.mean(axis=0), values.std(axis=0) / max(len(values) - 1, 1) ** 0.5
    return [
        f"\n  {f'{title}, {len(values)} starts × {orbits} orbits':<53}{'mean ± error':>12}{'e-folding':>12}",
        *(
            f"  {name:<46}{x:>+10.4f} ± {e:.4f}{e_folding(x):>12}"
            for name, x, e in zip(names, mean, error, strict=True)
        ),
    ]


@li.plots.style()
def draw(run, chaotic):
    """Plot the surface of section at pericenter."""
    fig, [[ax]] = li.plots.figure(size=(5.0, 5.2))
    q, p = np.asarray(run.state.q), np.asarray(run.state.p)
    theta, rate = 2 * np.arctan2(q[..., 3], q[..., 0]) % np.pi, p[..., 2] / INERTIA[2]
    ax.scatter(theta[:, chaotic], rate[:, chaotic], s=0.15, color=li.plots.GRAY, lw=0, rasterized=True)
    for m in np.flatnonzero(~chaotic):
        color = li.plots.COLORS[1 + m % (len(li.plots.COLORS) - 1)]
        ax.scatter(theta[:, m], rate[:, m], s=0.4, lw=0, rasterized=True, color=color)
    ax.set(xlabel="θ, long axis from the line of apsides", ylabel="spin rate θ̇ / n", ylim=(0, rate[0].max()))
    ax.set_xticks(np.pi * np.arange(5) / 4, ["0", "π/4", "π/2", "3π/4", "π"])
    ax.set_title(
        f"{len(chaotic)} planar motions at pericenter, {len(run.t) - 1} orbits;\ngray: chaotic, colors: regular"
    )
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
