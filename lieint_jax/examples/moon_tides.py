"""The Moon's recession: its rate, and the lengthening of the day, by tides with a lag of ten minutes.

The Moon raises tides on the Earth, whose rotation carries them ahead of the Moon; their pull widens its orbit and slows
the Earth. The orbit is a circle in the plane of the equator. The lag is the only number that was chosen; tides on the
Moon dissipate nothing, because it rotates synchronously. Units are km, kg and d.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "The Moon's recession"
DAY, YEAR = 86400.0, 365.25  # s, d
G = 6.6743e-20 * DAY**2  # km³/(kg d²)
TERAWATT = 1e6 * DAY**3  # kg km²/d³
MASSES, RADII = np.array([5.9722e24, 7.346e22]), np.array([6371.0, 1737.4])  # kg, km, of the Earth and the Moon
MOMENTS = np.array([0.3307, 0.393]) * MASSES * RADII**2  # kg km²; 0.4 would be that of homogeneous balls
LOVE_NUMBERS = np.array([0.3, 0.024])
DISTANCE, PERIODS = 384400.0, np.array([23.934472, 655.7199]) / 24  # km; d, sidereal
SPREAD = 0.05  # 1σ of the logarithm of the lag, an assumption
RANGING = "Williams & Boggs 2016, Celest. Mech. Dyn. Astron. 126, 89: lunar laser ranging, 38.30 mm a year"
RECESSION = li.report.Published(3.83, 0.01, RANGING)  # cm a year


def main(
    members: int = 8,
    steps: int = 4000,
    lag: float = 600.0,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1979,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate both bodies, and measure how fast the distance and the day grow.

    Args:
        members: the number of pairs of different lags; the first has the nominal one.
        steps: the number of steps of 1/4000 year, a multiple of 40.
        lag: that of the Earth's tides in s, above 0; by default Mignard's ten minutes.
        out: the store of the run; by default moon_tides.zarr, or moon_tides-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the lags of the members.
        pictures: draw the growth of the distance, the change of the rotations, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("moon_tides.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "d")

    def pair(noise):
        lags = jnp.array([lag / DAY, 0.0]) * jnp.exp(SPREAD * noise)
        law, gravity = (
            li.tides.constant_lag(G, MASSES, RADII, LOVE_NUMBERS, lags),
            li.potentials.point_masses(G, MASSES),
        )
        bodies = li.systems.rigid_bodies(MASSES, np.tile(MOMENTS[:, None], 3), gravity, law)
        shares = np.array([-MASSES[1], MASSES[0]])[:, None] / MASSES.sum()  # about the barycenter
        state = bodies.state(
            shares * [DISTANCE, 0.0, 0.0],
            velocities=shares * [0.0, np.sqrt(G * MASSES.sum() / DISTANCE), 0.0],
            angular_velocities=2 * np.pi / PERIODS[:, None] * [0.0, 0.0, 1.0],
        )
        return li.schemes.bodies_energy_momentum(bodies), state

    noise = jax.random.normal(jax.random.key(seed), (members,)).at[0].set(0.0)
    made, states = jax.jit(jax.vmap(pair))(noise)
    run = li.run(made, states, YEAR / 4000, steps, save_every=40, own_step=True, store=store, resume=resume)
    q, p, spent = (np.asarray(x) for x in (run.state.q, run.state.p, run.state.work))
    distance, spins = np.linalg.norm(q[..., 1, :3] - q[..., 0, :3], axis=-1), p[..., 5] / MOMENTS
    orbital = np.cross(q[..., :3], p[..., :3])[..., 2].sum(axis=-1)
    energy, *momenta = li.report.changes(run)
    changed = [energy._replace(name="energy H plus the energy lost"), *momenta]
    # A circle with the orbit's momentum; the distance oscillates about it, by the eccentricity.
    GM, specific, t = G * MASSES.sum(), orbital[-1] * MASSES.sum() / MASSES.prod(), float(run.t[-1])
    circle, period, days = specific**2 / GM, 2 * np.pi * specific**3 / GM**2, 2 * np.pi / spins
    # By the orbit's gain of momentum, L ∝ √a: accurate to 1e-3, the rounding of the Earth's rate over its change.
    growth = 2 * DISTANCE * (MOMENTS * (spins[0] - spins[-1])).sum(axis=-1) / orbital[0] * YEAR / t
    locked, row = (
        li.tides.double_synchronous(G, MASSES, MOMENTS.sum(), float(momenta[1].values[0, 0, 2])),
        li.report.Row,
    )
    rows = [
        row("distance at the end (km)", distance[-1]),
        row("of a circle with the orbit's angular momentum (km)", circle),
        row("rotation periods over that of this circle, 1st", days[-1, :, 0] / period, digits=".9f"),
        row("and 2nd", days[-1, :, 1] / period, digits=".9f"),
        row("power lost (TW)", (spent[0] - spent[-1]) / t / TERAWATT, digits=".7f"),
        row("distance grows (cm a year)", 1e5 * growth, RECESSION, digits=".7f"),
        row(
            "rotation of the first body slows (ms a century)",
            (days[-1] - days[0])[:, 0] * 1e3 * DAY * 100 * YEAR / t,
            digits=".7f",
        ),
        row("closed form: both locked at (km)", locked.distance),
        row("with the period (d)", locked.period, digits=".7f"),
    ]
    least = -np.diff(spent, axis=0).max() / abs(spent[-1]).max()
    remarks = [f"  least loss between two saved states, over all of it: {least:.1e}"]
    spread = f"the lag {100 * SPREAD:g} %"
    print(li.report.text(TITLE, run, rows, changed=changed, remarks=remarks, spread=spread))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        H, L = energy.values[:, 0], momenta[1].values[:, 0, 2]
        figure = draw_course(np.asarray(run.t), distance[:, 0], spins[:, 0], H, L)
        print("pictures:", *li.plots.save(figure, out.with_name(f"{out.stem}-course.png")))


@li.plots.style()
def draw_course(t, distance, spins, H, L):
    """Plot the distance and the angular rates of the nominal member, and its balances."""
    fig, [[left, middle, right]] = li.plots.figure(3)
    fig.suptitle(TITLE)
    li.plots.series(left, t, {"": 1e5 * (distance - distance[0])}, f"growth from {distance[0]:g} km (cm)", "d")
    left.set_title("distance of the centers")
    orbit = np.sqrt(G * MASSES.sum() / distance**3)
    rates = {"rotation, Earth": spins[:, 0], "rotation, Moon": spins[:, 1], "orbit": orbit}
    li.plots.series(middle, t, {name: x / x[0] - 1 for name, x in rates.items()}, "relative change", "d")
    middle.set_title("angular rates")
    balances = {"angular momentum L": L / L[0] - 1, "energy H plus the energy lost": H / H[0] - 1}
    li.plots.log_error(right, t, balances, "relative change", "d")
    right.set_title("balances")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
