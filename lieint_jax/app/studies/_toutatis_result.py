"""What the study of Toutatis returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.app.scenarios.rigid_body import FreeBody
from lieint_jax.app.studies._flyby import Flyby
from lieint_jax.app.studies._spin_fit import Coverage, Estimate
from lieint_jax.fitting import Fit


class Prediction(NamedTuple):
    """Torque-free motion after the fixes of 1992.

    Attributes:
        t: days from the middle fix, (times,).
        spread: the 5, 50 and 95 % quantiles of the members' angles from the estimate (°), (3, times).
        rms: the root mean square of these angles (°), (times,).
        fix_angles: the angles (°) of the estimate and the published states from the later fixes, by name, (3,) each.
        member_fix_angles: the angles (°) of the members from the later fixes, (members, 3).
        farther_share: the share of the members that are farther from the estimate than the later fix is, (3,): small
            where the fix is outside the spread.
        pole: the angle (°) between the momentum of each single radar fix and the fitted one, (19,).
        energy: 2H Jz/|π|² of the estimate, and of each attitude with the fitted direction of π, (1 + 20,).
    """

    t: np.ndarray
    spread: np.ndarray
    rms: np.ndarray
    fix_angles: dict[str, np.ndarray]
    member_fix_angles: np.ndarray
    farther_share: np.ndarray
    pole: np.ndarray
    energy: np.ndarray


class SpinFit(NamedTuple):
    """The results of the study.

    Attributes:
        fit: the fits from the two published states, from one of them with normal errors, and from random starts.
        share_at_minimum: the share of the random starts that end in the minimum of the first fit.
        estimate: the spin state with its uncertainty.
        normal: the estimate for normal errors, by least squares that are not robust.
        residuals: calculated less observed attitudes (°) and rates (°/d), by name of the state, (2, 17, 3) each.
        weights: the weights of attitudes and rates in the fit, (2, 17).
        outlier: whether each is an outlier, (2, 17).
        published: the derived quantities of the published states, by name, (12,) each.
        mahalanobis_squared: the squared distance of each published state from the estimate, by its covariance, by
            name; for the truth it would be χ² of 8 degrees of freedom.
        prediction: the prediction for 2004, 2008 and 2012.
        flyby: the effect of the Earth's torque on 2004-09-29.
        factors: the factors by which the errors of the parameters, and of the noise levels, are enlarged: the ratio of
            scatter to reported error in the first half of the synthetic sets.
        coverage: how often the enlarged errors include the truth in the second half.
        scenario: the scenario that holds the published values.
    """

    fit: Fit
    share_at_minimum: float
    estimate: Estimate
    normal: Estimate
    residuals: dict[str, np.ndarray]
    weights: np.ndarray
    outlier: np.ndarray
    published: dict[str, np.ndarray]
    mahalanobis_squared: dict[str, float]
    prediction: Prediction
    flyby: Flyby
    factors: np.ndarray
    coverage: Coverage
    scenario: FreeBody

    @property
    def periods(self) -> np.ndarray:
        """The mean precession and rotation periods in days, with their standard errors, (2, 2)."""
        sigma = np.sqrt(np.diagonal(self.estimate.derived_covariance))
        return np.stack([np.asarray(self.estimate.derived)[:2], sigma[:2]], axis=1)
