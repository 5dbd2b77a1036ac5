"""Bounds by smooth reparametrisation: an optimiser moves freely in x, and the parameters never leave their domain.

(They may reach its edge, to round-off, where the minimum is not inside: `Fit.at_bound` says so.)

A `Bound` is a pair of inverse maps, x ↦ parameter and back. Give `fit` one for all parameters, or a tree of them that
matches the parameters as far as it goes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import concrete


@dataclasses.dataclass(frozen=True)
class Bound:
    """A domain and the smooth map of all real x onto it.

    Attributes:
        name: for error messages.
        inside: the map x ↦ parameter, of arrays.
        free: the inverse map, parameter ↦ x.
    """

    name: str
    inside: Callable[[Array], Array]
    free: Callable[[Array], Array]


def interval(low: float, high: float) -> Bound:
    """low < parameter < high, each component, by the logistic function."""
    if not low < high:
        raise ValueError(f"an interval needs low < high, got {low} and {high}")

    def free(p: Array) -> Array:
        u = (p - low) / (high - low)
        return jnp.log(u) - jnp.log1p(-u)

    return Bound(f"interval({low:g}, {high:g})", lambda x: low + (high - low) * jax.nn.sigmoid(x), free)


def _from_second_moments(x: Array) -> Array:
    """Principal moments J_i = a_j + a_k of second moments a = e^x: they satisfy the triangle inequality strictly."""
    a = jnp.exp(x)
    return jnp.sum(a) - a


def _to_second_moments(J: Array) -> Array:
    return jnp.log(jnp.sum(J) / 2 - J)


def _ratios(x: Array) -> Array:
    """(J₁/J₃, J₂/J₃), the third second moment being 1."""
    J = _from_second_moments(jnp.append(x, 0.0))
    return J[:2] / J[2]


def _from_ratios(ratios: Array) -> Array:
    x = _to_second_moments(jnp.append(ratios, 1.0))
    return x[:2] - x[2]


def _cholesky(x: Array) -> Array:
    """LLᵀ of a lower triangular L: x holds the logarithms of its diagonal, then the entries below it."""
    L = jnp.diag(jnp.exp(x[:3])) + jnp.zeros((3, 3), x.dtype).at[(1, 2, 2), (0, 0, 1)].set(x[3:])
    return L @ L.T


def _from_cholesky(S: Array) -> Array:
    L = jnp.linalg.cholesky((S + S.T) / 2)
    return jnp.concatenate([jnp.log(jnp.diagonal(L)), L[(1, 2, 2), (0, 0, 1)]])


def _tensor(x: Array) -> Array:
    """J = tr(E)1 − E of a positive definite E: the inertia of some distribution of mass."""
    E = _cholesky(x)
    return jnp.trace(E) * jnp.eye(3, dtype=E.dtype) - E


def _from_tensor(J: Array) -> Array:
    return _from_cholesky(jnp.trace(J) / 2 * jnp.eye(3, dtype=J.dtype) - J)


free = Bound("free", lambda x: x, lambda p: p)
positive = Bound("positive", jnp.exp, jnp.log)
spd = Bound("spd", _cholesky, _from_cholesky)  # symmetric positive definite (3, 3)
principal_inertia = Bound("principal_inertia", _from_second_moments, _to_second_moments)  # (3,), triangle inequality
inertia_ratios = Bound("inertia_ratios", _ratios, _from_ratios)  # (2,), to the third moment; triangle inequality
inertia = Bound("inertia", _tensor, _from_tensor)  # full (3, 3), positive definite, triangle inequality


def release(bounds: Any, params: Any) -> Any:
    """The free x of `params`.

    Raises:
        ValueError: concrete parameters that are not inside their bounds, or bounds that do not match the parameters.
    """

    def one(bound: Bound, part: Any) -> Any:
        if not isinstance(bound, Bound):
            raise ValueError(f"bounds must be made of Bound's such as studies.positive, got {bound!r}")
        x = jax.tree.map(lambda p: bound.free(jnp.asarray(p, jnp.result_type(p, float))), part)
        if concrete(x) and not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(x)):
            raise ValueError(f"the first guess {part} is not inside its bound, {bound.name}")
        return x

    try:
        structure = jax.tree.structure(bounds)
        parts = structure.flatten_up_to(params)
    except (ValueError, TypeError) as error:
        raise ValueError(f"bounds do not match the parameters as far as they go: {error}") from None
    return structure.unflatten([one(bound, part) for bound, part in zip(jax.tree.leaves(bounds), parts, strict=True)])


def confine(bounds: Any, x: Any) -> Any:
    """The parameters of the free x."""
    return jax.tree.map(lambda bound, part: jax.tree.map(bound.inside, part), bounds, x)
