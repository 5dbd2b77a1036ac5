"""The equation for Θ that the steps on any group solve: its guess, Newton's matrix, and the report on its root.

    m Θ − ½Δt (Π_n + Π_{n+1}) = 0                                                            (5.27)

Vectors are unrolled into scalars for small groups and arrays for large ones, see `_numerics.small_linalg`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.arrays import AlgebraVector
from lieint_jax._numerics.vectors import Matrix, components
from lieint_jax.core import AnalyticGroup, Group, State, StepInfo
from lieint_jax.maps import Map, Tau, derivative
from lieint_jax.systems._equations import AbstractMechanicalSystem, AbstractMetricSystem, AbstractRightGeodesicFlow


def any_map(tau: Tau | Map) -> Tau:
    """The converter of a field: τ as it is given. `as_tau` checks it on the group of the system, another field."""
    return cast("Tau", tau)


class Equation(NamedTuple):
    """The equation m Θ = known + ½Δt Π_{n+1} of one step by a map τ on a group."""

    group: Group
    tau: Tau
    m: la.Matrix  # the metric
    state: State  # where the step starts
    half: Array  # ½Δt
    a: la.Vector  # ½Δt Π_n; −½Δt π_n for a right-invariant metric, whose equation is that of the inverse of q
    known: la.Vector  # a, except for `group_alpha`
    carried: la.Vector  # ½Δt Ad*_q π, which on groups that are not compact can lose its digits

    @classmethod
    def from_state(cls, system: AbstractMetricSystem, tau: Tau, state: State, half: Array) -> Equation:
        """The equation of a step by τ, for a system with a group and a metric."""
        m = _unpacked(system.group, system.metric)
        carried = a = as_vector(m, half * system.group.Ad_star(state.q, state.p))
        if isinstance(system, AbstractRightGeodesicFlow):
            a = as_vector(m, -half * state.p)
        return cls(system.group, tau, m, state, half, a, a, carried)

    def root(
        self,
        after: Callable[[la.Vector], la.Vector],
        iterations: int,
        pull: la.Vector | None = None,
        bend: Callable[[la.Vector], la.Matrix] | None = None,
    ) -> tuple[la.Vector, Array, StepInfo]:
        """Θ by `newton.chords`, as a vector of the equation and as an array, and the report on it.

        It reports convergence if the residual is round-off; if the solve was steady and the root lies before the fold,
        so that it is on the branch from Δt = 0; if digits are left; and if τ(Θ) is exact.

        Args:
            after: Θ ↦ ½Δt Π_{n+1}.
            iterations: the most matrices.
            pull: ½Δt² times a force in the body at the start; None without a force.
            bend: Θ ↦ the derivative of `after` by way of the force.
        """
        a, m, sharp = self.a, self.m, la.factored(self.m).solve
        largest, mean = a, a
        if pull is not None:
            largest, mean = la.map_entries(lambda x, y: jnp.maximum(jnp.abs(x), jnp.abs(y)), a, pull), a + 0.5 * pull
        size = self._size(largest)
        u = sharp(mean)  # Θ ≈ ΔtΩ + ½Δt² m⁻¹ ad*_Ω Π
        guess = 2.0 * u + 2.0 * sharp(ad_star_matrix(self.group, mean) @ u)

        def residual(theta: la.Vector) -> la.Vector:
            return m @ theta - self.known - after(theta)

        def factored(theta: la.Vector, F: la.Vector) -> la.Factored:
            """Newton's matrix, through which derivatives do not pass, with ½Δt Π_{n+1} = mΘ − known − F."""
            theta, F, known, metric = lax.stop_gradient((theta, F, self.known, m))
            K = metric - ad_star_matrix(self.group, metric @ theta - known - F) @ self.slope(theta)
            return la.factored(K if bend is None else K - bend(theta))

        units = as_vector(m, self._units)
        theta, F, good = newton.chords(residual, factored, size, lambda step: size(m @ step), units, guess, iterations)
        good = good & self._digits_left()
        Theta = la.as_array(theta, self.state.p)
        good = good & self.tau.holds(self.group, Theta) if self.tau.holds else good
        return theta, Theta, StepInfo.of_root(size(F), good)

    def coadjoint(self, theta: la.Vector, mu: la.Vector) -> la.Vector:
        """Ad*_τ(Θ) μ."""
        if self.tau.coadjoint is not None:
            return self.tau.coadjoint(self.group, theta, mu)
        turned = self.group.Ad_star(self.tau(self.group, la.as_array(theta, theta[0])), la.as_array(mu, mu[0]))
        return as_vector(theta, turned)

    def translate(self, Theta: AlgebraVector, s: ArrayLike = 1.0) -> Array:
        """q_n τ(sΘ) for a number s, or at each of several, (k,), as one array."""
        group, tau, q, s = self.group, self.tau, self.state.q, jnp.asarray(s, Theta.dtype)
        if tau.along is not None:
            return tau.along(group, q, Theta, s)
        return la.at_each(lambda s: group.multiply(q, tau(group, s * Theta)), s)

    def slope(self, theta: la.Vector, exact: bool = False) -> la.Matrix:
        """H(Θ), (d, d)."""
        formula = self.tau.exact_slope if exact else self.tau.slope
        closed = None if formula is None else formula(self.group, theta)
        if closed is not None:
            return closed
        return as_vector(theta, derivative(self.tau, self.group, la.as_array(theta, theta[0])))

    def force_jacobian(self, system: AbstractMechanicalSystem, where: Array, factor: ArrayLike) -> la.Matrix:
        """factor D², with D² the derivative of the body force along the group at `where`, held fixed."""
        group, where = self.group, lax.stop_gradient(where)
        zero = jnp.zeros(group.dim, where.dtype)
        D2 = jax.jacfwd(lambda x: system.body_force(where + group.tangent(where, x)))(zero)
        return as_vector(self.m, lax.stop_gradient(factor * D2))

    @property
    def _units(self) -> Array:
        """√mᵢᵢ, (d,): times Θᵢ they do not depend on the units of the basis."""
        return lax.stop_gradient(jnp.sqrt(jnp.stack([self.m[i][i] for i in range(len(self.m))])))

    def _size(self, a: la.Vector) -> Callable[[la.Vector], Array]:
        """F ↦ the largest |Fᵢ|/√mᵢᵢ over √(2H)Δt, which does not depend on the units of the basis."""
        a, m = lax.stop_gradient((a, self.m))
        scale = 2 * jnp.sqrt(jnp.maximum(a @ la.solve(m, a), 0))
        units = [jnp.sqrt(m[i][i]) * jnp.where(scale == 0, 1, scale) for i in range(len(m))]

        def size(F: la.Vector) -> Array:
            return functools.reduce(
                jnp.maximum, (jnp.abs(lax.stop_gradient(F[i])) / units[i] for i in range(len(units)))
            )

        return size

    def _digits_left(self) -> Array:
        """Whether Ad*_q π has six digits left in float64: ε (size of summands / of sum)² ≤ ε^{3/8}; and likewise q."""
        group = self.group
        if not isinstance(group, AnalyticGroup):
            return jnp.ones((), bool)
        state, carried, half = lax.stop_gradient((self.state, self.carried, self.half))
        unit = self._units
        summed = jnp.max(jnp.abs(half) * group.rounding(state.q, state.p) / unit)
        left = jnp.max(jnp.abs(la.as_array(carried, state.p)) / unit)
        eps = float(jnp.finfo(left.dtype).eps)
        return (eps * summed**2 <= eps**0.375 * left**2) & (group.drift(state.q) <= eps**0.375)


def _unpacked(group: Group, metric: Array) -> la.Matrix:
    """The metric as a matrix: unrolled for small groups, an array for large ones."""
    if isinstance(group, AnalyticGroup) and not group.unrolled:
        return jnp.diag(metric) if metric.ndim == 1 else metric
    if metric.ndim == 2:
        return la.unrolled(metric)
    return Matrix((x if i == j else 0.0 for j in range(len(metric))) for i, x in enumerate(components(metric)))


def as_vector(m: la.Matrix, x: Array) -> la.Vector:
    """An array in the form of m: unrolled, or unchanged."""
    return x if isinstance(m, Array) else la.unrolled(x)


def ad_star_matrix(group: Group, mu: la.Vector) -> la.Matrix:
    """ad*(μ), (d, d), with ad*(μ)ξ = ad*_ξ μ."""
    if isinstance(group, AnalyticGroup):
        return group.ad_star_matrix(mu)
    mu = la.as_array(mu, mu[0])
    return la.unrolled(jax.vmap(group.ad_star, (1, None), 1)(jnp.eye(group.dim, dtype=mu.dtype), mu))
