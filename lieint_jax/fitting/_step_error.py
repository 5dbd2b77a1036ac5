"""The error of an estimate that comes from the steps of the simulation, from one run with half the step size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.fitting._search import residuals_of
from lieint_jax.runs import halved_steps

_NOTABLE = 0.2  # standard errors that the steps may move a parameter by
_CURE = (
    "use a smaller dt or a composition of higher order (li.schemes.compose); for a free body body.solution or "
    "li.schemes.calibrated"
)


def with_halved_steps(residuals: Callable[[PyTree], PyTree], params: PyTree) -> tuple[Array, Array, float] | None:
    """The residuals with half the step size, whether they converged, and e in e·(these − those) = exact − those.

    e is 2^p/(2^p − 1) with the lowest order p of the steps. None without steps of a finite order.
    """
    with halved_steps() as runs:
        r, ok = residuals_of(residuals, params)
    if not runs.orders:
        return None
    power = 2.0 ** min(runs.orders)
    return r, ok, power / (power - 1)


def shift(J: np.ndarray, B: np.ndarray, held: np.ndarray, change: np.ndarray) -> np.ndarray:
    """By how much a `change` of the residuals moves the parameters: −B (JᵀJ)⁻¹ Jᵀ change, with J and B as in `spread`.

    Coordinates that are held at a side do not move.
    """
    J = np.where(held, 0, np.asarray(J, float))  # in which squares of numbers in float32 are in range
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1)
    return -np.where(held, 0, B) @ (np.linalg.lstsq(J / size, change)[0] / size)


def complaint(names: list[str], params: np.ndarray, moved: np.ndarray, covariance: np.ndarray) -> str:
    """The parameter that the steps move most and remedies, if that is by more than a fifth of its standard error."""
    errors = np.sqrt(np.diagonal(covariance))
    ratios = np.abs(moved) / np.where(errors > 0, errors, np.nan)
    if not np.any(ratios > _NOTABLE):
        return ""
    k = int(np.nanargmax(ratios))
    return (
        f"the error of the steps moves {names[k]} = {params[k]:.5g} ± {errors[k]:.2g} by about {-moved[k]:.2g}, "
        f"{ratios[k]:.2g} standard errors, according to a run with half of dt: {_CURE}"
    )
