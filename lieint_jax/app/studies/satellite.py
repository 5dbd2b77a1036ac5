"""The spin state and inertia ratios of a tumbling satellite from its light alone, with all symmetric solutions.

The object is simulated: a box with two panels in a graveyard orbit above the geostationary ring, near an equinox, seen
from the ground before and after it crosses the Earth's shadow (`satellite.toml`). The study

* finds the minima of its light as events of the motion;
* searches the light curve for two periods, and lists the pairs that would give the same combinations;
* compares many random bodies of these periods with the first session, and fits the best of them to it;
* fits the whole night from the best results, from the images of the best one under every change of space or of body
  axes that may leave the light unchanged, and, for synthetic data sets, from the truth;
* identifies and counts the solutions at which the fits end.
"""

from __future__ import annotations

import time

import jax
import numpy as np

from lieint_jax.app.studies._facets import Facets, brightness, facets, magnitude
from lieint_jax.app.studies._minima import scene_minima
from lieint_jax.app.studies._period_search import search
from lieint_jax.app.studies._satellite_fit import (
    estimate,
    fit_magnitudes,
    losses,
    random_guesses,
    true_solution,
)
from lieint_jax.app.studies._satellite_picture import draw
from lieint_jax.app.studies._satellite_report import text
from lieint_jax.app.studies._satellite_result import Ends, SatelliteFit
from lieint_jax.app.studies._satellite_sky import Lightcurve, Scene, closed_form, observe, scene
from lieint_jax.app.studies._symmetric_solutions import (
    Change,
    Solutions,
    changes,
    classify,
    light_differences,
    parameters,
    solutions,
)
from lieint_jax.app.studies._tumbling import mean_periods
from lieint_jax.fitting import Fit

__all__ = ["Facets", "SatelliteFit", "brightness", "draw", "facets", "magnitude", "run", "scene", "text"]

_MOST_MINIMA = 60  # more than the first session has


def run(quick: bool = False, progress: bool = True) -> SatelliteFit:
    """Run the whole study; `quick` uses a fifth of the starts and synthetic sets."""
    guesses, starts, continued, sets = (20_000, 200, 40, 20) if quick else (100_000, 1000, 100, 100)
    made = scene()
    session = made.exposures["sessions_min"][0][1]
    curve, synthetic = observe(made, sets)
    found = search(curve.t, curve.magnitude)
    first = curve.truncate(session)
    clock = [time.perf_counter()]
    guess, begin, candidate = _best_guesses(found.candidates, made, first, guesses, starts, progress)
    clock.append(time.perf_counter())
    fits = fit_magnitudes(guess, begin, _repeat_magnitudes(first, starts), made.facets, first, progress)
    clock.append(time.perf_counter())
    assert fits.starts is not None
    every = changes(made.facets, first.sun, first.observer)
    ends, order = solutions(fits.starts.params, begin), np.argsort(fits.starts.loss)
    images = _images(ends.select(order[0]), every)
    night, begin = _whole_night(_join(ends.select(order[:continued]), images), made, curve, synthetic, progress)
    clock.append(time.perf_counter())
    assert night.starts is not None
    after, several = solutions(night.starts.params, begin), continued + len(images.q)
    chosen = int(np.argmin(night.starts.loss[:several]))
    best = after.select(chosen)
    of_night = _ends(night, after, best, every)
    return SatelliteFit(
        title=made.title,
        facets=len(made.facets.area),
        rate=float(np.linalg.norm(np.rad2deg(made.body.angular_velocity(made.state))) / 60),
        curve=curve,
        session=session,
        periods=np.asarray(jax.jit(mean_periods)(made.body, made.state)),
        minima=scene_minima(made, session, _MOST_MINIMA),
        search=found,
        guesses=guesses,
        changes=every,
        first=_ends(fits, ends, best, every),
        candidate=candidate,
        night=Ends(*(leaf[:continued] for leaf in of_night)),
        images=Ends(*(leaf[continued:several] for leaf in of_night)),
        named=classify(images, best, every),
        fit=night,
        estimate=estimate(made, curve, night, begin, chosen, several, every),
        light_changes=_light_changes(made, first, curve),
        seconds=np.diff(clock),
        devices=len(jax.devices()),
    )


def _images(best: Solutions, every: list[Change]) -> Solutions:
    """The images of a solution under the changes of every kind, including the solution itself."""
    return _join(*(change(best) for change in every if change.symmetry == 0))


def _join(*parts: Solutions) -> Solutions:
    return Solutions(*map(np.concatenate, zip(*parts, strict=True)))


def _light_changes(made: Scene, first: Lightcurve, night: Lightcurve) -> np.ndarray:
    middle = len(first.t) // 2
    held = first._replace(sun=first.sun[[middle] * len(first.t)], observer=first.observer[[middle] * len(first.t)])
    q = np.asarray(closed_form(made, night.t)[0])
    return np.stack([light_differences(made.facets, q[: len(c.t)], c.sun, c.observer) for c in (held, first, night)])


def _best_guesses(
    candidates: np.ndarray, made: Scene, curve: Lightcurve, guesses: int, starts: int, progress: bool
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The best of the random guesses, their attitudes, and the candidate of each."""
    guess, begin, candidate = random_guesses(candidates, guesses, jax.random.key(made.exposures["seed"]))
    order = np.argsort(losses(guess, begin, made.facets, curve, progress))[:starts]
    return jax.tree.map(lambda leaf: leaf[order], guess), begin[order], candidate[order]


def _repeat_magnitudes(curve: Lightcurve, times: int) -> np.ndarray:
    return np.tile(curve.magnitude, (times, 1))


def _whole_night(
    several: Solutions, made: Scene, curve: Lightcurve, synthetic: np.ndarray, progress: bool
) -> tuple[Fit, np.ndarray]:
    """Fit the light curve from several solutions, and synthetic sets from the truth, in one compiled program."""
    truth = jax.tree.map(lambda leaf: np.repeat(leaf, len(synthetic), axis=0), true_solution(made))
    guess, begin = parameters(_join(several, truth))
    data = np.concatenate([_repeat_magnitudes(curve, len(several.q)), synthetic])
    return fit_magnitudes(guess, begin, data, made.facets, curve, progress), begin


def _ends(fit: Fit, ends: Solutions, best: Solutions, every: list[Change]) -> Ends:
    assert fit.starts is not None
    return Ends(fit.starts.loss, classify(ends, best, every), fit.starts.success)
