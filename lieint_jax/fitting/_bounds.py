"""Bounds: domains of parameters, as boxes in suitable coordinates.

A search moves in these coordinates y and stays inside the box: least squares by steps that respect its sides, other
methods by a smooth map of all real x onto it. The coordinates are linear in the parameters, so that they do not distort
a trust region; only those of tensors are quadratic.

Give `fit` one `Bound` for all parameters, or a tree of them that is a prefix of the tree of parameters.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import all_plain, concrete, plain
from lieint_jax._numerics.arrays import PyTree
from lieint_jax.fitting._box import Box

_INFINITE = float("inf")


class Chart(NamedTuple):
    """Coordinates y of a domain that is a box in them.

    Attributes:
        parameter: the map y ↦ parameter, of arrays.
        coordinates: the inverse map, parameter ↦ y.
        box: the sides of the box.
    """

    parameter: Callable[[Array], Array]
    coordinates: Callable[[Array], Array]
    box: Box


@dataclasses.dataclass(frozen=True)
class Bound:
    """A domain of a parameter, and the smooth map of all real x onto it.

    Attributes:
        name: for error messages.
        inside: the map x ↦ parameter, of arrays.
        free: the inverse map, parameter ↦ x.
        chart: coordinates for least squares; None if they are x.
        condition: what parameters inside satisfy, and what to do with one on the edge, for error messages.
    """

    name: str
    inside: Callable[[Array], Array]
    free: Callable[[Array], Array]
    chart: Chart | None = None
    condition: str = ""

    @property
    def coordinates(self) -> Chart:
        """The coordinates in which the domain is a box."""
        return Chart(self.inside, self.free, Box()) if self.chart is None else self.chart


def _bound(name: str, chart: Chart, condition: str = "") -> Bound:
    """The bound of a chart."""
    parameter, coordinates, box = chart
    return Bound(name, lambda x: parameter(box.inside(x)), lambda p: box.free(coordinates(p)), chart, condition)


def _itself(p: Array) -> Array:
    return p


def interval(low: float, high: float) -> Bound:
    """The bound low < parameter < high for each component; either end may be infinite."""
    all_plain(low=low, high=high)
    if np.ndim(low) or np.ndim(high):
        raise ValueError(f"an interval needs two numbers, got {low} and {high}: give a tree of bounds for several")
    if not low < high:
        raise ValueError(f"an interval needs low < high, got {low} and {high}")
    return _interval(float(low), float(high))


@functools.lru_cache(maxsize=256)  # equal intervals are one bound, so that a fit within them is compiled once
def _interval(low: float, high: float) -> Bound:
    return _bound(f"interval({low:g}, {high:g})", Chart(_itself, _itself, Box(low, high)))


def _moments(a: Array) -> Array:
    """Principal moments J_i = a_j + a_k of second moments a: they satisfy the triangle inequality if a > 0."""
    return jnp.sum(a) - a


def _ratios(y: Array) -> Array:
    """(J₁/J₃, J₂/J₃) of their sum less 1 and their difference: the triangle inequality is y₁ > 0, −1 < y₂ < 1."""
    return (1 + y[0] + jnp.stack([y[1], -y[1]])) / 2


def _cholesky(y: Array) -> Array:
    """LLᵀ of a lower triangular L: y holds its diagonal, then the entries below it."""
    L = jnp.diag(y[:3]) + jnp.zeros((3, 3), y.dtype).at[(1, 2, 2), (0, 0, 1)].set(y[3:])
    return L @ L.T


def _from_cholesky(S: Array) -> Array:
    L = jnp.linalg.cholesky((S + S.T) / 2)
    return jnp.concatenate([jnp.diagonal(L), L[(1, 2, 2), (0, 0, 1)]])


def _tensor(y: Array) -> Array:
    """J = tr(E)1 − E of a positive definite E: the inertia of some distribution of mass."""
    E = _cholesky(y)
    return jnp.trace(E) * jnp.eye(3, dtype=E.dtype) - E


_DIAGONAL = Box((0.0,) * 3 + (-_INFINITE,) * 3, _INFINITE)  # tuples, so that a fit within it is compiled once
_EDGE = "; on the edge, as for a plate or a phone, one moment is the sum of the two others: start with it 0.1 % smaller"
free = Bound("free", _itself, _itself)
positive = _bound("positive", Chart(_itself, _itself, Box(0, _INFINITE)))
spd = _bound("spd", Chart(_cholesky, _from_cholesky, _DIAGONAL))  # symmetric positive definite (3, 3)
principal_inertia = _bound(  # (3,), triangle inequality
    "principal_inertia",
    Chart(_moments, lambda J: jnp.sum(J) / 2 - J, Box(0, _INFINITE)),
    ": each principal moment must be less than the sum of the two others" + _EDGE,
)
inertia_ratios = _bound(  # (2,), to the third moment; triangle inequality
    "inertia_ratios",
    Chart(_ratios, lambda r: jnp.stack([r[0] + r[1] - 1, r[0] - r[1]]), Box((0.0, -1.0), (_INFINITE, 1.0))),
    ": with (J₁, J₂) over the third moment, J₁ + J₂ > 1 > |J₁ − J₂|, strictly" + _EDGE,
)
inertia = _bound(  # (3, 3), positive definite, triangle inequality
    "inertia",
    Chart(_tensor, lambda J: _from_cholesky(jnp.trace(J) / 2 * jnp.eye(3, dtype=J.dtype) - J), _DIAGONAL),
    ": each principal moment must be less than the sum of the two others" + _EDGE,
)


def _real(p: Any) -> Array:
    p = plain("params", p)
    return jnp.asarray(p, jnp.result_type(p, float))


def coordinates(bounds: PyTree, params: PyTree) -> PyTree:
    """The coordinates of `params`.

    Raises:
        ValueError: concrete parameters that are not inside their bounds, or bounds that do not match the parameters.
    """

    def of_part(bound: Bound, part: PyTree) -> PyTree:
        if not isinstance(bound, Bound):
            raise ValueError(f"bounds must be a tree of Bound objects, such as li.fitting.positive, got {bound!r}")
        y = jax.tree.map(lambda p: bound.coordinates.coordinates(_real(p)), part)
        if concrete(y) and not is_inside(bound, y):
            raise ValueError(f"the first guess {part} is not inside its bound, {bound.name}{bound.condition}")
        return y

    try:
        structure = jax.tree.structure(bounds)
        parts = structure.flatten_up_to(params)
    except (ValueError, TypeError) as error:
        raise ValueError(f"bounds must be a prefix of the parameter tree: {error}") from None
    return structure.unflatten(
        [of_part(bound, part) for bound, part in zip(jax.tree.leaves(bounds), parts, strict=True)]
    )


def is_inside(bounds: PyTree, y: PyTree) -> bool:
    """Whether all concrete coordinates are inside their boxes; they may have leading axes."""

    def of_part(bound: Bound, part: PyTree) -> bool:
        return all(bound.coordinates.box.contains(leaf).all() for leaf in jax.tree.leaves(part))

    return all(jax.tree.leaves(jax.tree.map(of_part, bounds, y)))


def parameters(bounds: PyTree, y: PyTree) -> PyTree:
    """The parameters of the coordinates."""
    return jax.tree.map(lambda bound, part: jax.tree.map(bound.coordinates.parameter, part), bounds, y)


def box(bounds: PyTree, y: PyTree) -> Box:
    """The box of all coordinates, as one vector in the order of `ravel_pytree(y)`; y may be of shapes alone."""

    def side(k: int) -> np.ndarray:
        def of_part(bound: Bound, part: PyTree) -> PyTree:
            return jax.tree.map(lambda leaf: np.broadcast_to(bound.coordinates.box[k], leaf.shape), part)

        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(jax.tree.map(of_part, bounds, y))])

    return Box(side(0), side(1))
