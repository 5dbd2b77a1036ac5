"""The geodesics of a bi-invariant metric, which are one-parameter subgroups: q exp(Δt m⁻¹Π), π and Π constant."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lieint_jax._checks import at_once
from lieint_jax._numerics.metric import sharp
from lieint_jax.capabilities import AbstractGeodesicFlow
from lieint_jax.types import State, Step, StepInfo, pytree, static

_ROUNDING = 1024  # largest error of Π that is rounding, in units of eps


@pytree
class OneParameterSubgroup(Step):
    """The exact flow of a bi-invariant metric: no equation is solved, and π is conserved bit for bit.

    The residual is the relative error of Π = Ad*_q π, which is constant.

    Attributes:
        system: a geodesic flow of a bi-invariant metric.
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
