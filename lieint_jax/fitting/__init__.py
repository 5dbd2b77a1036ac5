"""Fits of parameters through simulations, within bounds, from one start or many, optionally robust to outliers.

`fit(residuals, guess, bounds=…)` returns the estimate, its covariance, and whether it is a minimum within the bounds.
Bounds are `positive`, `interval(low, high)`, `spd`, `inertia`, `principal_inertia`, `inertia_ratios`, and `free`, which
is no bound. `student_t` converts errors with outliers to residuals, `member_by_member` speeds up a long computation of
few numbers.
`inference` tests the errors of a fit on synthetic data; `tumbling` is the free body whose spin state is fitted.
"""

from lieint_jax.fitting import inference, tumbling
from lieint_jax.fitting._bounds import Bound, free, inertia, inertia_ratios, interval, positive, principal_inertia, spd
from lieint_jax.fitting._fit import covariance, fit
from lieint_jax.fitting._member_by_member import member_by_member
from lieint_jax.fitting._outcome import Fit, MultiStartResult
from lieint_jax.fitting._robust import (
    DEGREES_OF_FREEDOM,
    student_t,
    student_t_curvature,
    student_t_noise_error,
    student_t_weights,
)

__all__ = [
    "DEGREES_OF_FREEDOM",
    "Bound",
    "Fit",
    "MultiStartResult",
    "covariance",
    "fit",
    "free",
    "inertia",
    "inertia_ratios",
    "inference",
    "interval",
    "member_by_member",
    "positive",
    "principal_inertia",
    "spd",
    "student_t",
    "student_t_curvature",
    "student_t_noise_error",
    "student_t_weights",
    "tumbling",
]
__dir__ = __all__.copy
