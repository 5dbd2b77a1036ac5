"""Maps τ from the algebra to the group, and the scalings κ that define them on SO(3) (Sections 2.1.2, 2.2, 3.2).

On SO(3) every map of the paper is a scaled Cayley map, cay[κ(|Θ̄|²) Θ̄]:

    κ = 1                        Cayley: Austin, Krishnaprasad & Wan 1993
    κ = tan(½√x)/(½√x)           exponential (2.29): Simo & Wong 1991
    κ = 2/(1 + √(1 − x))         symplectic (3.16): Lewis & Simo 1994; also the Moser–Veselov (RATTLE) step

A map τ is called as `tau(group, theta)`, so that one map serves every group.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import at_once, concrete, name_of
from lieint_jax._numerics import power_series, vectors
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.arrays import AlgebraMatrix, AlgebraVector, Flag, GroupElement, PyTree, Scalar
from lieint_jax._numerics.select import where
from lieint_jax.core import AnalyticGroup, Group, callable_pytree, pytree, static
from lieint_jax.groups import MatrixGroup, so3
from lieint_jax.groups.bases import ideals, units
from lieint_jax.groups.closed_forms import squared_eigenvalue

__all__ = [
    "KAPPAS", "Kappa", "Map", "Tau", "arcsine", "arcsine_forms", "as_kappa", "as_tau", "axis_residual", "cayley",
    "cayley_lands", "defined_on", "derivative", "examples", "exponential", "is_symplectic", "kappa_cayley",
    "kappa_exponential", "kappa_symplectic", "scaled_cayley", "symplectic_residual",
]  # fmt: skip

# Scalings κ of SO(3) --------------------------------------------------------------------------------------------------


@pytree
class Kappa:
    """A scaling κ(x), x = |Θ̄|², smooth at 0 with κ(0) = 1: any κ conserves momentum and energy (Result 3).

    Attributes:
        function: x ↦ κ(x), a callable pytree. Its array leaves, if any, can be differentiated and batched.
        name: for reports.
        limit: the largest |Θ̄| at which κ is real and finite.
        solve_by: "vector", Newton for the three components of Θ̄; or "scalar", Newton for one unknown, possible for the
            symplectic κ (see `schemes.so3_midpoint`).
        symplectic: whether it satisfies (3.15).
        constant: whether κ = 1 everywhere; then its derivative is not computed.
    """

    function: Callable[[Array], Array]
    name: str = static(default="user")
    limit: float = static(default=math.inf)
    solve_by: Literal["vector", "scalar"] = static(default="vector")
    symplectic: bool = static(default=False)
    constant: bool = static(default=False)

    def __call__(self, x: Scalar) -> Scalar:
        return self.function(x)

    @property
    def branch(self) -> str:
        """The end of the branch of solutions that starts at Δt = 0, for messages."""
        return "ends at |Δt Ω| ≈ 1" if self.limit == 1 else "folds at |Δt Ω| of 2 to 4"


def as_kappa(kappa: Kappa | Callable[[Array], Array]) -> Kappa:
    """Any callable x ↦ κ(x) as a `Kappa`; a callable with parameters must be a `jax.tree_util.Partial`."""
    if isinstance(kappa, Kappa):
        return kappa
    if not callable(kappa):
        raise ValueError(f"kappa must be a callable of x = |Θ̄|², such as maps.kappa_symplectic, got {kappa!r}")
    name = name_of(kappa)
    made = Kappa(callable_pytree(kappa), name=name)
    with at_once():  # concrete inside jit too, unless κ closes over a tracer
        at_zero = made(jnp.zeros(())) if concrete(made) else 1.0
        wrong = bool(abs(at_zero - 1) > 1e-6) if concrete(at_zero) and not jnp.shape(at_zero) else False
    if jnp.shape(at_zero) or wrong:
        raise ValueError(f"κ(0) must be the number 1 for the scheme to be consistent, got κ(0) = {at_zero} of {name}")
    return made


def _cayley(x: Scalar) -> Scalar:
    return jnp.ones_like(x)


def _symplectic(x: Scalar) -> Scalar:
    return 2 / (1 + jnp.sqrt(1 - x))


def _lambert(levels: int) -> tuple[list[float], list[float]]:
    """Coefficients in u² of tan(u)/u as a quotient of polynomials: 1/(1 − u²/(3 − u²/(5 − …))), `levels` deep."""
    numerator, denominator = [1], [2 * levels + 1]
    for odd in range(2 * levels - 1, 0, -2):
        longer = [odd * c for c in denominator] + [0] * (len(numerator) + 1 - len(denominator))
        for k, c in enumerate(numerator):
            longer[k + 1] -= c
        numerator, denominator = denominator, longer
    unit = denominator[0]
    return [c / unit for c in numerator], [c / unit for c in denominator]


_TAN = _lambert(11)


def _exponential(x: Scalar) -> Scalar:
    """tan(u)/u, u² = x/4: a rational function, exact to round-off up to the pole at x = π² and smooth at 0."""
    numerator, denominator = (power_series.horner(c, x / 4) for c in _TAN)
    return numerator / denominator


kappa_cayley = Kappa(callable_pytree(_cayley), name="cayley", constant=True)
kappa_exponential = Kappa(callable_pytree(_exponential), name="exponential", limit=math.pi)
kappa_symplectic = Kappa(callable_pytree(_symplectic), name="symplectic", limit=1.0, solve_by="scalar", symplectic=True)
KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)


# Maps τ of any group --------------------------------------------------------------------------------------------------


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
    return group.exp(jnp.stack(_arcsine_scales(group, theta)) * theta)


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


def _arcsine_scales(group: Group, theta: la.Vector) -> list[Array]:
    """The s of each component of Θ."""
    scales: list[PyTree] = [None] * group.dim
    for factor, form in arcsine_forms(group):
        s = _arcsine_of_square(la.quadratic(form, theta))
        for i in factor:
            scales[i] = s
    return scales


def _arcsine_scaled(group: Group, theta: la.Vector) -> la.Vector:
    """sΘ."""
    scales = _arcsine_scales(group, theta)
    return jnp.stack(scales) * theta if isinstance(theta, Array) else la.map_entries(la.times, scales, theta)


_ARCSINE = [math.comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(20)]


def _arcsine_of_square(x: Scalar) -> Scalar:
    """arcsin(√x)/√x: analytic for x < 1, arsinh(√−x)/√−x for negative x."""
    size, positive = jnp.abs(x), x > 0
    root = jnp.sqrt(where(size < 0.05, 0.25, size))  # both branches are right near the threshold of 0.1
    up = where(positive, root, 0.5)
    closed = where(positive, jnp.arcsin(up), jnp.arcsinh(root)) / root
    return where(size < 0.1, power_series.horner(_ARCSINE, where(size < 0.2, x, 0)), closed)


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


_SLOPE_TERMS = 3  # terms of H in Newton's matrix: the truncation error is |Θ|³/24


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


def _arcsine_near(group: Any, theta: AlgebraVector) -> GroupElement:
    return group.exp_near(_arcsine_scaled(group, theta))


def _arcsine_holds(group: Any, theta: AlgebraVector) -> Flag:
    return group.near(_arcsine_scaled(group, theta))


def _arcsine_slope(group: Any, theta: la.Vector) -> la.Matrix:
    """H_exp(sΘ)(s + Θ⊗∇s), factor by factor."""
    vector = theta if isinstance(theta, Array) else jnp.stack(theta)
    H = group.exp_slope(_arcsine_scaled(group, theta), _SLOPE_TERMS)
    columns: list[PyTree] = [None] * group.dim
    for factor, form in arcsine_forms(group):
        s, gradient = jax.value_and_grad(lambda x, form=form: _arcsine_of_square(la.quadratic(form, x)))(vector)
        along = [vectors.dot([row[j] for j in factor], [theta[j] for j in factor]) for row in H]
        for j in factor:
            columns[j] = [la.times(s, row[j]) + a * gradient[j] for row, a in zip(H, along, strict=True)]
    rows = vectors.Matrix(columns).T
    return rows.array if isinstance(theta, Array) else rows


def _arcsine_coadjoint(group: Any, theta: la.Vector, mu: la.Vector) -> la.Vector:
    return group.exp_coadjoint(_arcsine_scaled(group, theta), mu)


_BY_EXPONENTIAL = Tau(
    callable_pytree(_GroupMethod("exp_near")),
    "exponential",
    slope=_GroupMethod("exp_slope", (_SLOPE_TERMS,)),
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
    callable_pytree(_arcsine_near), "arcsine", slope=_arcsine_slope, holds=_arcsine_holds, coadjoint=_arcsine_coadjoint
)
_BY_ROTATION = Tau(callable_pytree(exponential), "exponential", holds=_half_turn)
_ON_ANALYTIC_GROUPS = ((exponential, _BY_EXPONENTIAL), (cayley, _BY_CAYLEY), (arcsine, _BY_ARCSINE))  # map and `Tau`


def cayley_lands(group: Group) -> bool:
    """True if the Cayley map lands in a group; for a plain `Group` this is assumed."""
    return not isinstance(group, AnalyticGroup) or group.cayley_lands


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


def axis_residual(tau: Map, group: Group, theta: AlgebraVector) -> Scalar:
    """max|Ad_τ(Θ) Θ − Θ| / max|Θ|: zero if a step by τ conserves energy (Result 10)."""
    return jnp.max(jnp.abs(group.Ad(tau(group, theta), theta) - theta)) / jnp.max(jnp.abs(theta))


def symplectic_residual(tau: Map, group: Group, metric: Array, theta: AlgebraVector) -> Scalar:
    """The residual of the symplectic condition (5.31), relative to the metric.

    With (5.33) inserted, Δt drops out: skew[m H⁻¹ (1 + Ad_τ⁻¹)] = ad*([(1 + Ad*_τ⁻¹)⁻¹ − ½] m Θ). The step of
    `schemes.group_midpoint` from a state with Δt Ω_{n+½} = Θ is symplectic if and only if it is zero.

    Args:
        tau: a map (group, Θ) ↦ group element.
        group: the group.
        metric: m, principal (d,) or full (d, d).
        theta: Θ, shape (d,).

    Returns:
        The largest entry of the residual, a scalar: 0 to round-off if τ is symplectic at this Θ.
    """
    one = jnp.eye(group.dim, dtype=theta.dtype)
    m = jnp.diag(metric) if jnp.ndim(metric) == 1 else metric
    back = jax.vmap(group.Ad, (None, 1), 1)(group.inverse(tau(group, theta)), one)  # Ad_τ⁻¹
    M = m @ jnp.linalg.solve(derivative(tau, group, theta), one + back)
    mu = jnp.linalg.solve(one + back.T, m @ theta) - m @ theta / 2
    right = jax.vmap(group.ad_star, (1, None), 1)(one, mu)
    return jnp.max(jnp.abs((M - M.T) / 2 - right)) / jnp.max(jnp.abs(m))


def is_symplectic(tau: Map, group: Group, metric: Array, size: float = 0.3, *, samples: int = 8) -> bool:
    """True if τ conserves the symplectic form for this group and metric, measured at random Θ with |Θᵢ| ≤ `size`.

    Arguments as in `symplectic_residual`; `samples` is the number of random Θ.
    """
    theta = np.random.default_rng(0).uniform(-size, size, (samples, group.dim))
    theta = jnp.asarray(theta, jnp.result_type(metric, float))
    found = jax.jit(jax.vmap(lambda x: symplectic_residual(tau, group, metric, x)))(theta)
    return bool(jnp.max(found) < 1e3 * jnp.finfo(theta.dtype).eps)


def examples() -> dict[str, Map]:
    """Maps of SO(3)."""
    return {"exponential": exponential, "cayley": cayley} | {
        f"scaled_cayley[{k.name}]": scaled_cayley(k) for k in KAPPAS
    }
