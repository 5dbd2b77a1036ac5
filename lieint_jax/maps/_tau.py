"""Maps τ as schemes use them: with what is known of them in closed form, and checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import at_once, concrete, name_of
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import AlgebraVector, Flag, GroupElement, PyTree
from lieint_jax.core import AnalyticGroup, Group, callable_pytree, pytree, static
from lieint_jax.groups import so3
from lieint_jax.maps import _arcsine
from lieint_jax.maps._arcsine import SLOPE_TERMS, arcsine, arcsine_forms
from lieint_jax.maps._maps import Map, cayley, cayley_lands, derivative, exponential
from lieint_jax.maps._residuals import axis_residual


@pytree
class Tau:
    """A map τ from the algebra to the group, as schemes use it. Made by `as_tau`.

    Attributes:
        function: (group, Θ) ↦ τ(Θ), a callable pytree.
        name: for reports.
        slope: (group, Θ) ↦ H(Θ) of (5.28), (d, d), for Newton's matrix, where an approximation suffices. None selects
            autodiff.
        exact_slope: the same to round-off, for tangent vectors. None, or None as a result, selects autodiff.
        holds: (group, Θ) ↦ whether τ(Θ) is exact to round-off. None if it always is.
        coadjoint: (group, Θ, μ) ↦ Ad*_τ(Θ) μ, on the vectors of `_numerics.small_linalg`. None: a step computes it from
            τ(Θ).
        along: (group, q, Θ, s) ↦ q τ(sΘ) for s of shape () or (k,). None: a step computes it from τ.
        symmetric: whether τ(−Θ) = τ(Θ)⁻¹, which makes a step of τ time-symmetric and of second order. `as_tau` measures
            this; whoever constructs a `Tau` directly declares it.
    """

    function: Map
    name: str = static(default="user")
    slope: Callable[[Group, Array], la.Matrix] | None = static(default=None)
    exact_slope: Callable[[Group, Array], la.Matrix | None] | None = static(default=None)
    holds: Callable[[Group, Array], Array] | None = static(default=None)
    coadjoint: Callable[[Group, la.Vector, la.Vector], la.Vector] | None = static(default=None)
    along: Callable[[Group, Array, Array, Array], Array] | None = static(default=None)
    symmetric: bool = static(default=True)

    def __call__(self, group: Group, theta: AlgebraVector) -> GroupElement:
        return self.function(group, theta)


@dataclasses.dataclass(frozen=True)
class _GroupMethod:
    """The function (group, …) ↦ group.method(…, *more), which can be compared and pickled."""

    method: str
    more: tuple[int, ...] = ()

    def __call__(self, group: Any, *arguments: PyTree) -> PyTree:
        return getattr(group, self.method)(*arguments, *self.more)


def _cayley_coadjoint(group: Any, theta: la.Vector, mu: la.Vector) -> la.Vector:
    return group.coadjoint(*group.cayley_both(theta), mu)


def _half_turn(_: Group, theta: AlgebraVector) -> Flag:
    """Whether Θ is a rotation by less than 180°; beyond, several Θ lead to the same rotation."""
    return vectors.dot(theta, theta) < math.pi**2


_BY_EXPONENTIAL = Tau(
    callable_pytree(_GroupMethod("exp_near")),
    "exponential",
    slope=_GroupMethod("exp_slope", (SLOPE_TERMS,)),
    exact_slope=_GroupMethod("closed_slope"),
    holds=_GroupMethod("near"),
    coadjoint=_GroupMethod("exp_coadjoint"),
    along=_GroupMethod("exp_along"),
)
_BY_CAYLEY = Tau(
    callable_pytree(cayley),
    "cayley",
    slope=_GroupMethod("cayley_slope"),
    exact_slope=_GroupMethod("cayley_slope"),
    coadjoint=_cayley_coadjoint,
)
_BY_ARCSINE = Tau(
    callable_pytree(_arcsine.near), "arcsine", slope=_arcsine.slope, holds=_arcsine.holds, coadjoint=_arcsine.coadjoint
)
_BY_ROTATION = Tau(callable_pytree(exponential), "exponential", holds=_half_turn)
_ON_ANALYTIC_GROUPS = ((exponential, _BY_EXPONENTIAL), (cayley, _BY_CAYLEY), (arcsine, _BY_ARCSINE))  # map and `Tau`


def as_tau(tau: Tau | Map, group: Group) -> Tau:
    """Any map τ(group, Θ) as a `Tau`, checked on `group`, with its symmetry measured.

    A map with traced parameters is neither checked nor measured, and is assumed to be symmetric.

    Raises:
        ValueError: τ is not callable; it is not consistent, τ(0) = 1 and H(0) = 1; it leaves the group; or it violates
            Ad_τ(Θ) Θ = Θ, without which energy is not conserved (Result 10).
    """
    if isinstance(tau, Tau):
        return tau
    if not callable(tau):
        raise ValueError(f"tau must be a map (group, theta) ↦ group element, such as maps.exponential, got {tau!r}")
    name = name_of(tau)
    if tau is arcsine:
        with at_once():
            arcsine_forms(group)
    if tau is cayley and not cayley_lands(group):
        raise ValueError(f"the Cayley map does not land in {group}: use maps.exponential")
    for known, form in _ON_ANALYTIC_GROUPS:
        if tau is known and isinstance(group, AnalyticGroup):
            return form
    if tau is exponential and group is so3:
        return _BY_ROTATION
    made = Tau(callable_pytree(tau), name)
    if tau is exponential or tau is arcsine or not concrete(made):
        return made
    with at_once():
        return dataclasses.replace(made, symmetric=_check_map(made, group))


def _check_map(tau: Tau, group: Group) -> bool:
    """True if τ(−Θ) = τ(Θ)⁻¹. Raises ValueError for a τ that no step can use."""
    rng = np.random.default_rng(0)
    one, eps = jnp.asarray(group.identity, float), float(jnp.finfo(float).eps)
    zero = jnp.zeros(group.dim)
    off = float(jnp.max(jnp.abs(tau(group, zero) - one)))
    slope = float(jnp.max(jnp.abs(derivative(tau, group, zero) - jnp.eye(group.dim))))
    if not (off < 1e3 * eps and slope < 1e-6):
        raise ValueError(
            f"τ(0) and Dτ(0) must be the identity for the scheme to be consistent; {tau.name} is off by {off:.2g} "
            f"and {slope:.2g}"
        )
    symmetric, name = True, (group.__name__ if isinstance(group, ModuleType) else str(group)).rpartition(".")[2]
    for theta in jnp.asarray(rng.uniform(-0.3, 0.3, (3, group.dim))):
        defect, turned = abs(float(group.defect(tau(group, theta)))), float(axis_residual(tau, group, theta))
        if not defect < 1e4 * eps:
            raise ValueError(f"τ(Θ) must lie in {name}; {tau.name} leaves it by {defect:.2g}")
        if not turned < 1e4 * eps:
            raise ValueError(
                f"Ad_τ(Θ) Θ = Θ must hold for energy to be conserved (Result 10); for {tau.name} on {name} it is off "
                f"by {turned:.2g}. To use it nevertheless, pass maps.Tau(tau)"
            )
        there_and_back = group.multiply(tau(group, theta), tau(group, -theta))
        symmetric &= bool(jnp.max(jnp.abs(there_and_back - one)) < 1e4 * eps)
    return symmetric
