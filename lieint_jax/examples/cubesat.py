"""A CubeSat from its release to its work: detumbling, pointing, unloading of wheels, and the work of each law.

The deployer leaves the satellite rotating at some degrees per second. Magnetic torquers and rods slow the rotation,
wheels then point its camera (z) to the nadir, and the torquers unload the wheels. Look at the works: all of them add up
to the change of energy, to round-off. Units: SI. The data of the components are assumptions, typical of catalogs.
"""

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A CubeSat from its release to its work"
INERTIA = np.array([0.0419, 0.0419, 0.0067])  # kg m², wheels included: 4 kg, 0.1 m × 0.1 m × 0.34 m
BOX, MIDDLE = (0.1, 0.1, 0.34), (0.0, 0.0, 0.01)  # m: its edges, and its middle from the center of mass
DIPOLE = np.array([0.002, 0.0, 0.004])  # A m², residual
ECCENTRICITY, NODE = 0.001, 40.0  # of the orbit; right ascension of the ascending node (°)
AIR = (6.967e-13, 63.822e3, 500e3)  # kg/m³, its scale height (m), at this height (m) [Vallado 2013, table 8-4]
RODS = (0.005, 3e-5, 4e-6)  # saturation (A m²), slope and coercivity (T) of the magnetic rods along x and y
MAX_DIPOLE = 0.2  # A m², of a torquer along each axis
WHEELS = li.torques.wheel_pyramid()  # the axes of four about z, 35.26° above the xy-plane
WHEEL_INERTIA, LIMITS = 5e-6, {"max_torque": 1e-4, "max_momentum": 4e-3}  # kg m², N m, N m s, of each
DETUMBLING, POINTING, UNLOADING = 4e4, 0.03, 1e-3  # gains: N m s/T²; frequency of the spring, rad/s; 1/s
BEGINS = {"detumbling": 0.0, "pointing": 11400.0, "pointing and unloading": 17100.0}  # s: 2 and 3 orbits later
RATE = np.deg2rad([2.0, -3.0, 1.0])  # rad/s, in the body, when it is released with the axes of space
SPREAD = {"attitude": 90.0, "rate": 3.0, "second moments": 0.05, "dipole": 0.002}  # 1σ: °, °/s, relative, A m²
SLOW, CAPTURED = 0.5, 10.0  # °/s, and ° from the nadir


def main(
    members: int = 100,
    steps: int = 11400,
    height: float = 500.0,
    inclination: float = 97.4,
    date: str = "2026-03-01",
    out: Path | None = None,
    resume: bool = False,
    seed: int = 2026,
    pictures: bool = True,
    error: bool = False,
) -> None:
    """Integrate the satellite through its phases, and measure when it is captured and what did the work.

    Args:
        members: the number of satellites, each with its own start, inertia and dipole; the first is the nominal one.
        steps: the number of steps of 2 s, a multiple of 20; 11 400 are four orbits.
        height: of the perigee above the equatorial radius, in km.
        inclination: of the orbit, in degrees.
        date: of the release, 0 h UTC: the magnetic field of the Earth and its rotation follow from it.
        out: the store of the run; by default cubesat.zarr, or cubesat-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the rates, angles and wheels, and the work of each law.
        error: measure how far the nominal satellite is off, by runs with half and a quarter of the step; it compiles
            the laws once more.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("cubesat.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "s")
    so3, radius = li.groups.so3, 1e3 * li.orbits.EARTH_RADIUS
    kepler = li.orbits.kepler(
        1e9 * li.orbits.EARTH_GM,
        (radius + 1e3 * height) / (1 - ECCENTRICITY),
        ECCENTRICITY,
        np.deg2rad(inclination),
        node=np.deg2rad(NODE),
    )
    orbit = li.orbits.shared(kepler)  # the same for all members: computed once
    field = li.orbits.shared(li.orbits.earth_field(kepler, date, radius=6371.2e3))
    air = li.orbits.shared(li.orbits.atmosphere(kepler, *AIR, radius=radius))
    frame = li.orbits.shared(li.orbits.lvlh(orbit))  # z down, x forward

    def laws(J, dipole):
        """All torques on a satellite of an inertia (3, 3), wheels included, and a residual dipole (3,)."""
        moments = jnp.diagonal(J)
        control = li.torques.pointing(frame, 2 * POINTING**2 * moments, 2 * POINTING * moments, J)
        motor = li.torques.wheel_motor(WHEELS, control, gyroscopic=True, window=(BEGINS["pointing"], 1e9))
        brake = li.torques.bdot(DETUMBLING, field, MAX_DIPOLE)
        unloading = li.torques.unloading(WHEELS, UNLOADING, field, MAX_DIPOLE)
        rods = {
            f"rod along {name}": li.torques.hysteresis(axis, *RODS, field=field, key=name)
            for name, axis in zip("xy", np.eye(3), strict=False)
        }
        return {
            "gravity gradient": li.torques.gravity_gradient(orbit, J, kepler.mu),
            "residual dipole": li.torques.dipole(dipole, field),
            "air": li.torques.aerodynamic(air, *li.torques.box_plates(BOX, MIDDLE)),
            **rods,
            "B-dot": li.torques.windowed(brake, BEGINS["detumbling"], BEGINS["pointing"]),
            "unloading": li.torques.windowed(unloading, BEGINS["pointing and unloading"]),
            "wheels": li.torques.wheels(WHEELS, WHEEL_INERTIA, motor, **LIMITS),
        }

    def member(noise):
        turn, change, stretch, magnet = jnp.array([*SPREAD.values()])[:, None] * noise
        second = (INERTIA.sum() / 2 - INERTIA) * jnp.exp(stretch)  # second moments of mass: any positive ones exist
        J = jnp.diag(second.sum() - second)
        torque = li.torques.total(laws(J, DIPOLE + magnet).values())
        body = li.systems.torqued_body(li.torques.body_inertia(J, WHEELS, WHEEL_INERTIA), torque)
        Omega = RATE + jnp.deg2rad(change)
        state = body.state(so3.exp(jnp.deg2rad(turn)), angular_velocity=Omega, t=0.0, works=True)
        return li.schemes.torqued_midpoint(body), state

    noise = jax.random.normal(jax.random.key(seed), (members, 4, 3)).at[0].set(0.0)
    satellites, states = jax.jit(jax.vmap(member))(noise)
    run = li.run(satellites, states, 2.0, steps, save_every=20, own_step=True, store=store, resume=resume, epoch=date)
    extra, t, to_nadir = run.state.extra or {}, np.asarray(run.t), jnp.array([0.0, 0.0, 1.0])
    works, H = np.asarray(extra["works"]), np.asarray(run.map(lambda step, z: step.system.energy(z)))
    rate = np.rad2deg(li.measure.rotation_rates(run))
    nadir = np.rad2deg(li.measure.tilt(run, direction=lambda t: so3.Ad(frame(t), to_nadir)))
    wheels = 1e3 * np.linalg.norm(np.asarray(extra["wheels"]) @ np.asarray(WHEELS), axis=-1)
    slow, captured = li.measure.first_below(t, rate, SLOW), li.measure.captured_since(t, nadir, CAPTURED)
    rows = [
        li.report.Row("rate at the end (°/s)", rate[-1]),
        li.report.Row("z axis from the nadir at the end (°)", nadir[-1]),
        li.report.Row(f"first slower than {SLOW:g} °/s (s)", slow, digits=".0f"),
        li.report.Row(f"within {CAPTURED:g}° of the nadir since (s)", captured, digits=".0f"),
        li.report.Row("largest momentum of the wheels (mN m s)", wheels.max(axis=0)),
        li.report.Row("momentum of the wheels at the end (mN m s)", wheels[-1]),
    ]
    left, size = H - works.sum(axis=-1), abs(H).max(axis=0)
    changed = [li.report.Change("energy less the work of all laws", left, size, "conserved to round-off")]
    series = {"rate (°/s)": rate, "z axis from the nadir (°)": nadir, "momentum of the wheels (mN m s)": wheels}
    by_law = dict(zip(laws(jnp.diag(INERTIA), DIPOLE), np.moveaxis(works, -1, 0), strict=True))
    remarks = phase_lines(t, series, H, by_law)
    k = (nadir[-1] <= CAPTURED).sum()
    p = (k + 0.5) / (members + 1)  # of Jeffreys' posterior, Beta(k + ½, n − k + ½): its error is not 0 for k = n
    share = f"({100 * k / members:.2f} ± {100 * np.sqrt(p * (1 - p) / (members + 2)):.2f}) % of all starts"
    remarks.append(f"  at the end within {CAPTURED:g}° of the nadir: {k} of {members}, {share}")
    spread = "attitude {:g}°, angular velocity {:g}°/s, second moments of mass {:g} of them, residual dipole {:g} A m²"
    spread = spread.format(*SPREAD.values())
    print(li.report.text(TITLE, run, rows, changed=changed, remarks=remarks, spread=spread, error=int(error)))
    if pictures:
        drawn = li.plots.save(draw(t, series), out.with_name(f"{out.stem}-phases.png"))
        print("pictures:", *drawn, *li.plots.overview(run, out, TITLE))


def phase_lines(t, series, H, works):
    """The median and the greatest of series of the members at the end of each phase, and the mean work of each law."""
    edges = np.searchsorted(t, [*(x for x in BEGINS.values() if x < t[-1]), t[-1]])
    parts = dict(zip(BEGINS, itertools.pairwise(edges), strict=False))
    rows = {"phase": parts, "until (s)": [f"{t[b]:.0f}" for _, b in parts.values()]}
    for name, x in series.items():
        rows[f"{name}, median, largest"] = [f"{np.median(x[b]):.3f}  {x[b].max():.3f}" for _, b in parts.values()]
    for name, x in (works | {"change of energy": H}).items():
        rows[f"work (µJ), mean: {name}"] = [f"{1e6 * np.mean(x[b] - x[a]):.4f}" for a, b in parts.values()]
    braked = np.all(np.diff(works["B-dot"], axis=0) <= 0, axis=0)
    return [
        "",
        *(f"  {name:<50}{''.join(f'{cell:>25}' for cell in cells)}" for name, cells in rows.items()),
        f"  detumbling never raised the energy between two saved times: {braked.sum()} of {braked.size} starts",
    ]


@li.plots.style()
def draw(t, series):
    """Plot rates, angles and momenta of the wheels of the first hundred members; the nominal one in black."""
    fig, [axes] = li.plots.figure(3)
    for ax, (label, values) in zip(axes, series.items(), strict=True):
        li.plots.member_series(ax, t / 3600, values, label, "h")
        for begin in [x for x in BEGINS.values() if 0 < x < t[-1]]:
            ax.axvline(begin / 3600, color=li.plots.GRAY, ls=":")
    axes[0].set_yscale("log")
    axes[1].set(ylim=(0, 180), yticks=range(0, 181, 30))
    fig.suptitle(f"{TITLE}: {', then '.join(BEGINS)}")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
