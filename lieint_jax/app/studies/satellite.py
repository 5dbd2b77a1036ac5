"""The spin state and inertia ratios of a tumbling satellite from its light alone, with all symmetric solutions.

The object is simulated: a box with two panels in a graveyard orbit above the geostationary ring, near an equinox, seen
from the ground before and after it crosses the Earth's shadow (`satellite.toml`). The study

* finds the minima of its light as events of the motion;
* searches the light curve for two periods, and lists the pairs that would give the same combinations;
* evaluates many random bodies of these periods on the first session, and fits the best of them to it;
* goes on with the best ends on the whole night, beside the images of the best one under every change of space or of
  body axes that may leave the light as it is, and beside synthetic data sets, fitted from the truth;
* names and counts the ends.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from lieint_jax.app.studies._facets import Facets, brightness, facets, magnitude
from lieint_jax.app.studies._minima import Minima, minima_of
from lieint_jax.app.studies._period_search import Search, search
from lieint_jax.app.studies._satellite_fit import Estimate, estimate, fitted, losses, random_guesses, true_solution
from lieint_jax.app.studies._satellite_picture import draw
from lieint_jax.app.studies._satellite_report import text
from lieint_jax.app.studies._satellite_sky import Lightcurve, Scene, closed_form, observe, scene
from lieint_jax.app.studies._symmetric_solutions import (
    Change,
    Solutions,
    changes,
    differences,
    parameters,
    solutions,
    sorted_out,
)
from lieint_jax.app.studies._tumbling import mean_periods
from lieint_jax.fitting._outcome import Fit

__all__ = ["Facets", "SatelliteFit", "brightness", "draw", "facets", "magnitude", "run", "scene", "text"]

_MOST_MINIMA = 60  # more than there are in the first session


class Ends(NamedTuple):
    """Where fits have ended.

    Attributes:
        loss: half the sum of squares of the errors in units of the noise, (n,).
        change: which change of the night's best one each is, an index of `SatelliteFit.changes`; −1 for none, (n,).
        success: whether each stopped for a good reason, (n,).
    """

    loss: np.ndarray
    change: np.ndarray
    success: np.ndarray


class SatelliteFit(NamedTuple):
    """The results of the study.

    Attributes:
        title: of the scene.
        facets: the number of facets of the satellite.
        rate: its true angular velocity at the start (°/s).
        curve: the light curve.
        session: the end of the first session (min).
        periods: true mean precession and rotation period (min), (2,).
        minima: of the true light in the first session.
        search: the search for periods.
        guesses: the number of random bodies that were tried on the first session.
        changes: every change of a solution that may leave the light as it is.
        first: the ends of all starts on the first session.
        candidate: which candidate pair of periods each start had, (starts,).
        night: the ends of the best of them on the whole night.
        images: the ends on the whole night from the images of the best end of the first session, one for each kind of
            change; `named` says which.
        named: which change of the night's best end each image is where it starts, an index of `changes`; −1 for none.
        fit: of the whole night.
        estimate: the best solution beside the truth.
        light_changes: by how much the changes in space alter the light of the truth (mag, rms), (3, 4): under the
            directions of the middle of the first session, those of the session, and those of the night.
        seconds: the time of the guesses, of the fits to the first session, and of those to the night, (3,).
        devices: over which they were split.
    """

    title: str
    facets: int
    rate: float
    curve: Lightcurve
    session: float
    periods: np.ndarray
    minima: Minima
    search: Search
    guesses: int
    changes: list[Change]
    first: Ends
    candidate: np.ndarray
    night: Ends
    images: Ends
    named: np.ndarray
    fit: Fit
    estimate: Estimate
    light_changes: np.ndarray
    seconds: np.ndarray
    devices: int


def run(quick: bool = False, progress: bool = True) -> SatelliteFit:
    """The whole study; `quick` takes a fifth of the starts and synthetic sets."""
    guesses, starts, kept, sets = (20_000, 200, 40, 20) if quick else (100_000, 1000, 100, 100)
    made = scene()
    session = made.exposures["sessions_min"][0][1]
    curve, seen = observe(made, sets)
    found = search(curve.t, curve.magnitude)
    first = curve.until(session)
    clock = [time.perf_counter()]
    guess, begin, candidate = _chosen(found.candidates, made, first, guesses, starts, progress)
    clock.append(time.perf_counter())
    one = fitted(guess, begin, _repeated(first, starts), made.facets, first, progress)
    clock.append(time.perf_counter())
    assert one.starts is not None
    every = changes(made.facets, first.sun, first.observer)
    ends, order = solutions(one.starts.params, begin), np.argsort(one.starts.loss)
    images = _images(ends.take(order[0]), every)
    night, begin = _whole_night(_joined(ends.take(order[:kept]), images), made, curve, seen, progress)
    clock.append(time.perf_counter())
    assert night.starts is not None
    after, several = solutions(night.starts.params, begin), kept + len(images.q)
    chosen = int(np.argmin(night.starts.loss[:several]))
    best = after.take(chosen)
    of_night = _ends(night, after, best, every)
    return SatelliteFit(
        title=made.title,
        facets=len(made.facets.area),
        rate=float(np.linalg.norm(np.rad2deg(made.body.angular_velocity(made.state))) / 60),
        curve=curve,
        session=session,
        periods=np.asarray(jax.jit(mean_periods)(made.body, made.state)),
        minima=minima_of(made, session, _MOST_MINIMA),
        search=found,
        guesses=guesses,
        changes=every,
        first=_ends(one, ends, best, every),
        candidate=candidate,
        night=Ends(*(leaf[:kept] for leaf in of_night)),
        images=Ends(*(leaf[kept:several] for leaf in of_night)),
        named=sorted_out(images, best, every),
        fit=night,
        estimate=estimate(made, curve, night, begin, chosen, several, every),
        light_changes=_light_changes(made, first, curve),
        seconds=np.diff(clock),
        devices=len(jax.devices()),
    )


def _images(best: Solutions, every: list[Change]) -> Solutions:
    """A solution's image of each kind, the solution itself among them."""
    return _joined(*(change(best) for change in every if change.turn == 0))


def _joined(*parts: Solutions) -> Solutions:
    return Solutions(*map(np.concatenate, zip(*parts, strict=True)))


def _light_changes(made: Scene, first: Lightcurve, night: Lightcurve) -> np.ndarray:
    middle = len(first.t) // 2
    held = first._replace(sun=first.sun[[middle] * len(first.t)], observer=first.observer[[middle] * len(first.t)])
    q = np.asarray(closed_form(made, night.t)[0])
    return np.stack([differences(made.facets, q[: len(c.t)], c.sun, c.observer) for c in (held, first, night)])


def _chosen(
    candidates: np.ndarray, made: Scene, curve: Lightcurve, guesses: int, starts: int, progress: bool
) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """The best of random guesses, their attitudes, and the candidate of each."""
    guess, begin, candidate = random_guesses(candidates, guesses, jax.random.key(made.exposures["seed"]))
    order = np.argsort(losses(guess, begin, made.facets, curve, progress))[:starts]
    return jax.tree.map(lambda leaf: leaf[order], guess), begin[order], candidate[order]


def _repeated(curve: Lightcurve, times: int) -> np.ndarray:
    return np.tile(curve.magnitude, (times, 1))


def _whole_night(
    several: Solutions, made: Scene, curve: Lightcurve, seen: np.ndarray, progress: bool
) -> tuple[Fit, np.ndarray]:
    """Fits of the light curve from several solutions, and of other noise from the truth: one compiled program."""
    truth = jax.tree.map(lambda leaf: np.repeat(leaf, len(seen), axis=0), true_solution(made))
    guess, begin = parameters(_joined(several, truth))
    data = np.concatenate([_repeated(curve, len(several.q)), seen])
    return fitted(guess, begin, data, made.facets, curve, progress), begin


def _ends(fit: Fit, ends: Solutions, best: Solutions, every: list[Change]) -> Ends:
    assert fit.starts is not None
    return Ends(fit.starts.loss, sorted_out(ends, best, every), fit.starts.success)
