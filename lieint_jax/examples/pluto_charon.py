"""Pluto and Charon become locked: tides lead to the double synchronous state.

Both bodies start with their present angular momentum on an orbit inside the present one; Charon is locked, and Pluto
has the rest. In the end each always shows the other the same face. The lags are far too large: they determine the
duration of the evolution, 55 years here, but not its final state. Units are km, kg and d.
"""

from pathlib import Path

import jax
import numpy as np

import lieint_jax as li

TITLE = "Pluto and Charon become locked"
DAY = 86400.0  # s
G = 6.6743e-20 * DAY**2  # km³/(kg d²)
TERAWATT = 1e6 * DAY**3  # kg km²/d³
MASSES, RADII = np.array([1.3025e22, 1.5875e21]), np.array([1188.3, 606.0])  # kg, km, of Pluto and Charon
MOMENTS = np.array([0.33, 0.38]) * MASSES * RADII**2  # kg km²; 0.4 would be that of homogeneous balls
LOVE_NUMBERS = np.array([0.06, 0.005])
DISTANCE, PERIODS = 16000.0, np.array([15.9404765, 113.107712]) / 24  # km; d, sidereal
BROZOVIC = "Brozović, Showalter, Jacobson & Buie 2015, Icarus 246, 317"


def main(
    steps: int = 1_000_000,
    pluto_lag: float = 1.8e8,
    charon_lag: float = 2.0e7,
    out: Path | None = None,
    resume: bool = False,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate both bodies until they are locked, and compare the final orbit with the present one.

    Args:
        steps: the number of steps of 0.02 d, a multiple of 10 000.
        pluto_lag: that of the tides on Pluto in s, an assumption; above 0.
        charon_lag: that of the tides on Charon in s, an assumption.
        out: the store of the run; by default pluto_charon.zarr, or pluto_charon-2.zarr where that exists.
        resume: continue the run in `out`.
        pictures: draw the distance, the angular rates, and the errors.
        certificate: measure what the scheme conserves.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("pluto_charon.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "d")
    lags = np.array([pluto_lag, charon_lag]) / DAY
    law, gravity = li.tides.constant_lag(G, MASSES, RADII, LOVE_NUMBERS, lags), li.potentials.point_masses(G, MASSES)
    bodies = li.systems.rigid_bodies(MASSES, np.tile(MOMENTS[:, None], 3), gravity, law)
    shares = np.array([-MASSES[1], MASSES[0]])[:, None] / MASSES.sum()  # about the barycenter
    state = bodies.state(
        shares * [DISTANCE, 0.0, 0.0],
        velocities=shares * [0.0, np.sqrt(G * MASSES.sum() / DISTANCE), 0.0],
        angular_velocities=2 * np.pi / PERIODS[:, None] * [0.0, 0.0, 1.0],
    )
    step = li.schemes.bodies_energy_momentum(bodies)
    run = li.run(step, state, 0.02, steps, save_every=10_000, store=store, resume=resume)
    q, p, spent = (np.asarray(x) for x in (run.state.q, run.state.p, run.state.work))
    distance, spins = np.linalg.norm(q[:, 1, :3] - q[:, 0, :3], axis=-1), p[..., 5] / MOMENTS
    orbital = np.cross(q[..., :3], p[..., :3])[..., 2].sum(axis=-1)
    energy, *momenta = li.report.changes(run)
    changed = [energy._replace(name="energy H plus the energy lost"), *momenta]
    # A circle with the orbit's momentum; the distance oscillates about it, by the eccentricity.
    GM, specific = G * MASSES.sum(), orbital[-1] * MASSES.sum() / MASSES.prod()
    circle, period = specific**2 / GM, 2 * np.pi * specific**3 / GM**2
    locked, row = li.tides.double_synchronous(G, MASSES, MOMENTS.sum(), float(momenta[1].values[0, 2])), li.report.Row
    published = li.report.Published(19596.0, 0.2, BROZOVIC), li.report.Published(6.387222, source=BROZOVIC)
    rows = [
        row("distance at the end (km)", distance[-1]),
        row("of a circle with the orbit's angular momentum (km)", circle),
        row("rotation periods over that of this circle, 1st", 2 * np.pi / spins[-1, 0] / period, digits=".9f"),
        row("and 2nd", 2 * np.pi / spins[-1, 1] / period, digits=".9f"),
        row("power lost (TW)", (spent[0] - spent[-1]) / run.t[-1] / TERAWATT),
        row("closed form: both locked at (km)", locked.distance, published[0]),
        row("with the period (d)", locked.period, published[1], digits=".8f"),
    ]
    least = -np.diff(spent).max() / abs(spent[-1])
    remarks = [f"  least loss between two saved states, over all of it: {least:.1e}"]
    print(li.report.text(TITLE, run, rows, changed=changed, remarks=remarks))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        figure = draw_course(
            np.asarray(run.t), distance, spins, locked.distance, energy.values, momenta[1].values[..., 2]
        )
        print("pictures:", *li.plots.save(figure, out.with_name(f"{out.stem}-course.png")))


@li.plots.style()
def draw_course(t, distance, spins, locked, H, L):
    """Plot the distance, the angular rates, and the balances of energy and angular momentum."""
    fig, [[left, middle, right]] = li.plots.figure(3)
    fig.suptitle(TITLE)
    li.plots.series(left, t, {"": distance}, "distance (km)", "d")
    left.axhline(locked, color=li.plots.RED, lw=0.7, ls="--", zorder=3, label="both locked, closed form")
    left.legend(loc="center right")
    left.set_title("distance of the centers")
    orbit = np.sqrt(G * MASSES.sum() / distance**3)
    rates = {"rotation, Pluto": spins[:, 0], "rotation, Charon": spins[:, 1], "orbit": orbit}
    li.plots.series(middle, t, rates, "angular rate (rad/d)", "d")
    middle.set_title("angular rates")
    balances = {"angular momentum L": L / L[0] - 1, "energy H plus the energy lost": H / H[0] - 1}
    li.plots.log_error(right, t, balances, "relative change", "d")
    right.set_title("balances")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
