"""4179 Toutatis, a fit: spin state and inertia from 17 radar fixes, and what they predict.

Eight parameters (attitude, body rate, two ratios of inertia) and two noise levels are fitted to the attitudes and body
rates of 1992. They were published without errors, and some are far from any solution: the errors are modeled by
Student's t, whose tails make the fit robust against outliers. The reported errors are tested on synthetic data. Members
drawn from the fit show that it cannot predict the later fixes: their attitudes spread over all angles.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

inference, tumbling, so3 = li.fitting.inference, li.fitting.tumbling, li.groups.so3
TITLE = "4179 Toutatis, a tumbling asteroid"
ZHAO = "Zhao et al. 2015, arXiv 1504.02024"
TAKAHASHI = "Takahashi, Busch & Scheeres 2013, AJ 146:95"
HUDSON_OSTRO = "Hudson & Ostro 1995, Science 270:84"
FITTED, MIDDLE = 17, 8  # number of fixes of 1992; index of the middle one, the epoch of the parameters
EPOCH = np.datetime64("1992-11-09T17:49:47")  # UTC, of the published states
STATES = {  # Euler angles 3-1-3 (°), body to space, and angular velocity in the body (°/d), at EPOCH
    "Zhao": ((147.5, 63.9, 241.5), (14.5, 33.7, -98.5)),
    "Takahashi": ((145.498, 65.865, 241.524), (14.51, 33.529, -98.709)),
}
INERTIA = (3.0836, 3.235, 1.0)  # principal moments over that of the long axis, z [TAKAHASHI]
CHANGE_2 = ("2012-12-13T08:30", (-20.1, 27.6, 42.2))  # by Chang'e-2, each ± 1° [ZHAO]; the angles are as the radar's
QUANTITIES = (
    *("precession period (d)", "rotation period (d)", "momentum, longitude (°)", "momentum, latitude (°)"),
    *("inertia ratio Jx/Jz", "inertia ratio Jy/Jz", "Euler angle α (°)", "Euler angle β (°)", "Euler angle γ (°)"),
    *("body rate x (°/d)", "body rate y (°/d)", "body rate z (°/d)"),
)
PUBLISHED = (  # momentum published as 180.2 +0.2/−0.3 and −54.75 +0.15/−0.10; the larger errors are used here
    *((QUANTITIES[0], 7.40, 0.03, ZHAO), (QUANTITIES[1], 5.38, 0.03, ZHAO), (QUANTITIES[2], 180.2, 0.3, ZHAO)),
    *((QUANTITIES[3], -54.75, 0.15, ZHAO), (QUANTITIES[0], 7.35, 0.0, HUDSON_OSTRO)),
    (QUANTITIES[1], 5.41, 0.0, HUDSON_OSTRO),
)
FAR = 18.8  # |e|²/σ² of outliers: any of 34 normal vectors of three components exceeds it with a probability of 0.01


def main(sets: int = 100, members: int = 1000, out: Path | None = None, pictures: bool = True) -> None:
    """Fit the spin state, test its errors, and compare it with published states and later fixes.

    Args:
        sets: the number of synthetic data sets that enlarge the errors, and of those that test them.
        members: the number of states drawn from the fit for the prediction.
        out: the picture; by default toutatis_fit.png, or toutatis_fit-2.png where that exists.
        pictures: draw the mean periods.
    """
    jax.config.update("jax_enable_x64", True)
    dates, t, epoch, q, rate = fixes()
    data = {"begin": q[MIDDLE], "epoch": epoch, "q": q[:FITTED], "rate": rate[:FITTED], "t": t[:FITTED]}
    data = jax.tree.map(jnp.asarray, data)
    given = {name: published_params(*state, data) for name, state in STATES.items()}
    problem = spin_problem(data, given["Takahashi"])

    # from a published state, and from random ones about it; at a tolerance of 1e-9 the predictions are 0.5° off
    random = inference.random_starts(problem, 2 * sets - 1, 17)
    starts = jax.tree.map(lambda first, others: jnp.concatenate([first[None], others]), problem.guess, random)
    repeated = inference.repeat(data, 2 * sets)
    fits = inference.fit_starts(problem, starts, repeated, tolerance=1e-13)
    fitted = jax.tree.map(lambda x: x[0], inference.estimates(problem, fits, repeated, which=[0]))
    factors, test = inference.calibrate_errors(problem, fitted, sets, seed=1992)
    fitted = inference.enlarge_errors(fitted, factors[0])

    squares = np.sum(errors(problem.unravel(fitted.x), data) ** 2, axis=-1)
    is_far = (squares > FAR * fitted.noise[:, None] ** 2).any(axis=0)
    level = fitted.noise * li.fitting.student_t_noise_error(FITTED, 3) * factors[1]
    share = 100 * np.mean(np.abs(fits.starts.loss[1:] - fits.starts.loss[0]) < 1e-4)
    one, two, scatter = inference.shares(test.pulls[:, :8], None)
    values = {name: np.asarray(derived(params, data)) for name, params in given.items()}
    lines = [
        f"{TITLE}: spin state and inertia from {FITTED} radar fixes of 1992\n  fixes: {TAKAHASHI}, without errors",
        f"  {fits.outcome}; {share:.0f} % of {2 * sets - 1} random starts end there",
        f"  noise, the scale of Student's t with {li.fitting.DEGREES_OF_FREEDOM:g} degrees of freedom: attitudes "
        f"{fitted.noise[0]:.2f} ± {level[0]:.2f}°, rates {fitted.noise[1]:.2f} ± {level[1]:.2f} °/d",
        f"  outliers in attitude or rate: {', '.join(dates[k][:10] for k in np.flatnonzero(is_far))}",
        *value_lines(fitted, values),
        *prediction_lines(problem, fitted, dates[FITTED:], t[FITTED:], q[FITTED:], members),
        f"\n  errors: enlarged by {factors[0]:.3f} (noise: {factors[1]:.3f}), the ratio of scatter to error in {sets} "
        f"synthetic sets;\n  in {sets} others ({test.success.sum()} fits succeeded) {one:.1f} % of the parameters are "
        f"within 1σ of the truth\n  (expected: 68.3), {two:.1f} % within 2σ (95.4), and rms/σ is {scatter:.2f}",
    ]
    print("\n".join(lines))
    if pictures:
        print("pictures:", *li.plots.save(draw(fitted, values), out or li.report.new_path("toutatis_fit.png")))


def fixes():
    """Dates, days of them and of EPOCH from the middle fix, attitudes, (20, 4), body rates (°/d, by radar), (19, 3)."""
    lines = Path(__file__).with_name("toutatis_radar.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line[0].isdigit()]
    numbers = np.array([row[1:] for row in rows], float)
    dates = [*(row[0] for row in rows), CHANGE_2[0]]
    days = (np.array([*dates, EPOCH], "datetime64[s]") - np.datetime64(dates[MIDDLE])) / np.timedelta64(1, "D")
    q = jax.vmap(so3.from_euler_313)(jnp.deg2rad(np.vstack([numbers[:, :3], CHANGE_2[1]])))
    return dates, days[:-1], days[-1], np.asarray(q), numbers[:, 3:]


def spin_problem(data, guess):
    """The fit to fixes; its random starts are about a guess."""
    unknowns = {
        "attitude": inference.Unknown(("attitude x", "attitude y", "attitude z"), guess["attitude"], scatter=10.0),
        "inertia": inference.Unknown(("Jx/Jz", "Jy/Jz"), guess["inertia"], li.fitting.inertia_ratios, 0.15),
        "rate": inference.Unknown(("rate x", "rate y", "rate z"), guess["rate"], scatter=5.0),
    }
    noise = inference.StudentT((8.0, 8.0), 0.01, 100.0)  # °, °/d: first guess, bounds
    return inference.Problem(unknowns, errors, data, noise, derived=derived, quantities=QUANTITIES, simulate=simulate)


def published_params(angles, rate, data):
    """A published state at the middle fix, as parameters of `li.fitting.tumbling.model`."""
    body = li.systems.rigid_body(INERTIA)
    state = body.state(so3.from_euler_313(jnp.deg2rad(jnp.array(angles))), angular_velocity=np.deg2rad(rate))
    later = body.solution(state, -data["epoch"])
    attitude, rate = tumbling.rotation_between(later.q, data["begin"]), jnp.rad2deg(body.angular_velocity(later))
    return {"attitude": attitude, "inertia": body.inertia[:2], "rate": rate}


@li.fitting.member_by_member
@jax.jit
def path(params, data):
    """Attitudes and body rates (°/d), (n, 7), at data["t"], (n,), in closed form."""
    body, state = tumbling.model(params, data["begin"])

    def spin_at(t):
        later = body.solution(state, t)
        return jnp.concatenate([later.q, jnp.rad2deg(body.angular_velocity(later))])

    return jax.lax.map(spin_at, data["t"])


def errors(params, data):
    """Calculated less observed: rotation vectors in space (°) and body rates (°/d), (2, n, 3)."""
    found = path(params, data)
    return jnp.stack([jax.vmap(tumbling.rotation_between)(found[:, :4], data["q"]), found[:, 4:] - data["rate"]])


def derived(params, data):
    """`QUANTITIES`, (12,): the Euler 3-1-3 angles and the body rate are those at the published epoch."""
    body, state = tumbling.model(params, data["begin"])
    start = path(params, data | {"t": data["epoch"][None]})[0]
    euler, (x, y, z) = jnp.rad2deg(so3.to_euler_313(start[:4])) % 360, state.p
    pole = jnp.rad2deg(jnp.stack([jnp.arctan2(y, x) % (2 * jnp.pi), jnp.arctan2(z, jnp.hypot(x, y))]))
    return jnp.concatenate([tumbling.mean_periods(body, state), pole, params["inertia"], euler, start[4:]])


def simulate(params, data, noise):
    """The fixes of a model, rotated and changed by noise, (2, n, 3)."""
    found = path(params, data)
    return data | {"q": jax.vmap(tumbling.rotate)(noise[0], found[:, :4]), "rate": found[:, 4:] + noise[1]}


def value_lines(fitted, given):
    """The fitted values next to those of the published states, and to published values."""
    value, sigma, pull = fitted.values[8:], fitted.sigmas[8:], inference.pull
    lines = [f"\n  {'at 1992-11-09 17:49:47 UTC':<30}{'fitted':>7}{'± 1σ':>9}{'Zhao':>12}{'Takahashi':>18}"]
    for name, x, error, *states in zip(QUANTITIES, value, sigma, *given.values(), strict=True):
        cells = "".join(f"{y:12.3f}{pull(name, x, error, y):+5.1f} σ" for y in states)
        lines.append(f"  {name:<26}{x:11.3f}{error:9.3f}{cells}")
    lines.append("\n  published values:")
    for name, x, error, source in PUBLISHED:
        k, words = QUANTITIES.index(name), f"{x:g} ± {error:g}" if error else f"{x:g}"
        lines.append(f"    {name:<24}{words:<16}{pull(name, value[k], sigma[k], x, error):+5.1f} σ   {source}")
    return lines


def prediction_lines(problem, fitted, dates, t, q, members):
    """Angles between later fixes q, at times t, and the torque-free motions of the fit and of members drawn from it."""
    x, at_fixes = np.stack([fitted.x, *inference.draw_members(fitted, members, 2004)]), {"t": jnp.asarray(t)}
    found = inference.predict(problem, lambda params: path(params, problem.data | at_fixes)[:, :4], x)
    angles = np.rad2deg(jax.vmap(jax.vmap(so3.angle), (None, 0))(q, found))
    lines = [f"\n  {'torque-free prediction: angle from the fix (°)':<48}{'fitted':>8}{'members, 5 to 95 %':>22}"]
    for date, angle, low, high in zip(dates, angles[0], *np.percentile(angles[1:], (5, 95), axis=0), strict=True):
        lines.append(f"    {date[:10]:<46}{angle:8.1f}{f'{low:.0f} to {high:.0f}':>22}")
    return lines


@li.plots.style()
def draw(fitted, given):
    """Plot the mean periods of the fit with their ellipses of 1σ and 2σ, and the published ones."""
    fig, [[ax]] = li.plots.figure()
    for radius in (1, 2):  # σ
        ax.plot(*inference.ellipse(fitted.derived[:2], fitted.derived_covariance[:2, :2], radius).T, li.plots.INK)
    for name, x in {"fitted": fitted.derived, **given}.items():
        ax.plot(x[0], x[1], "o", label=name)
    (_, x, dx, _), (_, y, dy, _) = PUBLISHED[:2]
    ax.errorbar(x, y, dy, dx, fmt="x", label="Zhao, as published")
    ax.plot(*(row[1] for row in PUBLISHED[4:]), "D", label="Hudson & Ostro")
    ax.set(xlabel=QUANTITIES[0], ylabel=QUANTITIES[1], title=TITLE)
    ax.legend(title="ellipses of 1σ and 2σ")
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
