"""Fits of parameters through simulations, within bounds, from one start or many."""

from lieint_jax.fitting._bounds import Bound, free, inertia, inertia_ratios, interval, positive, principal_inertia, spd
from lieint_jax.fitting._fit import Fit, covariance, fit

__all__ = [
    "Bound",
    "Fit",
    "covariance",
    "fit",
    "free",
    "inertia",
    "inertia_ratios",
    "interval",
    "positive",
    "principal_inertia",
    "spd",
]
