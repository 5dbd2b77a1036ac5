"""The arcsine map, exp(s(x)Θ) with s(x) = arcsin(√x)/√x."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import at_once
from lieint_jax._numerics import power_series, vectors
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.arrays import AlgebraVector, Flag, GroupElement, PyTree, Scalar
from lieint_jax._numerics.select import where
from lieint_jax.core import Group
from lieint_jax.groups import MatrixGroup
from lieint_jax.groups.bases import ideals, units
from lieint_jax.groups.closed_forms import squared_eigenvalue

SLOPE_TERMS = 3  # terms of H in Newton's matrix: the truncation error is |Θ|³/24


def arcsine(group: Group, theta: AlgebraVector) -> Array:
    """exp(s(x)Θ), s(x) = arcsin(√x)/√x, x = −λ² for the eigenvalues 0 and ±λ of ad_Θ (arsinh for x < 0).

    On a direct product, each factor has its own x. On SO(3) this is the scaled Cayley map of the symplectic κ.
    Numerical evidence, not a proof, shows that it is symplectic for every metric on SL(2), SE(2), E(1,1), the
    Heisenberg groups, Aff(1) and Bianchi's type V, and on products of these for every metric that does not couple the
    factors. It is not symplectic on SE(3), for example. `symplectic_residual` measures this.

    Args:
        group: a group on which ad_Θ has no other eigenvalues than 0 and ±λ, on each factor of a product.
        theta: Θ, shape (d,).

    Raises:
        ValueError: ad_Θ has several pairs of nonzero eigenvalues (SO(4), SL(3), …), where the map is not defined.
    """
    return group.exp(jnp.stack(_scales(group, theta)) * theta)


@cache
def arcsine_forms(group: Group) -> list[tuple[list[int], np.ndarray]]:
    """The factors of a group, each by its indices in the basis, and the matrix (d, d) of x = −λ² of `arcsine` for each.

    The matrix is the Killing form over −(number of λ's).
    """
    d = group.dim
    with at_once():
        ad = np.array([[group.ad(x, y) for y in jnp.eye(d)] for x in jnp.eye(d)]).transpose(0, 2, 1)  # ad[i] is ad_eᵢ
    unit = units(group.basis) if isinstance(group, MatrixGroup) else np.ones(d)
    ad = ad / unit[:, None, None] / unit * unit[:, None]  # of a basis of like sizes
    forms = []
    for factor in ideals(ad):
        form = squared_eigenvalue(ad[factor])
        if form is None:
            raise ValueError(
                "the arcsine map is defined where ad_Θ has one pair of nonzero eigenvalues ±λ only (on each factor of "
                f"a product); {group} is not such a group: use maps.exponential"
            )
        forms.append((factor, np.zeros((d, d))))
        forms[-1][1][np.ix_(factor, factor)] = -form * np.outer(unit[factor], unit[factor])
    return forms


def _scales(group: Group, theta: la.Vector) -> list[Array]:
    """The s of each component of Θ."""
    scales: list[PyTree] = [None] * group.dim
    for factor, form in arcsine_forms(group):
        s = of_square(la.quadratic(form, theta))
        for i in factor:
            scales[i] = s
    return scales


def scaled(group: Group, theta: la.Vector) -> la.Vector:
    """sΘ."""
    scales = _scales(group, theta)
    return jnp.stack(scales) * theta if isinstance(theta, Array) else la.map_entries(la.times, scales, theta)


_SERIES = [math.comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(20)]


def of_square(x: Scalar) -> Scalar:
    """arcsin(√x)/√x: analytic for x < 1, arsinh(√−x)/√−x for negative x."""
    size, positive = jnp.abs(x), x > 0
    root = jnp.sqrt(where(size < 0.05, 0.25, size))  # both branches are right near the threshold of 0.1
    up = where(positive, root, 0.5)
    closed = where(positive, jnp.arcsin(up), jnp.arcsinh(root)) / root
    return where(size < 0.1, power_series.horner(_SERIES, where(size < 0.2, x, 0)), closed)


def near(group: Any, theta: AlgebraVector) -> GroupElement:
    return group.exp_near(scaled(group, theta))


def holds(group: Any, theta: AlgebraVector) -> Flag:
    return group.near(scaled(group, theta))


def slope(group: Any, theta: la.Vector) -> la.Matrix:
    """H_exp(sΘ)(s + Θ⊗∇s), factor by factor."""
    vector = theta if isinstance(theta, Array) else jnp.stack(theta)
    H = group.exp_slope(scaled(group, theta), SLOPE_TERMS)
    columns: list[PyTree] = [None] * group.dim
    for factor, form in arcsine_forms(group):
        s, gradient = jax.value_and_grad(lambda x, form=form: of_square(la.quadratic(form, x)))(vector)
        along = [vectors.dot([row[j] for j in factor], [theta[j] for j in factor]) for row in H]
        for j in factor:
            columns[j] = [la.times(s, row[j]) + a * gradient[j] for row, a in zip(H, along, strict=True)]
    rows = vectors.Matrix(columns).T
    return rows.array if isinstance(theta, Array) else rows


def coadjoint(group: Any, theta: la.Vector, mu: la.Vector) -> la.Vector:
    return group.exp_coadjoint(scaled(group, theta), mu)
