"""Maps τ from the algebra to the group, called as `tau(group, theta)`, so that one map serves every group."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import AlgebraMatrix, AlgebraVector, GroupElement
from lieint_jax.core import AnalyticGroup, Group
from lieint_jax.maps._arcsine import arcsine, arcsine_forms
from lieint_jax.maps._kappa import KAPPAS

Map = Callable[[Group, Array], Array]


def exponential(group: Group, theta: AlgebraVector) -> GroupElement:
    """exp Θ."""
    return group.exp(theta)


def cayley(group: Group, theta: AlgebraVector) -> GroupElement:
    """cay Θ = (1 − Θ/2)⁻¹(1 + Θ/2) (2.5)."""
    return group.cayley(theta)


def scaled_cayley(kappa: Callable[[Array], Array]) -> Map:
    """The map Θ̄ ↦ cay[κ(|Θ̄|²) Θ̄] of SO(3) (3.17)."""
    return jax.tree_util.Partial(_scaled_cayley, kappa)


def _scaled_cayley(kappa: Callable[[Array], Array], group: Group, theta: AlgebraVector) -> GroupElement:
    return group.cayley(kappa(vectors.dot(theta, theta)) * theta)


def derivative(tau: Map, group: Group, theta: AlgebraVector) -> AlgebraMatrix:
    """H(Θ) of Dτ(Θ)·δΘ = τ(Θ)(HδΘ)^ (5.28), shape (d, d), by autodiff."""
    value, tangents = tau(group, theta), jax.jacfwd(lambda x: tau(group, x))(theta)
    return jax.vmap(lambda t: group.body_velocity(value, t), in_axes=-1, out_axes=-1)(tangents)


def cayley_lands(group: Group) -> bool:
    """True if the Cayley map lands in a group; for a plain `Group` this is assumed."""
    return not isinstance(group, AnalyticGroup) or group.cayley_lands


def defined_on(group: Group) -> dict[str, Map]:
    """The maps τ that are defined on a group, by name: exponential, cayley, arcsine."""
    found: dict[str, Map] = {"exponential": exponential}
    if cayley_lands(group):
        found["cayley"] = cayley
    try:
        arcsine_forms(group)
    except ValueError:
        return found
    return found | {"arcsine": arcsine}


def examples() -> dict[str, Map]:
    """Maps of SO(3)."""
    return {"exponential": exponential, "cayley": cayley} | {
        f"scaled_cayley[{k.name}]": scaled_cayley(k) for k in KAPPAS
    }
