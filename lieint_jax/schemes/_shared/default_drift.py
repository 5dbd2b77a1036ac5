"""The drift of a splitting where the user gives none: a symplectic step of the system without its potential."""

from __future__ import annotations

from contextlib import suppress

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import at_once, concrete
from lieint_jax.capabilities import (
    AbstractDrivenSystem,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractGeodesicFlow,
    AbstractGyrostat,
)
from lieint_jax.maps import arcsine, is_symplectic
from lieint_jax.schemes._exact import exact
from lieint_jax.schemes._group_midpoint import group_midpoint
from lieint_jax.schemes._shared.bi_invariant import OneParameterSubgroup, is_bi_invariant
from lieint_jax.schemes._shared.se3_free_body import FreeMotion, is_free_motion
from lieint_jax.schemes._so3_midpoint import so3_midpoint
from lieint_jax.types import Step


def default_drift(system: AbstractForcedSystem | AbstractDrivenSystem | AbstractGyrostat) -> Step:
    """A symplectic step of `system.free`.

    Raises:
        ValueError: none is known for the metric of a group.
    """
    if isinstance(system, AbstractGyrostat):
        return exact(system.free)
    free = system.free
    if isinstance(free, AbstractFreeBodies):
        return exact(free)
    if isinstance(free, AbstractFreeBody):
        return so3_midpoint(free)
    found = _on_group(free) if isinstance(free, AbstractGeodesicFlow) else None
    if found is not None:
        return found
    traced = (
        "" if concrete(free) else "; one is for a bi-invariant metric whose numbers are known when the step is made"
    )
    raise ValueError(
        f"no symplectic drift is known for {getattr(free, 'group', type(free).__name__)} with this metric{traced}: "
        "give a symmetric step of system.free, such as group_midpoint(system.free), whose form has a defect O(Δt³) per "
        "step unless the metric is bi-invariant"
    )


def _on_group(free: AbstractGeodesicFlow) -> Step | None:
    """A symplectic step of geodesics, if one is known."""
    if concrete(free.metric) and is_bi_invariant(free):
        return OneParameterSubgroup(free)
    with suppress(ValueError), at_once():  # groups where the arcsine map is not defined
        if all(is_symplectic(arcsine, free.group, metric) for metric in _metrics(free)):
            return group_midpoint(free, arcsine)
    return FreeMotion(free) if concrete(free.metric) and is_free_motion(free) else None


def _metrics(free: AbstractGeodesicFlow) -> list[Array]:
    """The system's metric; if it is a tracer, two random ones: a map symplectic for both is so for every metric."""
    if concrete(free.metric):
        return [free.metric]
    roots = np.random.default_rng(0).normal(size=(2, free.group.dim, free.group.dim))
    return [jnp.asarray(root @ root.T + np.eye(free.group.dim)) for root in roots]
