"""A tumbling satellite, a fit: spin state and inertia ratios from its light alone, with all symmetric solutions.

The object is simulated: a box with two panels in a graveyard orbit above the geostationary ring, near an equinox, seen
from the ground before and after it crosses the Earth's shadow. Its light has two periods. Many random bodies of these
periods are compared with the first session, and the best of them are fitted to it. The whole night is fitted from the
best results, from the images of the best one under every change of space or of body axes that may leave the light
unchanged, and, for synthetic data sets, from the truth. Times are in minutes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import lieint_jax as li

inference, tumbling, measure = li.fitting.inference, li.fitting.tumbling, li.measure
TITLE = "A tumbling satellite by irregular light"
INERTIA = (650.0, 1490.0, 1360.0)  # kg m², about x, the axis of the panels; y; and z, the normal of the panels
ATTITUDE, RATE = (0.6, 0.2, -0.5, 0.59160797831), (26.0, 15.0, 10.0)  # at t = 0; body rate in °/min
SUN = (0.0, 0.9856, 4.0)  # right ascension (°), its rate (°/d), declination (°): ten days from an equinox
OBSERVER = (-52.0, 360.9856, 5.2)  # seen from a site at 32° of latitude; 300 km above the ring the rate is 1 % less
FACES = (  # axis of the normal, area (m²), Lambert's albedo, height of the lobe on that scale, its exponent
    *((0, 3.6, 0.35, 0.4, 12.0), (1, 4.4, 0.25, 0.5, 10.0), (2, 3.0, 0.45, 0.3, 8.0)),  # the box
    *((2, 2.7, 0.1, 0.8, 12.0), (2, 2.7, 0.1, 0.8, 12.0)),  # the panels on +x and −x
)
SESSIONS = ((0.0, 145.0), (268.0, 413.0))  # min; the gap is the Earth's shadow, 70 min at most, and the time near it
CADENCE, JITTER, LOST = 1.25, 0.4, 0.15  # min, min, share of the exposures that clouds cover, in groups
NOISE = 0.03  # mag
BAND, SPECTRUM, HARMONICS = (0.01, 0.16), (0.005, 0.35), 6  # 1/min: of the pairs, of the sines; largest |j|, |k|
STEP = 0.75  # min
UNKNOWNS = {
    "attitude": inference.Unknown(("attitude x (°)", "attitude y (°)", "attitude z (°)"), (0.0, 0.0, 0.0)),
    "inertia": inference.Unknown(("inertia ratio Jx/Jz", "inertia ratio Jy/Jz"), (0.9, 1.1), li.fitting.inertia_ratios),
    "rate": inference.Unknown(("body rate x (°/min)", "body rate y (°/min)", "body rate z (°/min)"), (0.0, 0.0, 0.0)),
}
QUANTITIES = ("precession period (min)", "rotation period (min)")
SEARCH = {"tolerance": 1e-6, "iterations": 50}


def main(
    guesses: int = 100_000,
    starts: int = 1000,
    continued: int = 100,
    sets: int = 100,
    out: Path | None = None,
    seed: int = 8,
    pictures: bool = True,
) -> None:
    """Find the periods, fit the first session and the whole night, name the solutions and test the errors.

    Args:
        guesses: the number of random bodies that are compared with the first session.
        starts: the number of the best of them that are fitted to it.
        continued: the number of the best ends that are fitted to the whole night.
        sets: the number of synthetic data sets that test the errors.
        out: the picture; by default satellite_fit.png, or satellite_fit-2.png where that exists.
        seed: of the exposures, the noise and the guesses.
        pictures: draw the light with its minima, and the ends of the fits to the first session.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("satellite_fit.png")
    truth = {"attitude": np.zeros(3), "inertia": np.array(INERTIA[:2]) / INERTIA[2], "rate": np.array(RATE)}
    body, state = tumbling.model(truth, jnp.array(ATTITUDE))
    t, periods = exposures(seed), np.asarray(tumbling.mean_periods(body, state))
    noise = NOISE * np.asarray(jax.random.normal(jax.random.key(seed + 1), (1 + sets, len(t))))
    q, light = exact(body, state, t)
    observed, synthetic = light + noise[0], light + noise[1:]
    first, minima = t < SESSIONS[0][1], times_of_minima(body, state)
    print_scene(t, periods, minima)
    candidates = search_periods(t, observed, 1 / periods)

    # the first session, from the best of many guesses
    early = problem(t[first])
    guess = tumbling.random_guesses(candidates, guesses, jax.random.key(seed))[:2]
    squares = li.over_members(lambda params, begin: jnp.sum(early.errors(params, (begin, observed[first]))[0] ** 2))
    pieces = np.array_split(np.arange(guesses), -(-guesses // 10_000))
    chosen = np.concatenate([squares(*jax.tree.map(lambda x, k=k: x[k], guess)) for k in pieces]).argsort()[:starts]
    params, begin = jax.tree.map(lambda x: x[chosen], guess)
    found = inference.fit_starts(early, params, (begin, np.tile(observed[first], (starts, 1))), **SEARCH).starts
    ends, changes = spin_states(found.params, begin), measure.light_changes(facets(), *directions(t[first]))

    # the whole night, from the best ends, from the images of the best one, and for synthetic data from the truth
    order = np.argsort(found.loss)
    images = [change(ends.select(order[0])) for change in changes if change.symmetry == 0]
    true = spin_states(*jax.tree.map(lambda x: np.asarray(x)[None], (truth, state.q)))
    spins = [ends.select(order[:continued]), *images, *[true] * sets]
    begin, rate, J = (np.concatenate(leaves) for leaves in zip(*spins, strict=True))
    params = {"attitude": 0 * rate, "inertia": J[:, :2] / J[:, 2:], "rate": rate}
    whole, count = problem(t), continued + len(images)
    data = begin, np.concatenate([np.tile(observed, (count, 1)), synthetic])
    fit = inference.fit_starts(whole, params, data, **SEARCH)
    after, loss = spin_states(fit.starts.params, begin), fit.starts.loss[:count]
    best = int(np.argmin(loss))
    names = np.array([*(change.name for change in changes), "elsewhere"])  # the last one has the index −1
    ended, again = (names[measure.classify_light(x, after.select(best), changes)] for x in (ends, after))
    print_ends(names, found, ended, again[continued:count], loss[continued:])

    # what the changes in space do to the light; the best solution, the truth and synthetic sets
    middle = np.full(first.sum(), t[first.sum() // 2])
    effects = [measure.light_differences(facets(), q[: len(x)], *directions(x)) for x in (middle, t[first], t)]
    known = inference.Estimate.exact(ravel_pytree(truth)[0], periods)
    tested = inference.estimates(whole, fit, data, which=range(count, len(begin)))
    pulls = inference.compare(whole, known, tested, fit.starts.success[count:]).pulls[:, :8]
    own = jax.tree.map(lambda x: x[0], inference.estimates(whole, fit, data, which=[best]))
    turn = min((x for x in changes if x.name == names[0]), key=lambda x: x(true).distance(after.select(best))[0])
    near = turn(true)
    rotation = tumbling.rotation_between(jnp.asarray(near.q[0]), jnp.asarray(begin[best]))
    nearest = np.concatenate([rotation, near.inertia[0, :2] / near.inertia[0, 2], near.rate[0], periods])
    fitted = whole.unravel(own.x)
    model = jax.jit(lambda: magnitudes(fitted, begin[best], t)[0])()
    off = abs(model - exact(*tumbling.model(fitted, jnp.asarray(begin[best])), t)[1]).max() / NOISE
    the_truth = "the truth" if np.allclose(turn.g, np.eye(3)) else "the truth after a half turn of the body"
    print("\n  the largest change of the true motion's light over half turns of the body (mag, rms)")
    print(f"    {'':<22}{'in a fixed sky':>16}{'before the shadow':>19}{'whole night':>13}")
    for name, (fixed, early, late) in zip(measure.SPACE_CHANGES, np.transpose(effects), strict=True):
        print(f"    {name:<22}{fixed:16.1g}{early:19.2g}{late:13.2g}")
    print(f"\n  the best solution, χ² {2 * loss[best]:.1f} for {len(t) - 9} degrees of freedom, and {the_truth}")
    print(f"    {'':<26}{'fitted':>10}{'± 1σ':>9}{'truth':>10}{'off':>9}")
    for name, x, sigma, y in zip((*whole.names, *QUANTITIES), own.values, own.sigmas, nearest, strict=True):
        print(f"    {name:<26}{x:10.4f}{sigma:9.4f}{y:10.4f}{(x - y) / sigma:+7.2f} σ")
    (one, two, rms), chance = inference.shares(pulls, None), inference.chance_errors(sets)
    print(
        f"  errors in {sets} synthetic sets: {one:.0f} % within 1σ, {two:.0f} % within 2σ, rms/σ {rms:.2f}; of each of"
    )
    print("  the eight 68 ± {:.0f} %, 95 ± {:.0f} % and 1.00 ± {:.2f} are expected".format(*chance))
    print(f"  the scheme of order 6, in steps of {STEP} min, agrees with the closed form to {off:.2g} of the noise")
    if pictures:
        seen, fit_of_it = (t[first], observed[first]), model[first] + np.mean(observed - model)
        print("pictures:", *li.plots.save(draw(*seen, fit_of_it, minima, found.loss, ended), out))


def facets():
    """The satellite: every face with the opposite one, which for a panel is its back."""
    axis, *surface = np.repeat(FACES, 2, axis=0).T
    normals = np.eye(3)[axis.astype(int)] * np.tile([[1], [-1]], (len(FACES), 1))
    return li.shapes.GlossyFacets(jnp.asarray(normals), *surface)


def directions(t):
    """Unit vectors from the satellite to Sun and observer at times t (min), (…, 3) each."""

    def direction(ascension, rate, declination):
        a, d = jnp.deg2rad(ascension + rate * t / 1440), jnp.deg2rad(declination + 0 * t)
        return jnp.stack([jnp.cos(d) * jnp.cos(a), jnp.cos(d) * jnp.sin(a), jnp.sin(d)], axis=-1)

    return direction(*SUN), direction(*OBSERVER)


def magnitude(q, t):
    """The magnitude at an attitude and a time (min), with any zero point."""
    return -2.5 * jnp.log10(measure.glossy_brightness(facets(), q, *directions(t)))


@jax.jit
def exact(body, state, t):
    """Attitudes and magnitudes at times (n,), in closed form."""
    return jax.lax.map(lambda t: (q := body.solution(state, t).q, magnitude(q, t)), t, batch_size=256)


def magnitudes(params, begin, t):
    """The magnitudes of a fit at times (n,), and whether all steps converged.

    The derivatives of the scheme of order 6 in so many starts cost a tenth of those of the closed form.
    """
    body, state = tumbling.model(params, jnp.asarray(begin))
    path = li.integrate(li.schemes.preprocessed(body, 6), state, STEP, int(np.ceil(t[-1] / STEP)), save_at=t)
    return jax.vmap(magnitude)(path.state.q[1:], t), jnp.all(path.info.converged)


def problem(t):
    """The fit to magnitudes at times t; the data of a fit are its reference attitude and these magnitudes."""

    def errors(params, data):
        light, converged = magnitudes(params, data[0], t)
        error = (light - data[1]) / NOISE
        return error - jnp.mean(error), converged  # the zero point has its least-squares value

    def periods(params, data):
        return tumbling.mean_periods(*tumbling.model(params, data[0]))

    return inference.Problem(UNKNOWNS, errors, None, derived=periods, quantities=QUANTITIES)


def spin_states(params, begin):
    """The spin states of parameters of n fits with their reference attitudes, (n, 4)."""
    q = jax.vmap(tumbling.rotate)(jnp.asarray(params["attitude"]), jnp.asarray(begin))
    J = np.append(params["inertia"], np.ones((len(q), 1)), axis=1)
    return measure.SpinStates(np.asarray(q), np.asarray(params["rate"]), J / np.cbrt(J.prod(axis=1, keepdims=True)))


def exposures(seed):
    """Irregular times of exposures (min): a cadence with random shifts, and gaps by clouds."""
    t = np.concatenate([np.arange(begin, end, CADENCE) for begin, end in SESSIONS])
    shifts, clouds = (np.asarray(jax.random.uniform(k, (len(t),))) for k in jax.random.split(jax.random.key(seed)))
    thickness = np.convolve(clouds, np.ones(7) / 7, "same")  # smooth, so that exposures are lost in runs
    t = (t + JITTER * (2 * shifts - 1))[thickness <= np.quantile(thickness, 1 - LOST)]
    return np.sort(t) - t.min()


def times_of_minima(body, state):
    """The times of the minima of the light in the first session (min), as events of the motion."""

    def slope(state):
        moving = li.groups.so3.tangent(state.q, body.angular_velocity(state)), jnp.ones(())
        return jax.jvp(magnitude, (state.q, state.t), moving)[1]

    step, begin, steps = li.schemes.preprocessed(body, 6), state._replace(t=jnp.zeros(())), round(10 * SESSIONS[0][1])
    made = jax.jit(lambda z: li.runs.events(step, z, 0.1, slope, max_steps=steps, count=60, direction=-1))(begin)
    return np.asarray(made.t)[made.found]


def print_scene(t, periods, minima):
    """Print what is observed, and what is true."""
    phase = np.rad2deg(np.arccos(np.sum(np.prod(directions(t), axis=0), axis=1)))
    print(f"{TITLE}: all of it simulated")
    print(f"  {len(t)} exposures in {t[-1]:.0f} min, {(t < SESSIONS[0][1]).sum()} of them before the Earth's shadow;")
    print(f"  noise {NOISE} mag; phase angle {phase[0]:.0f}° to {phase.min():.0f}° to {phase[-1]:.0f}°")
    print("  mean periods, true: precession {:.4f} min, rotation {:.4f} min".format(*periods))
    print(f"  minima before the shadow: {len(minima)}, at {', '.join(f'{x:.3f}' for x in minima[:8])}, … min")
    print(
        f"  rate {np.linalg.norm(RATE) / 60:.2f}°/s, by choice; retired geostationary satellites tumble 'well below …"
    )
    print(
        "  one degree per second' (Binz, Davis, Kelm & Moore, Optical survey of the tumble rates of retired GEO",
        end=" ",
    )
    print("satellites, AMOS)", flush=True)


def search_periods(t, observed, true):
    """Print the search of the light for two frequencies, beside the true ones; return candidates for these, (n, 2)."""
    width = 1 / t[-1]
    sines = measure.sines(t, observed, np.arange(*SPECTRUM, width / 6), 10)
    named = [measure.combination(sine.frequency, true, HARMONICS, width) for sine in sines]
    good = [x for x in named if abs(x.difference) < width]
    even = sum(x.k % 2 == 0 for x in good)
    chance = 100 * measure.chance_of_match(measure.combinations(HARMONICS) @ true, *SPECTRUM, width)
    pairs = measure.double_periods(t, observed, *BAND, separation=0.004, count=10)
    (f, g), left = pairs.pairs[0], 100 * pairs.unexplained[0]
    candidates = measure.equivalent_pairs((f, g), *BAND) / np.array([1.0, 2.0])  # half a rotation has equal light
    a, b = candidates[abs(candidates - true).max(axis=1).argmin()]
    print(
        f"\n  {len(good)} of the 10 strongest sines are j f_precession + k f_rotation within {width:.4f} per min,",
        end=" ",
    )
    print(f"(j, k) =\n  {', '.join(f'({x.j}, {x.k})' for x in good)}; so are {chance:.0f} % of all frequencies.")
    print("  A tumbler's light has these combinations (Pravec et al. 2005, Icarus 173:108), and by the symmetry of")
    print(
        f"  the facets even k: {even} of them have it. {f:.5f} and {g:.5f} per min, the best pair for a double Fourier"
    )
    print(
        f"  series of order 2, leave {left:.1f} % of the variance. {len(candidates)} pairs (precession, rotation) would"
    )
    print(f"  give its combinations; 1/{1 / a:.2f} and 1/{1 / b:.2f} per min, one of them, is the true one up to")
    print(f"  {a - true[0]:+.5f} and {b - true[1]:+.5f} per min.", flush=True)
    return candidates


def print_ends(names, found, ended, again, loss):
    """Print where the fits to the first session ended, and how the named solutions fit the whole night."""
    print("\n  ends of the fits to the first session, and from images of the best one to the whole night, by their χ²")
    print(f"    {'':<26}{'starts':>8}{'first':>10}{'night':>10}")
    least = {x: [2 * y[z == x].min(initial=np.inf) for y, z in ((found.loss, ended), (loss, again))] for x in names}
    for name, (first, night) in least.items():
        if np.isfinite([first, night]).any():
            print(f"    {name:<26}{(ended == name).sum():8}{first:10.1f}{night:10.1f}".replace("inf", "  —"))
    left = sum(np.isinf(night) for name, (_, night) in least.items() if name != "elsewhere")
    shares = 100 * np.mean([ended == names[0], ended != "elsewhere"], axis=1)
    print("  {:.1f} % end at the true motion or one of equal light, {:.1f} % at a named one;".format(*shares))
    print(
        f"  {100 * found.success.mean():.0f} % of the fits succeeded; {left} of the {len(least) - 1} named solutions",
        end=" ",
    )
    print("are not minima on the whole night")
    more = np.subtract(least["mirror"], least[names[0]])
    print("  'At least two different observation geometries … are needed for a unique full solution' of a precessing")
    print("  body (Kaasalainen 2001, A&A 376:302). Here the mirror solution's χ² is", end=" ")
    print("{:.1f} higher before the shadow,\n  {:.1f} higher in the night.".format(*more), flush=True)


@li.plots.style()
def draw(t, observed, fitted, minima, loss, ended):
    """Plot the light of the first session with its fit and true minima, and the ends of all fits by their χ²."""
    plots = li.plots
    fig, [[left, right]] = plots.figure(2)
    left.plot(t, fitted, color=plots.BLUE, lw=0.8, label="best solution")
    left.plot(t, observed, ".", color=plots.INK, label="exposures")
    left.vlines(minima, *left.get_ylim(), color=plots.GRAY, lw=0.6, zorder=0, label="true minima")
    left.set(xlabel="t (min)", ylabel="magnitude, zero point unknown")
    left.invert_yaxis()
    rank, kinds = np.argsort(np.argsort(loss)) + 1, np.array([name.partition(",")[0] for name in ended])
    for kind, color in zip(("elsewhere", *measure.SPACE_CHANGES), (plots.GRAY, *plots.COLORS), strict=False):
        x, y = rank[kinds == kind], 2 * loss[kinds == kind] / len(t)
        right.loglog(x, y, ".", color=color, label=f"{kind} ({len(x)})")
    right.set(xlabel="start, by its χ²", ylabel="χ² per exposure")
    plots.letter_panels(np.array([left, right]), ("light before the shadow", "ends of the fits to it"))
    plots.legend_below(np.array([left, right]))
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
