"""The equation for Θ that the steps on any group solve: its guess, Newton's matrix, and the report on its root.

    m Θ − ½Δt (Π_n + Π_{n+1}) = 0                                                            (5.27)

Vectors are unrolled into scalars for small groups and arrays for large ones, see `_numerics.small_linalg`.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax.capabilities import (
    AbstractMechanicalSystem,
    AbstractMetricSystem,
    AbstractRightGeodesicFlow,
)
from lieint_jax.maps import Tau, derivative
from lieint_jax.types import AnalyticGroup, Group, State, StepInfo
from lieint_jax.types.shapes import AlgebraVector, SquareMatrix
from lieint_jax.types.vectors import Matrix, components


class Equation(NamedTuple):
    """The data of the equation for Θ of one step.

    Attributes:
        group: the group G.
        tau: the map τ.
        m: the metric as a matrix.
        state: where the step starts.
        half: ½Δt.
        a: ½Δt Π_n; −½Δt π_n for a right-invariant metric, whose equation is that of the inverse of q.
        known: the part of the equation that is known in advance; a, except for `group_alpha`.
        carried: ½Δt Ad*_q π, which on groups that are not compact can lose its digits.
    """

    group: Group
    tau: Tau
    m: la.Matrix
    state: State
    half: Array
    a: la.Vector
    known: la.Vector
    carried: la.Vector

    @classmethod
    def from_state(cls, system: AbstractMetricSystem, tau: Tau, state: State, half: Array) -> Equation:
        """The equation of a step by τ, for a system with a group and a metric."""
        m = unpacked(system.group, system.metric)
        carried = a = as_vector(m, half * system.group.Ad_star(state.q, state.p))
        if isinstance(system, AbstractRightGeodesicFlow):
            a = as_vector(m, -half * state.p)
        return cls(system.group, tau, m, state, half, a, a, carried)

    def residual(self, theta: la.Vector, after: la.Vector) -> la.Vector:
        """m Θ − ½Δt Π_n − ½Δt Π_{n+1}, the last given as `after`."""
        return self.m @ theta - self.known - after


def solved(
    equation: Equation,
    residual: Callable[[la.Vector], la.Vector],
    matrix: Callable[[la.Vector, la.Vector], la.Matrix],
    size: Callable[[la.Vector], Array],
    start: la.Vector,
    iterations: int,
) -> tuple[la.Vector, Array, StepInfo]:
    """The root Θ by `newton.chords`, as a vector of the equation and as an array, and the report on it.

    It reports convergence if the residual, in the units of `size`, is round-off; if the solve was steady and the root
    lies before the fold, so that it is on the branch from Δt = 0; if digits are left; and if τ(Θ) is exact.
    """
    group, tau, m, state = equation.group, equation.tau, equation.m, equation.state

    def factored(theta: la.Vector, F: la.Vector) -> la.Factored:
        return la.factored(matrix(theta, F))

    def length(step: la.Vector) -> Array:
        return size(m @ step)

    theta, F, on_branch = newton.chords(residual, factored, size, length, start, iterations)
    good = on_branch & digits_left(equation)
    Theta = la.as_array(theta, state.p)
    good = good & tau.holds(group, Theta) if tau.holds else good
    return theta, Theta, newton.report(size(F), good)


def unpacked(group: Group, metric: Array) -> la.Matrix:
    """The metric as a matrix: unrolled for small groups, an array for large ones."""
    if isinstance(group, AnalyticGroup) and not group.unrolled:
        return jnp.diag(metric) if metric.ndim == 1 else metric
    if metric.ndim == 2:
        return la.unrolled(metric)
    return Matrix((x if i == j else 0.0 for j in range(len(metric))) for i, x in enumerate(components(metric)))


def as_vector(m: la.Matrix, x: Array) -> la.Vector:
    """An array in the form of m: unrolled, or unchanged."""
    return x if isinstance(m, Array) else la.unrolled(x)


def ad_star(group: Group, xi: la.Vector, mu: la.Vector) -> la.Vector:
    """ad*_ξ μ."""
    return ad_star_matrix(group, mu) @ xi


def ad_star_matrix(group: Group, mu: la.Vector) -> la.Matrix:
    """ad*(μ), (d, d)."""
    if isinstance(group, AnalyticGroup):
        return group.ad_star_matrix(mu)
    mu = la.as_array(mu, mu[0])
    return la.unrolled(jax.vmap(group.ad_star, (1, None), 1)(jnp.eye(group.dim, dtype=mu.dtype), mu))


def coadjoint(tau: Tau, group: Group, theta: la.Vector, mu: la.Vector) -> la.Vector:
    """Ad*_τ(Θ) μ."""
    if tau.coadjoint is not None:
        return tau.coadjoint(group, theta, mu)
    turned = group.Ad_star(tau(group, la.as_array(theta, theta[0])), la.as_array(mu, mu[0]))
    return as_vector(theta, turned)


def translate(tau: Tau, group: Group, q: SquareMatrix, Theta: AlgebraVector, s: ArrayLike = 1.0) -> Array:
    """q τ(sΘ) for a number s, or at each of several, (k,), as one array."""
    s = jnp.asarray(s, Theta.dtype)
    if tau.along is not None:
        return tau.along(group, q, Theta, s)
    return la.at_each(lambda s: group.multiply(q, tau(group, s * Theta)), s)


def slope(tau: Tau, group: Group, theta: la.Vector, exact: bool = False) -> la.Matrix:
    """H(Θ), (d, d)."""
    formula = tau.exact_slope if exact else tau.slope
    closed = None if formula is None else formula(group, theta)
    if closed is not None:
        return closed
    H = derivative(tau, group, la.as_array(theta, theta[0]))
    return as_vector(theta, H)


def guess(group: Group, m: la.Matrix, a: la.Vector) -> la.Vector:
    """Θ ≈ ΔtΩ + ½Δt² m⁻¹ ad*_Ω Π, from a = ½Δt Π: second order."""
    sharp = la.factored(m).solve
    half_rotation = sharp(a)
    return 2.0 * half_rotation + 2.0 * sharp(ad_star(group, half_rotation, a))


def newton_matrix(equation: Equation, theta: la.Vector, F: la.Vector, *bends: la.Matrix) -> la.Matrix:
    """m − ½Δt ad*(Π_{n+1}) H − Σ bends at Θ, with ½Δt Π_{n+1} = mΘ − ½Δt Π_n − F.

    Derivatives do not pass through it.
    """
    group, tau = equation.group, equation.tau
    theta, F, known, m = lax.stop_gradient((theta, F, equation.known, equation.m))
    turned = ad_star_matrix(group, m @ theta - known - F) @ slope(tau, group, theta)
    return functools.reduce(operator.sub, bends, m - turned)


def force_jacobian(m: la.Matrix, system: AbstractMechanicalSystem, where: Array, factor: ArrayLike) -> la.Matrix:
    """factor D², with D² the derivative of the body force along the group at `where`, held fixed; of the form of m."""
    group, where = system.group, lax.stop_gradient(where)
    zero = jnp.zeros(group.dim, where.dtype)
    D2 = jax.jacfwd(lambda x: system.body_force(where + group.tangent(where, x)))(zero)
    D2 = lax.stop_gradient(factor * D2)
    return as_vector(m, D2)


def size_unit(m: la.Matrix, a: la.Vector) -> Callable[[la.Vector], Array]:
    """F ↦ the largest |Fᵢ|/√mᵢᵢ over √(2H)Δt, which does not depend on the units of the basis."""
    a, m = lax.stop_gradient((a, m))
    scale = 2 * jnp.sqrt(jnp.maximum(a @ la.solve(m, a), 0))
    units = [jnp.sqrt(m[i][i]) * jnp.where(scale == 0, 1, scale) for i in range(len(m))]

    def size(F: la.Vector) -> Array:
        return functools.reduce(jnp.maximum, (jnp.abs(lax.stop_gradient(F[i])) / units[i] for i in range(len(units))))

    return size


def digits_left(equation: Equation) -> Array:
    """Whether Ad*_q π has six digits left in float64: ε (size of summands / of sum)² ≤ ε^{3/8}; and likewise q."""
    group, m = equation.group, equation.m
    if not isinstance(group, AnalyticGroup):
        return jnp.ones((), bool)
    state, carried, half = lax.stop_gradient((equation.state, equation.carried, equation.half))
    unit = jnp.sqrt(jnp.stack([m[i][i] for i in range(len(m))]))
    summed = jnp.max(jnp.abs(half) * group.rounding(state.q, state.p) / unit)
    left = jnp.max(jnp.abs(la.as_array(carried, state.p)) / unit)
    eps = float(jnp.finfo(left.dtype).eps)
    return (eps * summed**2 <= eps**0.375 * left**2) & (group.drift(state.q) <= eps**0.375)
