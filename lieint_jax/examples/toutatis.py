"""4179 Toutatis, a tumbling asteroid: 800 days, compared with published periods and a radar attitude.

A small asteroid that rotates freely about no principal axis. It was observed by radar at every close approach since
1992, and by Chang'e-2 in 2012. Times are in days; the axes of space are those of the ecliptic, J2000.
"""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "4179 Toutatis, a tumbling asteroid"
ZHAO = "Zhao et al. 2015, arXiv 1504.02024"
TAKAHASHI = "Takahashi, Busch & Scheeres 2013, AJ 146:95"
INERTIA = (3.0836, 3.235, 1.0)  # principal moments over that of the long axis, z [TAKAHASHI]
START = {  # 1992-11-09 17:49:47 UTC: Euler angles 3-1-3 (°), body to space, and angular velocity in the body (°/d)
    "zhao": ((147.5, 63.9, 241.5), (14.5, 33.7, -98.5)),  # identified by its angular momentum
    "takahashi": ((145.498, 65.865, 241.524), (14.51, 33.529, -98.709)),
}
# No uncertainty is published with these states. This spread makes the precession period about as uncertain as the
# published one, the rotation period half as uncertain, and the direction of the angular momentum somewhat more.
SPREAD = (0.3, 0.25)  # 1σ of each component: attitude (°), angular velocity (°/d)
RADAR_TIME = 23.159873  # d: 1992-12-02 21:40 UTC
RADAR = ((122.2, 86.5, 107.0), (-35.6, 7.2, -97.0))  # Euler angles 3-1-3 (°), angular velocity (°/d) [TAKAHASHI]
SAVE_EVERY = 160
DT = RADAR_TIME / 4640  # d: the radar attitude is a saved state, number RADAR_SAVE
RADAR_SAVE = 4640 // SAVE_EVERY
PUBLISHED = {  # momentum published as 180.2 +0.2/−0.3 and −54.75 +0.15/−0.10; the larger errors are used here
    "precession period (d)": li.report.Published(7.40, 0.03, ZHAO),
    "rotation period (d)": li.report.Published(5.38, 0.03, ZHAO),
    "angular momentum longitude (°)": li.report.Published(180.2, 0.3, ZHAO),
    "angular momentum latitude (°)": li.report.Published(-54.75, 0.15, ZHAO),
}


def main(
    members: int = 1000,
    steps: int = 160_320,
    start: Literal["zhao", "takahashi"] = "zhao",
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1992,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the asteroid and compare it with what was published.

    Args:
        members: the number of initial states; the first is the published one.
        steps: the number of steps of 1/200 day, a multiple of 160.
        start: which published state is the initial one.
        out: the store of the run; by default toutatis.zarr, or toutatis-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the path of the long axis, and errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("toutatis.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "d")
    body = li.systems.rigid_body(INERTIA)
    step = li.schemes.so3_midpoint(body, li.maps.kappa_symplectic)
    angles, rate = np.deg2rad(START[start])
    q, noise = li.attitude.from_euler("ZXZ", angles), jax.random.normal(jax.random.key(seed), (members, 2, 3))

    def state(noise):
        turn, change = jnp.deg2rad(jnp.array(SPREAD))[:, None] * noise
        attitude = li.groups.so3.multiply(li.groups.so3.exp(turn), q)
        return body.state(attitude, angular_velocity=rate + change)

    states = jax.jit(jax.vmap(state))(noise.at[0].set(0.0))
    run = li.run(step, states, DT, steps, save_every=SAVE_EVERY, store=store, resume=resume)
    values = [*li.measure.tumbling_periods(run)[:2], *(np.rad2deg(angle[0]) for angle in li.measure.pole(run))]
    rows = [
        li.report.Row(name, x, published, angle="(°)" in name)
        for (name, published), x in zip(PUBLISHED.items(), values, strict=True)
    ]
    seen = len(run.t) > RADAR_SAVE
    print(
        li.report.text(
            TITLE,
            run,
            rows,
            remarks=radar_remarks(run) if seen else (),
            spread="attitude {:g}°, angular velocity {:g}°/d".format(*SPREAD),
        )
    )
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_path(run), out.with_name(f"{out.stem}-path.png"))
        drawn += li.plots.save(draw_invariants(run), out.with_name(f"{out.stem}-invariants.png"))
        print("pictures:", *drawn)


def radar_remarks(run):
    """The attitude and rate that were observed by radar next to the predicted ones, with the sizes of errors."""
    so3, body = li.groups.so3, run.system
    one = run.member(0)
    start, now = (jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), one.state) for k in (0, RADAR_SAVE))
    observed = li.attitude.from_euler("ZXZ", np.deg2rad(RADAR[0]))
    true = body.solution(start, RADAR_TIME)  # in closed form
    members = np.rad2deg(jax.vmap(so3.angle, (0, None))(jnp.asarray(run.state.q[RADAR_SAVE]), now.q))
    misfit, own = (float(np.rad2deg(so3.angle(now.q, q))) for q in (observed, true.q))
    angles, rate = np.rad2deg(li.attitude.to_euler("ZXZ", now.q)) % 360, np.rad2deg(body.angular_velocity(now))
    row = "    {}      predicted ({:8.2f}, {:8.2f}, {:8.2f})   observed ({:8.2f}, {:8.2f}, {:8.2f})".format
    return [
        f"\n  radar, 1992-12-02 21:40 UTC: t = {RADAR_TIME:g} d   [{TAKAHASHI}]",
        row("Euler 3-1-3 (°)", *angles, *RADAR[0]),
        row("body rate (°/d)", *rate, *RADAR[1]),
        f"    angle between attitudes predicted and observed: {misfit:.2f}°; members about the nominal one: "
        f"{np.sqrt(np.mean(members**2)):.2f}° rms; the integrator's own error: {own:.2g}°",
        "    (torque-free: the angle includes errors of the initial state and the observation, and omitted torques)",
    ]


@li.plots.style()
def draw_path(run):
    """Map the direction of the long axis in space: its path, and where it was by all members and by radar."""
    plots, last = li.plots, min(RADAR_SAVE, len(run.t) - 1)
    fig, [[ax]] = plots.figure(size=(7.0, 4.2), subplot_kw={"projection": "mollweide"})
    times = np.linspace(0.0, run.t[last], 4000)
    pole = np.asarray(run.state.p[0, :1] / np.linalg.norm(run.state.p[0, 0]))
    center = 30 * np.round(np.rad2deg(np.arctan2(pole[0, 1], pole[0, 0])) / 30)
    plots.sky(ax, center)
    path = long_axis(run.member(0).at(times).q)
    plots.sky_path(ax, path, f"long axis, nominal member, to t = {times[-1]:.4g} d", center, color=plots.BLUE, lw=0.8)
    plots.sky_points(ax, long_axis(run.state.q[last]), "all members then", center, color=plots.INK, zorder=3)
    plots.sky_points(ax, pole, "angular momentum", center, color=plots.GREEN, marker="P", s=45, zorder=3)
    if last == RADAR_SAVE:
        observed = long_axis(li.attitude.from_euler("ZXZ", np.deg2rad(RADAR[0]))[None])
        plots.sky_points(ax, observed, "observed then", center, color=plots.RED, marker="x", s=60, lw=1.6, zorder=4)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
    ax.set(xlabel="ecliptic longitude", ylabel="ecliptic latitude", title="4179 Toutatis")
    return fig


@li.plots.style()
def draw_invariants(run):
    """Plot the errors of energy and of the symplectic form along the nominal member, and its polhode."""
    one = run.member(0)
    body, state, t = one.system, jax.tree.map(lambda x: x[0], one.state), np.asarray(one.t)
    fig, [axes] = li.plots.figure(3)
    fig.suptitle("4179 Toutatis")
    li.plots.log_error(
        axes[0], t, {"": np.asarray(one.energy_error() / body.energy(state))}, "relative energy error", "d"
    )
    n = 20 * SAVE_EVERY
    sigma = jax.jit(lambda z: li.diagnostics.poisson_error(one.step, z, DT, n))(state)
    size = np.linalg.norm(jax.vmap(li.groups.so3.vee)(sigma), axis=1)
    li.plots.log_error(axes[1], DT * np.arange(len(size)), {"": size}, "Poisson error |σ|", "d")
    times = np.linspace(0.0, min(60.0, t[-1]), 4000)
    x, y, _ = np.asarray(jax.vmap(body.body_momentum)(one.at(times)).T) / np.linalg.norm(state.p)
    axes[2].plot(x, y, lw=0.8, color=li.plots.BLUE)
    axes[2].set(aspect="equal", xlabel="Π₁ / |Π|", ylabel="Π₂ / |Π|", title="polhode, seen along the long axis")
    return fig


def long_axis(q):
    """The directions in space of the body axis z, (n, 3), at attitudes (n, 4)."""
    return np.asarray(jax.vmap(li.groups.so3.Ad, (0, None))(jnp.asarray(q), jnp.array([0.0, 0.0, 1.0])))


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
