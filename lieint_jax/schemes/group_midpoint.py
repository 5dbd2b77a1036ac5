"""The energy-momentum midpoint scheme on any group (Section 5.2).

One step of the generalised Euler equations, for a map τ with Ad_τ(Θ) Θ = Θ, is

    q_{n+1} = q_n τ(Θ),    π_{n+1} = π_n,    Θ = Δt Ω_{n+½} = Δt m⁻¹ ½(Π_n + Π_{n+1})         (5.23), (5.27)

With Π_{n+1} = Ad*_τ(Θ) Π_n it is one equation for Θ in the algebra, solved by Newton's method from a second-order
guess, each matrix being used three times:

    F(Θ) = m Θ − ½Δt (Π_n + Ad*_τ(Θ) Π_n) = 0,    F′ = m − ½Δt ad*(Π_{n+1}) H(Θ)

where ad*(Π)ξ = ad*_ξ Π and H is the derivative of τ (5.28). F′ is (Δt/2) times the matrix of (5.30), times H.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import checks, dense, newton
from lieint_jax.maps import Map, Tau, as_tau, cayley, derivative, exponential
from lieint_jax.types import Group, State, Step, StepInfo, System, pytree, static

_USES = 3  # of each Newton matrix


class Geodesic(System, Protocol):
    """A system on T*G that is all kinetic energy of a left-invariant metric."""

    @property
    def group(self) -> Group: ...
    @property
    def metric(self) -> Array: ...


@pytree
class GroupMidpoint(Step):
    """The step made by `group_midpoint`.

    Attributes:
        system: anything with a `group` and a `metric` and no potential.
        tau: the map τ.
        iterations: Newton matrices a step.
    """

    system: Geodesic
    tau: Tau
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"group_midpoint[{self.tau.name}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        group, tau, m = self.system.group, self.tau, unpacked(self.system.group, self.system.metric)
        half = 0.5 * checks.step_size(dt)
        a = lax.optimization_barrier(half * group.Ad_star(state.q, state.p))  # ½Δt Π_n

        def residual(theta: Array) -> Array:
            return applied(m, theta) - a - group.Ad_star(tau(group, theta), a)

        def correction(theta: Array, F: Array) -> Array:
            """One matrix, used three times: order four."""
            inverse, start = dense.inverse_definite(newton_matrix(group, tau, m, theta, F, a)), theta
            for use in range(_USES):
                F = lax.optimization_barrier(residual(theta) if use else F)
                theta = theta - dense.as_array(dense.matvec(inverse, as_vector(m, F)), F)
            return start - theta

        theta, F = newton.root(residual, correction, guess(group, m, a), self.iterations, unroll=False)
        good = on_branch(newton_matrix(group, tau, m, theta, F, a)) & digits_left(group, m, state, a, half)
        info = report(m, F, a, good & tau.holds(group, theta) if tau.holds else good)
        return State(group.multiply(state.q, tau(group, theta)), state.p), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        m, Pi = self.system.metric, np.asarray(self.system.group.Ad_star(state.q, state.p))
        Omega = Pi / m if m.ndim == 1 else np.linalg.solve(m, Pi)
        turn = float(np.abs(dt) * np.linalg.norm(Omega))
        return (
            f"{self.name} on {self.system.group} does not converge: |Δt Ω| = {turn:.3g} at dt = {dt}. Take a smaller "
            f"dt, or more iterations than {self.iterations} if |Δt Ω| < 1. If Ad_q is large, no digits of Π = Ad*_q π "
            "are left"
        )


def group_midpoint(system: Geodesic, tau: Tau | Map = exponential, iterations: int | None = None) -> GroupMidpoint:
    """The generalised midpoint rule (5.23) with (5.27), for a geodesic system on any group and any map τ.

    Spatial momentum is exact, bit for bit (Result 9); energy is exact (Result 10). "Exact" is to round-off at a
    converged step. Second order, time-symmetric if τ(−Θ) = τ(Θ)⁻¹. The symplectic form is kept if and only if (5.31)
    holds (Result 11), which `maps.symplectic_residual` measures; otherwise its defect is O(Δt³) a step.

    On groups that are not compact Ad_q can grow exponentially, and Π = Ad*_q π then loses digits, like ε‖Ad_q‖², with
    any scheme. The step says `converged=False` where fewer than six digits are left (float64).

    Args:
        system: `systems.euler(group, metric)`.
        tau: `maps.exponential`, `maps.cayley` (where it lands in the group), `maps.arcsine`, or a map of your own
            (group, Θ) ↦ τ(Θ) with Ad_τ(Θ) Θ = Θ, which is checked at three random Θ.
        iterations: Newton matrices a step, each used three times; by default 3. 1 reaches round-off for |Δt Ω| ≤ .05,
            2 for ≤ .2, 3 for ≤ .5; more if the metric is far from round.

    Raises:
        ValueError: the system has no group and metric or has a potential; a τ that does not fit; bad iterations.

    Source: Lewis & Simo 1994, Results 9–11.
    """
    if not is_geodesic(system):
        raise ValueError(
            f"group_midpoint integrates geodesics on groups (systems.euler), got {type(system).__name__}; with a "
            "potential take group_energy_momentum"
        )
    iterations = 3 if iterations is None else iterations
    return GroupMidpoint(system, as_tau(tau, system.group), checks.count("iterations", iterations, 1))


def examples(system: Any) -> dict[str, Step]:
    """The exponential map, and the Cayley map where it lands in the group."""
    if not is_geodesic(system):
        return {}
    maps = [exponential] + [cayley] * getattr(system.group, "cayley_lands", True)
    return {step.name: step for step in (group_midpoint(system, tau) for tau in maps)}


def is_geodesic(system: Any) -> bool:
    """Whether `system` has a group and a metric and no potential."""
    return hasattr(system, "metric") and hasattr(system, "group") and getattr(system, "potential", None) is None


# Shared with `group_energy_momentum` ---------------------------------------------------------------------------------


def unpacked(group: Any, metric: Array) -> dense.Matrix:
    """The metric as a matrix: a list of rows for small groups, an array for large ones."""
    d = metric.shape[0]
    if not getattr(group, "unrolled", True):
        return jnp.diag(metric) if metric.ndim == 1 else metric
    if metric.ndim == 2:
        return dense.as_list(metric)
    return [[metric[i] if i == j else 0.0 for j in range(d)] for i in range(d)]


def as_vector(m: dense.Matrix, x: Array) -> dense.Vector:
    """x as a list if m is one."""
    return dense.as_list(x) if isinstance(m, list) else x


def applied(m: dense.Matrix, xi: Array) -> Array:
    """m ξ."""
    return dense.as_array(dense.matvec(m, as_vector(m, xi)), xi)


def lowered(m: dense.Matrix, mu: Array) -> Array:
    """m⁻¹ μ."""
    return dense.as_array(dense.solve(m, as_vector(m, mu)), mu)


def ad_star_matrix(group: Any, mu: Array) -> dense.Matrix:
    """ad*(μ), (d, d)."""
    if hasattr(group, "ad_star_matrix"):
        return group.ad_star_matrix(dense.as_list(mu) if group.unrolled else mu)
    return dense.as_list(jax.vmap(group.ad_star, (1, None), 1)(jnp.eye(group.dim, dtype=mu.dtype), mu))


def slope(tau: Tau, group: Any, theta: Array) -> dense.Matrix:
    """H(Θ), (d, d)."""
    if tau.slope is not None:
        return tau.slope(group, dense.as_list(theta) if group.unrolled else theta)
    H = derivative(tau, group, theta)
    return dense.as_list(H) if getattr(group, "unrolled", True) else H


def guess(group: Group, m: dense.Matrix, a: Array) -> Array:
    """Θ ≈ ΔtΩ + ½Δt² m⁻¹ ad*_Ω Π, from a = ½Δt Π: second order."""
    half_turn = lax.optimization_barrier(lowered(m, a))
    return 2 * (half_turn + lowered(m, group.ad_star(half_turn, a)))


def newton_matrix(group: Any, tau: Tau, m: dense.Matrix, theta: Array, F: Array, a: Array) -> dense.Matrix:
    """F′ at Θ, with ½Δt Π_{n+1} = mΘ − ½Δt Π_n − F. Nothing is differentiated through it."""
    theta, F, a, m = lax.stop_gradient((theta, F, a, m))
    after = lax.optimization_barrier(applied(m, theta) - a - F)
    turned = dense.matmul(ad_star_matrix(group, after), slope(tau, group, theta))
    return dense.combination((1.0, m), (-1.0, turned))


def on_branch(K: dense.Matrix) -> Array:
    """Whether det F′ > 0, as at Θ = 0: roots past the fold of the branch have the other sign."""
    return dense.determinant(K) > 0


def report(m: dense.Matrix, F: Array, a: Array, good: Array) -> StepInfo:
    """The largest |Fᵢ|/√mᵢᵢ over √(2H)Δt: whatever the units of the basis, round-off is round-off."""
    F, a = lax.stop_gradient((F, a))
    unit = jnp.sqrt(jnp.stack([m[i][i] for i in range(len(m))]))
    scale = 2 * jnp.sqrt(jnp.maximum(jnp.sum(a * lowered(lax.stop_gradient(m), a)), 0))
    size = jnp.max(jnp.abs(F) / unit)
    residual = jnp.where(size == 0, 0, size / jnp.where(scale == 0, 1, scale))
    return StepInfo(residual, (residual <= 32 * jnp.finfo(F.dtype).eps) & good)


def digits_left(group: Any, m: dense.Matrix, state: State, a: Array, half: Array) -> Array:
    """Whether Ad*_q π keeps six digits in float64: ε (what it sums up / what is left)² ≤ ε^{3/8}."""
    if not hasattr(group, "rounding"):
        return jnp.ones((), bool)
    state, a, half = lax.stop_gradient((state, a, half))
    unit = jnp.sqrt(jnp.stack([m[i][i] for i in range(len(m))]))
    summed = jnp.max(jnp.abs(half) * group.rounding(state.q, state.p) / unit)
    left = jnp.max(jnp.abs(a) / unit)
    eps = float(jnp.finfo(a.dtype).eps)
    return eps * summed**2 <= eps**0.375 * left**2
