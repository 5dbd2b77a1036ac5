"""A tumbling satellite, a fit: spin state and inertia ratios from its light alone, and its mirror solution.

The object is simulated: a box with two panels in a graveyard orbit above the geostationary ring, seen from the ground
before and after it crosses the Earth's shadow. Its light has two periods. Many random bodies of these periods are
compared with the first session, and the best of them are fitted to it. The whole night is fitted from the best results,
and from the mirror image of the best one, which has nearly the same light. Times are in minutes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

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
BAND = (0.01, 0.16)  # 1/min, of the pairs of frequencies
STEP = 0.75  # min
UNKNOWNS = {
    "attitude": inference.Unknown(("attitude x (°)", "attitude y (°)", "attitude z (°)"), (0.0, 0.0, 0.0)),
    "inertia": inference.Unknown(("inertia ratio Jx/Jz", "inertia ratio Jy/Jz"), (0.9, 1.1), li.fitting.inertia_ratios),
    "rate": inference.Unknown(("body rate x (°/min)", "body rate y (°/min)", "body rate z (°/min)"), (0.0, 0.0, 0.0)),
}
QUANTITIES = ("precession period (min)", "rotation period (min)")


def main(
    guesses: int = 100_000, starts: int = 1000, out: Path | None = None, seed: int = 8, pictures: bool = True
) -> None:
    """Find the periods, fit the first session and the whole night, and compare the solutions with the truth.

    Args:
        guesses: the number of random bodies that are compared with the first session.
        starts: the number of the best of them that are fitted to it; the best tenth of these, to the whole night.
        out: the picture; by default satellite_fit.png, or satellite_fit-2.png where that exists.
        seed: of the exposures, the noise and the guesses.
        pictures: draw the light of the first session and its fit.
    """
    jax.config.update("jax_enable_x64", True)
    truth = {"attitude": np.zeros(3), "inertia": np.array(INERTIA[:2]) / INERTIA[2], "rate": np.array(RATE)}
    body, state = tumbling.model(truth, jnp.array(ATTITUDE))
    t, periods = exposures(seed), np.asarray(tumbling.mean_periods(body, state))
    light = jax.lax.map(lambda t: magnitude(body.solution(state, t).q, t), t, batch_size=256)
    observed = np.asarray(light + NOISE * jax.random.normal(jax.random.key(seed + 1), t.shape))
    first, phase = t < SESSIONS[0][1], np.rad2deg(np.arccos(np.sum(np.prod(directions(t), axis=0), axis=1)))
    print(
        f"{TITLE}: all of it simulated\n  {len(t)} exposures in {t[-1]:.0f} min, {first.sum()} before the shadow of the"
    )
    print(f"  Earth; noise {NOISE} mag; phase angle {phase[0]:.0f}° to {phase.min():.0f}° to {phase[-1]:.0f}°")
    print("  mean periods, true: precession {:.4f} min, rotation {:.4f} min".format(*periods))
    candidates = search_periods(t, observed, 1 / periods)

    # the first session, from the best of many guesses
    early = problem(t[first])
    guess = tumbling.random_guesses(candidates, guesses, jax.random.key(seed))[:2]
    squares = li.over_members(lambda params, begin: jnp.sum(early.errors(params, (begin, observed[first]))[0] ** 2))
    pieces = np.array_split(np.arange(guesses), -(-guesses // 10_000))
    chosen = np.concatenate([squares(*jax.tree.map(lambda x, k=k: x[k], guess)) for k in pieces]).argsort()[:starts]
    params, begin = jax.tree.map(lambda x: x[chosen], guess)
    data = begin, np.tile(observed[first], (starts, 1))
    found = inference.fit_starts(early, params, data, tolerance=1e-6, iterations=50).starts
    ends, changes = spin_states(found.params, begin), measure.light_changes(facets(), *directions(t[first]))
    same, mirrors = ([x for x in changes if x.name == name] for name in ("as it is", "mirror"))

    # the whole night, from the best ends, and last from the mirror image of the best one
    order, count = np.argsort(found.loss), -(-starts // 10)
    spins = ends.select(order[:count]), mirrors[0](ends.select(order[0]))
    begin, rate, J = (np.concatenate(leaves) for leaves in zip(*spins, strict=True))
    params = {"attitude": 0 * rate, "inertia": J[:, :2] / J[:, 2:], "rate": rate}
    whole, data = problem(t), (begin, np.tile(observed, (count + 1, 1)))
    fit = inference.fit_starts(whole, params, data, tolerance=1e-9, iterations=50)
    best, loss = int(np.argmin(fit.starts.loss)), fit.starts.loss
    solution = spin_states(fit.starts.params, begin).select(best)
    print(f"\n  χ² of the solutions {'starts':>20}{'first':>10}{'night':>10}")
    for name, group, night in (("as it is", same, loss[best]), ("mirror", mirrors, loss[-1])):
        there = measure.classify_light(ends, solution, group) >= 0
        print(f"    {name:<26}{there.sum():8}{2 * found.loss[there].min(initial=np.inf):10.1f}{2 * night:10.1f}")
    print("  'At least two different observation geometries' tell them apart (Kaasalainen 2001, A&A 376:302).")

    # the best solution next to the truth, up to a half turn of the body, which leaves the light unchanged
    own = jax.tree.map(lambda x: x[0], inference.estimates(whole, fit, data, which=[best]))
    true = spin_states(*jax.tree.map(lambda x: np.asarray(x)[None], (truth, state.q)))
    near = min((turn(true) for turn in same), key=lambda x: x.distance(solution)[0])
    rotation = tumbling.rotation_between(jnp.asarray(near.q[0]), jnp.asarray(begin[best]))
    nearest = np.concatenate([rotation, near.inertia[0, :2] / near.inertia[0, 2], near.rate[0], periods])
    print(f"\n  the best solution, χ² {2 * loss[best]:.1f} for {len(t) - 9} degrees of freedom, and the truth")
    print(f"    {'':<26}{'fitted':>10}{'± 1σ':>9}{'truth':>10}{'off':>9}")
    for name, x, sigma, y in zip((*whole.names, *QUANTITIES), own.values, own.sigmas, nearest, strict=True):
        print(f"    {name:<26}{x:10.4f}{sigma:9.4f}{y:10.4f}{(x - y) / sigma:+7.2f} σ")
    if pictures:
        model = jax.jit(lambda: magnitudes(whole.unravel(own.x), begin[best], t)[0])()
        figure = draw(t[first], observed[first], (model + np.mean(observed - model))[first])
        print("pictures:", *li.plots.save(figure, out or li.report.new_path("satellite_fit.png")))


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


def search_periods(t, observed, true):
    """Print the search of the light for two frequencies, next to the true ones; return candidates for these, (n, 2)."""
    pairs = measure.double_periods(t, observed, *BAND, separation=0.004, count=10)
    (f, g), left = pairs.pairs[0], 100 * pairs.unexplained[0]
    candidates = measure.equivalent_pairs((f, g), *BAND) / np.array([1.0, 2.0])  # half a rotation has equal light
    a, b = candidates[abs(candidates - true).max(axis=1).argmin()]
    print(f"\n  {f:.5f} and {g:.5f} per min, the best pair for a double Fourier series of order 2 (Pravec et al. 2005,")
    print(
        f"  Icarus 173:108), leave {left:.1f} % of the variance; of {len(candidates)} pairs with its combinations one,"
    )
    print(f"  1/{1 / a:.2f} and 1/{1 / b:.2f} per min, is the true one up to {a - true[0]:+.5f} and {b - true[1]:+.5f}")
    return candidates


@li.plots.style()
def draw(t, observed, fitted):
    """Plot the light of the first session with its fit."""
    fig, [[ax]] = li.plots.figure(size=(8.0, 4.0))
    ax.plot(t, fitted, color=li.plots.BLUE, lw=0.8, label="best solution")
    ax.plot(t, observed, ".", color=li.plots.INK, label="exposures")
    ax.set(xlabel="t (min)", ylabel="magnitude, zero point unknown", title="light before the shadow")
    ax.invert_yaxis()
    ax.legend()
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
