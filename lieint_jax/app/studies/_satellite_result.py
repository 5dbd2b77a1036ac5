"""What the study of a satellite returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.app.studies._minima import Minima
from lieint_jax.app.studies._period_search import Search
from lieint_jax.app.studies._satellite_fit import Estimate
from lieint_jax.app.studies._satellite_sky import Lightcurve
from lieint_jax.app.studies._symmetric_solutions import Change
from lieint_jax.fitting import Fit


class Ends(NamedTuple):
    """The solutions at which fits have ended.

    Attributes:
        loss: half the sum of squares of the errors in units of the noise, (n,).
        change: the change that maps the night's best solution to each, an index of `SatelliteFit.changes`; −1 for
            none, (n,).
        success: whether each fit succeeded, (n,).
    """

    loss: np.ndarray
    change: np.ndarray
    success: np.ndarray


class SatelliteFit(NamedTuple):
    """The results of the study.

    Attributes:
        title: the title of the scene.
        facets: the number of facets of the satellite.
        rate: the true angular velocity at the start (°/s).
        curve: the light curve.
        session: the end of the first session (min).
        periods: true mean precession and rotation period (min), (2,).
        minima: the minima of the true light in the first session.
        search: the search for periods.
        guesses: the number of random bodies that were compared with the first session.
        changes: every change of a solution that may leave the light unchanged.
        first: the ends of all starts on the first session.
        candidate: the index of the candidate pair of periods of each start, (starts,).
        night: the ends on the whole night of the fits that begin at the best ends of the first session.
        images: the ends on the whole night of the fits that begin at the images of the best end of the first session,
            one for each kind of change.
        named: the change that maps the night's best end to the start of each of these fits, an index of `changes`; −1
            for none.
        fit: the fits to the whole night.
        estimate: the best solution, compared with the truth.
        light_changes: the effect of the changes in space on the light of the truth (mag, rms), (3, 4): under the
            directions of the middle of the first session, those of the session, and those of the night.
        seconds: the time of the guesses, of the fits to the first session, and of those to the night, (3,).
        devices: the number of devices over which the fits were split.
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
