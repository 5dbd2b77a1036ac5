"""The energy-momentum midpoint scheme on any group (Section 5.2).

One step of the generalised Euler equations, for a map τ with Ad_τ(Θ) Θ = Θ, is

    q_{n+1} = q_n τ(Θ),    π_{n+1} = π_n,    Θ = Δt Ω_{n+½} = Δt m⁻¹ ½(Π_n + Π_{n+1})         (5.23), (5.27)

With Π_{n+1} = Ad*_τ(Θ) Π_n it is one equation for Θ in the algebra, solved by Newton's method from a second-order
guess, each matrix being used three times (`newton.chords`):

    F(Θ) = m Θ − ½Δt (Π_n + Ad*_τ(Θ) Π_n) = 0,    F′ = m − ½Δt ad*(Π_{n+1}) H(Θ)

where ad*(Π)ξ = ad*_ξ Π and H is the derivative of τ (5.28). F′ is (Δt/2) times the matrix of (5.30), times H.
Steps of SE(3) and its like take their Ad*_τ and τ in closed form (`groups._closed_form`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import checks, dense, newton
from lieint_jax.maps import Map, Tau, as_tau, cayley, derivative, exponential
from lieint_jax.types import Group, State, Step, StepInfo, System, pytree, static


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
        iterations: Newton matrices per step, at most.
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
        a = dense.settled(as_vector(m, half * group.Ad_star(state.q, state.p)))  # ½Δt Π_n
        unit = size_unit(m, a)

        def residual(theta: dense.Vector) -> dense.Vector:
            after = coadjoint(tau, group, theta, a)
            return dense.settled(dense.plus(dense.matvec(m, theta), (-1.0, a), (-1.0, after)))

        def factored(theta: dense.Vector, F: dense.Vector) -> dense.Factored:
            return dense.factored(newton_matrix(group, tau, m, theta, F, a))

        theta, (F, determinant) = newton.chords(residual, factored, unit, guess(group, m, a), self.iterations)
        good = (determinant > 0) & digits_left(group, m, state, a, half)  # past the fold of the branch it is negative
        Theta = dense.as_array(theta, state.p)
        info = report(unit(F), good & tau.holds(group, Theta) if tau.holds else good)
        return State(group.multiply(state.q, tau(group, Theta)), state.p), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        m, Pi = self.system.metric, np.asarray(self.system.group.Ad_star(state.q, state.p))
        Omega = Pi / m if m.ndim == 1 else np.linalg.solve(m, Pi)
        turn = float(np.abs(dt) * np.linalg.norm(Omega))
        return (
            f"{self.name} on {self.system.group} does not converge: |Δt Ω| = {turn:.3g} at dt = {dt}. Take a smaller "
            f"dt, or more iterations than {self.iterations} if |Δt Ω| < 1. If Ad_q is large, no digits of Π = Ad*_q π "
            "are left"
        )


def group_midpoint(system: Geodesic, tau: Tau | Map = exponential, iterations: int = 8) -> GroupMidpoint:
    """The generalised midpoint rule (5.23) with (5.27), for a geodesic system on any group and any map τ.

    Spatial momentum is exact, bit for bit (Result 9); energy is exact (Result 10). "Exact" is to round-off at a
    converged step. Second order and time-symmetric if τ(−Θ) = τ(Θ)⁻¹, which is measured; else `symmetric` is False and
    `order` 1. The symplectic form is kept if and only if (5.31) holds (Result 11), which `maps.symplectic_residual`
    measures; otherwise its defect is O(Δt³) per step.

    On groups that are not compact Ad_q can grow exponentially, and Π = Ad*_q π then loses digits with any scheme: at
    worst like ε‖Ad_q‖², and on SL(2) energy was seen to lose them like ε‖Ad_q‖. The step says `converged=False` where
    ε‖Ad_q‖² passes some 1e-6 (float64), or q has left the group by as much.

    Args:
        system: `systems.euler(group, metric)`.
        tau: `maps.exponential`, `maps.cayley` (where it lands in the group), `maps.arcsine`, or a map of your own
            (group, Θ) ↦ τ(Θ) with Ad_τ(Θ) Θ = Θ, which is checked at three random Θ. `compose`, `splitting` and
            `studies.reversible` take symmetric ones only.
        iterations: how many Newton matrices a step may take, each used three times. For |Δt Ω| ≤ .05 it takes 1, for
            ≤ .2 it takes 2, for ≤ .5 it takes 3; the largest of a batch decides. More than the 8 of the default are of
            use for |Δt Ω| > 1, or if the metric is far from round.

    Raises:
        ValueError: the system has no group and metric or has a potential; a τ that does not fit; bad iterations.

    Source: Lewis & Simo 1994, Results 9–11.
    """
    if not is_geodesic(system):
        raise ValueError(
            f"group_midpoint integrates geodesics on groups (systems.euler), got {type(system).__name__}; with a "
            "potential take group_energy_momentum"
        )
    tau = as_tau(tau, system.group)
    order = 2 if tau.symmetric else 1
    return GroupMidpoint(system, tau, checks.count("iterations", iterations, 1), order, tau.symmetric)


def examples(system: Any) -> dict[str, Step]:
    """The exponential map, and the Cayley map where it lands in the group."""
    if not is_geodesic(system):
        return {}
    maps = [exponential] + [cayley] * getattr(system.group, "cayley_lands", True)
    return {step.name: step for step in (group_midpoint(system, tau) for tau in maps)}


def is_geodesic(system: Any) -> bool:
    """Whether `system` has a group and a metric and no potential."""
    return hasattr(system, "metric") and hasattr(system, "group") and getattr(system, "potential", None) is None


# Shared with `group_energy_momentum`: vectors are lists for small groups, arrays for large ones, see `dense` --------


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


def ad_star(group: Any, xi: dense.Vector, mu: dense.Vector) -> dense.Vector:
    """ad*_ξ μ."""
    return dense.matvec(ad_star_matrix(group, mu), xi)


def ad_star_matrix(group: Any, mu: dense.Vector) -> dense.Matrix:
    """ad*(μ), (d, d)."""
    if hasattr(group, "ad_star_matrix"):
        return group.ad_star_matrix(mu)
    mu = dense.as_array(mu, mu[0])
    return dense.as_list(jax.vmap(group.ad_star, (1, None), 1)(jnp.eye(group.dim, dtype=mu.dtype), mu))


def coadjoint(tau: Tau, group: Any, theta: dense.Vector, mu: dense.Vector) -> dense.Vector:
    """Ad*_τ(Θ) μ."""
    if tau.coadjoint is not None:
        return tau.coadjoint(group, theta, mu)
    turned = group.Ad_star(tau(group, dense.as_array(theta, theta[0])), dense.as_array(mu, mu[0]))
    return dense.as_list(turned) if isinstance(theta, list) else turned


def slope(tau: Tau, group: Any, theta: dense.Vector) -> dense.Matrix:
    """H(Θ), (d, d)."""
    if tau.slope is not None:
        return tau.slope(group, theta)
    H = derivative(tau, group, dense.as_array(theta, theta[0]))
    return dense.as_list(H) if isinstance(theta, list) else H


def guess(group: Group, m: dense.Matrix, a: dense.Vector) -> dense.Vector:
    """Θ ≈ ΔtΩ + ½Δt² m⁻¹ ad*_Ω Π, from a = ½Δt Π: second order."""
    sharp = dense.factored(m).solve
    half_turn = dense.settled(sharp(a))
    bent = sharp(dense.settled(ad_star(group, half_turn, a)))
    return dense.settled(dense.plus((2.0, half_turn), (2.0, bent)))


def newton_matrix(
    group: Any, tau: Tau, m: dense.Matrix, theta: dense.Vector, F: dense.Vector, a: dense.Vector
) -> dense.Matrix:
    """F′ at Θ, with ½Δt Π_{n+1} = mΘ − ½Δt Π_n − F. Nothing is differentiated through it."""
    theta, F, a, m = lax.stop_gradient((theta, F, a, m))
    after = dense.settled(dense.plus(dense.matvec(m, theta), (-1.0, a), (-1.0, F)))
    turned = dense.matmul(ad_star_matrix(group, after), dense.settled(slope(tau, group, theta)))
    return dense.settled(dense.combination((1.0, m), (-1.0, turned)))


def size_unit(m: dense.Matrix, a: dense.Vector) -> Callable[[dense.Vector], Array]:
    """F ↦ the largest |Fᵢ|/√mᵢᵢ over √(2H)Δt: whatever the units of the basis, round-off is round-off."""
    a, m = lax.stop_gradient((a, m))
    scale = 2 * jnp.sqrt(jnp.maximum(dense.dot(a, dense.solve(m, a)), 0))
    units = [jnp.sqrt(m[i][i]) * jnp.where(scale == 0, 1, scale) for i in range(len(m))]

    def size(F: dense.Vector) -> Array:
        return functools.reduce(jnp.maximum, (jnp.abs(lax.stop_gradient(F[i])) / units[i] for i in range(len(units))))

    return size


def report(residual: Array, good: Array) -> StepInfo:
    """Converged if the residual, in the units of `size_unit`, is round-off, and all else is good."""
    return StepInfo(residual, (residual <= 32 * jnp.finfo(residual.dtype).eps) & good)


def digits_left(group: Any, m: dense.Matrix, state: State, a: dense.Vector, half: Array) -> Array:
    """Whether Ad*_q π keeps six digits in float64: ε (what it sums up / what is left)² ≤ ε^{3/8}; q too."""
    if not hasattr(group, "rounding"):
        return jnp.ones((), bool)
    state, a, half = lax.stop_gradient((state, a, half))
    unit = jnp.sqrt(jnp.stack([m[i][i] for i in range(len(m))]))
    summed = jnp.max(jnp.abs(half) * group.rounding(state.q, state.p) / unit)
    left = jnp.max(jnp.abs(dense.as_array(a, state.p)) / unit)
    eps = float(jnp.finfo(left.dtype).eps)
    return (eps * summed**2 <= eps**0.375 * left**2) & (group.drift(state.q) <= eps**0.375)
