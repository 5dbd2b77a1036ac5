"""The drift of a splitting where the user gives none: a symplectic step of the system without its potential.

A system declares it by the name of a scheme, `System.default_drift`. On a group the numbers of the metric decide: it is
the exact flow of a bi-invariant metric, whose geodesics are one-parameter subgroups, or the midpoint rule where a map
makes it symplectic, or on SE(3) the free motion of a body about its center of mass.
"""

from __future__ import annotations

import importlib
import math
from contextlib import suppress

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete
from lieint_jax._numerics.small_linalg import sharp
from lieint_jax._numerics.vectors import cross, matrix, unit_trace, vector
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.groups import so3
from lieint_jax.groups.catalogue import special_euclidean
from lieint_jax.maps import arcsine, is_symplectic, kappa_symplectic
from lieint_jax.schemes._group_midpoint import group_midpoint
from lieint_jax.schemes._shared.half_rotation import ITERATIONS, half_rotation
from lieint_jax.systems._equations import (
    AbstractDrivenSystem,
    AbstractForcedSystem,
    AbstractGeodesicFlow,
    AbstractGyrostat,
)

_ROUNDING = 1024  # largest error of Π that is rounding, in units of eps


def default_drift(system: AbstractForcedSystem | AbstractDrivenSystem | AbstractGyrostat) -> Step:
    """A symplectic step of `system.free`.

    Raises:
        ValueError: none is declared, or known for the metric of a group.
    """
    free = system.free
    if scheme := system.default_drift or free.default_drift:
        return getattr(importlib.import_module("lieint_jax.schemes"), scheme)(free)
    given: object = type(free).__name__
    if isinstance(free, AbstractGeodesicFlow):
        if (found := _on_group(free)) is not None:
            return found
        given = free.group
    traced = (
        "" if concrete(free) else "; one is for a bi-invariant metric whose numbers are known when the step is made"
    )
    raise ValueError(
        f"no symplectic drift is known for {given} with this metric{traced}: "
        "give a symmetric step of system.free, such as group_midpoint(system.free), whose form has a defect O(Δt³) per "
        "step unless the metric is bi-invariant"
    )


def _on_group(free: AbstractGeodesicFlow) -> Step | None:
    """A symplectic step of geodesics, if one is known."""
    known, metrics = concrete(free.metric), [free.metric]
    if known and is_bi_invariant(free):
        return OneParameterSubgroup(free)
    with suppress(ValueError), at_once():  # groups where the arcsine map is not defined
        if not known:  # a map that is symplectic for two random metrics is so for every metric
            roots = np.random.default_rng(0).normal(size=(2, free.group.dim, free.group.dim))
            metrics = [jnp.asarray(root @ root.T + np.eye(free.group.dim)) for root in roots]
        if all(is_symplectic(arcsine, free.group, metric) for metric in metrics):
            return group_midpoint(free, arcsine)
    return FreeMotion(free) if known and is_free_motion(free) else None


@pytree
class OneParameterSubgroup(Step):
    """The exact flow q exp(Δt m⁻¹Π) of a bi-invariant metric: no equation is solved, and π is conserved bit for bit.

    The residual is the relative error of Π = Ad*_q π, which is constant.
    """

    system: AbstractGeodesicFlow
    order: float = static(default=math.inf)
    symmetric: bool = static(default=True)
    commuting = True

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        group = self.system.group
        Pi = group.Ad_star(state.q, state.p)
        q = group.multiply(state.q, group.exp(sharp(self.system.metric, jnp.asarray(dt) * Pi)))
        size, error = (jnp.max(jnp.abs(x)) for x in (Pi, group.Ad_star(q, state.p) - Pi))
        eps = float(jnp.finfo(q.dtype).eps)
        return state._replace(q=q), StepInfo(error / jnp.where(size > 0, size, 1), error <= _ROUNDING * eps * size)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return f"{self.name}: exp(Δt Ω) is not exact at dt = {dt}, or the state has left the group: use a smaller dt"


def is_bi_invariant(system: AbstractGeodesicFlow) -> bool:
    """True if ad*_Ω Π = 0 with Ω = m⁻¹Π for every Π, of a concrete metric m; this is bilinear in Π."""
    with at_once():
        d, m = system.group.dim, jnp.asarray(system.metric)
        basis = jnp.eye(d, dtype=m.dtype)
        velocities = jax.vmap(lambda Pi: sharp(m, Pi))(basis)
        terms = jax.vmap(lambda xi: jax.vmap(lambda Pi: system.group.ad_star(xi, Pi))(basis))(velocities)
        terms = np.asarray(terms)
    return bool(np.abs(terms + terms.swapaxes(0, 1)).max() <= 64 * np.finfo(terms.dtype).eps * np.abs(terms).max())


@pytree
class FreeMotion(Step):
    """The symplectic step of `so3_midpoint` for the attitude, and the exact motion of the center of mass, on SE(3).

    For an isotropic mass, the metric diag(J, m1), the two decouple in the coordinates (x, P) and (Λ, S), with the spin
    S = L − x × P. Momentum is conserved bit for bit, the symplectic form to round-off; energy too, if x × P is not
    large compared with S.
    """

    system: AbstractGeodesicFlow
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        m = self.system.metric
        inertia, mass = (m[:3], m[3]) if m.ndim == 1 else (m[:3, :3], m[3, 3])
        R, x, L, P = state.q[:3, :3], state.q[:3, 3], state.p[:3], state.p[3:]
        Pi = jnp.stack(matrix(R).T @ (vector(L) - cross(x, P)))
        J, r = unit_trace(inertia)
        h, info = half_rotation(J, (0.5 * r * dt) * Pi, kappa_symplectic, ITERATIONS["scalar"])
        turn = so3.to_matrix(so3.cayley_increment(jnp.array([1.0, 0, 0, 0], h.dtype), h))
        R = matrix(R) @ matrix(turn)
        moved = x + dt / mass * P
        rows = [jnp.stack([*R[i], moved[i]]) for i in range(3)]
        return state._replace(q=jnp.stack([*rows, state.q[3]])), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return f"{self.name} does not converge at dt = {dt}, where |Δt Ω| must stay below 1: use a smaller dt"


def is_free_motion(system: AbstractGeodesicFlow) -> bool:
    """True if a geodesic flow of a concrete metric is one that `FreeMotion` integrates."""
    if system.group != special_euclidean(3):
        return False
    m = np.asarray(system.metric)
    m = np.diag(m) if m.ndim == 1 else m
    return bool(not m[:3, 3:].any() and (m[3:, 3:] == m[3, 3] * np.eye(3)).all())
