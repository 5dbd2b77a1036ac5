"""The spin state and inertia of a satellite from its light curve: the model, random guesses, and the results.

Eight parameters are fitted: attitude (3), body rate (3), two ratios of inertia. The zero point of the magnitudes is
eliminated: its least-squares value is the mean of the errors, which is subtracted. The motion is computed by the scheme
of order 6, whose derivatives in so many starts cost a tenth of the closed form's; its error is measured by comparison
with the closed form.

Other spin states have the same light, or nearly so: see `measure.light_changes`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import measure, schemes
from lieint_jax.app.studies._satellite_sky import (
    Lightcurve,
    Minima,
    Scene,
    closed_form,
    magnitude,
)
from lieint_jax.fitting import Fit, inertia_ratios, inference
from lieint_jax.fitting.inference import Params, Problem, Unknown
from lieint_jax.fitting.tumbling import mean_periods, model, rotate, rotation_between
from lieint_jax.runs import integrate, over_members
from lieint_jax.shapes import GlossyFacets


def solutions(params: dict[str, np.ndarray], begin: np.ndarray) -> measure.SpinStates:
    """The solutions of the parameters of n fits, with their reference attitudes `begin`, (n, 4)."""
    q = _attitudes(params["attitude"], begin)
    J = np.concatenate([np.asarray(params["inertia"]), np.ones((len(q), 1))], axis=1)
    return measure.SpinStates(np.asarray(q), np.asarray(params["rate"]), J / np.cbrt(J.prod(axis=1, keepdims=True)))


_attitudes = jax.jit(jax.vmap(rotate))


def parameters(found: measure.SpinStates) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The parameters of fits and their reference attitudes `begin`, (n, 4): the inverse of `solutions`."""
    inertia = found.inertia[:, :2] / found.inertia[:, 2:]
    return {"attitude": np.zeros_like(found.rate), "inertia": inertia, "rate": found.rate}, found.q


BAND, SPECTRUM = (0.01, 0.16), (0.005, 0.35)  # 1/min, the ranges of the pairs of frequencies and of the spectrum
HARMONICS = 6  # largest |j| and |k| of the combinations by which a sine is identified
_SEPARATION = 0.004  # 1/min; pairs of frequencies that are closer are one peak
_SHOWN = 10  # number of sines and pairs in the result


class Search(NamedTuple):
    """The search for the periods of a light curve."""

    frequencies: np.ndarray  # the frequencies of the spectrum, 1/min, (k,)
    power: np.ndarray  # the share of the variance that each frequency explains alone, (k,)
    peaks: list[measure.Sine]  # the strongest sines, one after the other
    pairs: measure.DoublePeriods  # the best pairs of frequencies, best first
    lines: np.ndarray  # pairs of frequencies that generate the same combinations as the best pair, (c, 2)

    @property
    def candidates(self) -> np.ndarray:
        """Candidates for the frequencies of (precession, rotation), 1/min, (c, 2): half a rotation has equal light."""
        return self.lines / np.array([1.0, 2.0])


def search(t: np.ndarray, y: np.ndarray) -> Search:
    """The spectrum of magnitudes y at times t (min), its peaks, and pairs of frequencies."""
    spectrum = measure.periodogram(t, y, frequencies=np.arange(*SPECTRUM, 1 / (6 * (t[-1] - t[0]))))
    pairs = measure.double_periods(t, y, *BAND, separation=_SEPARATION, count=_SHOWN)
    found = measure.sines(t, y, spectrum.frequency, _SHOWN)
    return Search(spectrum.frequency, spectrum.power, found, pairs, measure.equivalent_pairs(pairs.pairs[0], *BAND))


UNKNOWNS = {
    "attitude": Unknown(("attitude x (°)", "attitude y (°)", "attitude z (°)"), (0.0, 0.0, 0.0)),
    "inertia": Unknown(("inertia ratio Jx/Jz", "inertia ratio Jy/Jz"), (0.9, 1.1), inertia_ratios),
    "rate": Unknown(("body rate x (°/min)", "body rate y (°/min)", "body rate z (°/min)"), (0.0, 0.0, 0.0)),
}
QUANTITIES = ("precession period (min)", "rotation period (min)")
Changes = list[measure.LightChange]
Guesses = dict[str, np.ndarray]  # parameters of many fits
STEP = 0.75  # min
_FINE = 4000
_AT_ONCE = 10_000  # guesses that are evaluated together


def magnitudes(params: Params, begin: ArrayLike, facets: GlossyFacets, curve: Lightcurve) -> tuple[Array, Array]:
    """The model's magnitudes, (n,), and whether all steps converged; parameters as in `fitting.tumbling.model`."""
    body, state = model(params, jnp.asarray(begin))
    steps = int(np.ceil(curve.t[-1] / STEP))
    path = integrate(schemes.preprocessed(body, 6), state, STEP, steps, save_at=jnp.asarray(curve.t))
    seen = path.state.q[1:], jnp.asarray(curve.sun), jnp.asarray(curve.observer)
    return jax.vmap(magnitude, (None, 0, 0, 0))(facets, *seen), jnp.all(path.info.converged)


def problem(facets: GlossyFacets, curve: Lightcurve) -> Problem:
    """The fit to magnitudes at the exposures of a curve; the data of a fit are its reference attitude and these."""

    def errors(params: Params, data: tuple[Array, Array]) -> tuple[Array, Array]:
        light, converged = magnitudes(params, data[0], facets, curve)
        error = (light - data[1]) / curve.noise
        return error - jnp.mean(error), converged

    def derived(params: Params, data: tuple[Array, Array]) -> Array:
        return mean_periods(*model(params, data[0]))

    return Problem(UNKNOWNS, errors, None, derived=derived, quantities=QUANTITIES)


def fit_magnitudes(
    guesses: Guesses,
    begin: np.ndarray,
    observed: np.ndarray,
    facets: GlossyFacets,
    curve: Lightcurve,
    progress: bool = True,
) -> Fit:
    """Run many fits at once, to the observed magnitudes, (fits, n), at the exposures of the curve.

    Each leaf of `guesses`, and `begin`, has a leading axis (fits).
    """
    options = {"progress": progress, "tolerance": 1e-6, "iterations": 50}
    return inference.fit_starts(problem(facets, curve), guesses, (begin, observed), **options)


def losses(
    guesses: Guesses, begin: np.ndarray, facets: GlossyFacets, curve: Lightcurve, progress: bool = True
) -> np.ndarray:
    """Half the sum of squares of the errors of each guess, in units of the noise, (guesses,)."""
    from tqdm import tqdm  # imported here, so that the package imports quickly

    def loss(params: Params, begin: Array) -> Array:
        light, _ = magnitudes(params, begin, facets, curve)
        return len(curve.t) * jnp.var(light - curve.magnitude) / (2 * curve.noise**2)

    piece_losses, pieces = over_members(loss), np.array_split(np.arange(len(begin)), -(-len(begin) // _AT_ONCE))
    found = []
    with tqdm(total=len(begin), unit=" guesses", disable=None if progress else True, leave=False) as bar:
        for piece in pieces:
            part = {name: leaf[piece] for name, leaf in guesses.items()}
            found.append(np.asarray(piece_losses(part, begin[piece])))
            bar.update(len(piece))
    return np.concatenate(found)


class Estimate(NamedTuple):
    """The best solution and the truth: attitude (rotation vector in space, °), inertia ratios, rate (°/min)."""

    value: np.ndarray  # the estimate, (8,)
    truth: np.ndarray  # the truth, or its image under a symmetry of the facets, whichever is nearest, (8,)
    sigma: np.ndarray  # standard errors of the estimate, (8,)
    facet_symmetry: np.ndarray  # that symmetry, a rotation of the body axes, (3, 3)
    periods: np.ndarray  # mean precession and rotation period of the estimate (min), (2,)
    periods_sigma: np.ndarray  # their standard errors, (2,)
    errors: np.ndarray  # (estimate − truth)/σ of the synthetic sets, (sets, 8)
    light: np.ndarray  # the magnitudes of the fit, with the zero point of the light curve, (n,)
    fine_t: np.ndarray  # many times, (m,)
    fine_light: np.ndarray  # the same magnitudes at these times, by the closed form, (m,)
    # the largest difference between the fit's magnitudes and those of the closed form, over the noise
    integration: float


class Ends(NamedTuple):
    """The solutions at which fits have ended."""

    loss: np.ndarray  # half the sum of squares of the errors in units of the noise, (n,)
    # the change that maps the night's best solution to each, an index of `SatelliteFit.changes`; −1 for none, (n,)
    change: np.ndarray
    success: np.ndarray  # whether each fit succeeded, (n,)


class SatelliteFit(NamedTuple):
    """The results of the study."""

    title: str  # the title of the scene
    facets: int  # the number of facets of the satellite
    rate: float  # the true angular velocity at the start (°/s)
    curve: Lightcurve  # the light curve
    session: float  # the end of the first session (min)
    periods: np.ndarray  # true mean precession and rotation period (min), (2,)
    minima: Minima  # the minima of the true light in the first session
    search: Search  # the search for periods
    guesses: int  # the number of random bodies that were compared with the first session
    changes: list[measure.LightChange]  # every change of a solution that may leave the light unchanged
    first: Ends  # the ends of all starts on the first session
    candidate: np.ndarray  # the index of the candidate pair of periods of each start, (starts,)
    night: Ends  # the ends on the whole night of the fits that begin at the best ends of the first session
    # the ends on the whole night of the fits that begin at the images of the best end of the first session, one for
    # each kind of change
    images: Ends
    # the change that maps the night's best end to the start of each of these fits, an index of `changes`; −1 for none
    named: np.ndarray
    fit: Fit  # the fits to the whole night
    estimate: Estimate  # the best solution, compared with the truth
    # the effect of the changes in space on the light of the truth (mag, rms), (3, 4): under the directions of the
    # middle of the first session, those of the session, and those of the night
    light_changes: np.ndarray
    seconds: np.ndarray  # the time of the guesses, of the fits to the first session, and of those to the night, (3,)
    devices: int  # the number of devices over which the fits were split


def true_solution(made: Scene) -> measure.SpinStates:
    """The true spin state, as one solution."""
    rate, J = np.rad2deg(made.body.angular_velocity(made.state)), np.asarray(made.body.inertia)
    return measure.SpinStates(np.asarray(made.state.q)[None], rate[None], (J / np.cbrt(J.prod()))[None])


def estimate(
    made: Scene, curve: Lightcurve, night: Fit, begin: np.ndarray, chosen: int, several: int, every: Changes
) -> Estimate:
    """Compare the fit number `chosen` with the truth; the fits from number `several` on are those of synthetic sets."""
    starts, asked = night.starts, problem(made.facets, curve)
    assert starts is not None
    params = jax.tree.map(np.asarray, starts.params)  # off the devices over which the fits were split
    data = begin, np.tile(curve.magnitude, (len(begin), 1))
    every_set = range(several, len(begin))
    own = jax.tree.map(lambda x: x[0], inference.estimates(asked, night, data, which=[chosen]))
    truth, best = true_solution(made), solutions(params, begin).select(chosen)
    true = inference.Estimate.exact(_parameter_vector(truth, truth.q[0]), mean_periods(made.body, made.state))
    tested = inference.estimates(asked, night, data, which=every_set)
    pulls = inference.compare(asked, true, tested, starts.success[several:]).pulls
    symmetry = min((c for c in every if c.name == measure.SPACE_CHANGES[0]), key=lambda c: c(truth).distance(best)[0])
    best_params = {name: jnp.asarray(leaf[chosen]) for name, leaf in params.items()}
    body, state = model(best_params, jnp.asarray(begin[chosen]))
    light = np.asarray(jax.jit(lambda p: magnitudes(p, begin[chosen], made.facets, curve)[0])(best_params))
    fine = np.linspace(0, curve.t[-1], _FINE)
    exact = np.asarray(closed_form(made._replace(body=body, state=state), np.append(curve.t, fine))[1])
    zero = np.mean(curve.magnitude - light)
    image, (of_x, of_periods) = _parameter_vector(symmetry(truth), begin[chosen]), np.split(own.sigmas, [8])
    seen, fine_light = np.split(exact, [len(curve.t)])
    integration = float(np.abs(light - seen).max() / curve.noise)
    compared = own.x, image, of_x, symmetry.g, own.derived, of_periods, pulls[:, :8]
    return Estimate(*compared, light + zero, fine, fine_light + zero, integration)


def _parameter_vector(solution: measure.SpinStates, begin: np.ndarray) -> np.ndarray:
    """The parameters of the fit, (8,), of a single solution."""
    rotation = rotation_between(jnp.asarray(solution.q[0]), jnp.asarray(begin))
    return np.concatenate([rotation, solution.inertia[0, :2] / solution.inertia[0, 2], solution.rate[0]])
