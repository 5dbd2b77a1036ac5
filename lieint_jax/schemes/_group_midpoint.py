"""The energy-momentum midpoint scheme on any group (Section 5.2).

One step of the generalized Euler equations, for a map τ with Ad_τ(Θ) Θ = Θ, is

    q_{n+1} = q_n τ(Θ),    π_{n+1} = π_n,    Θ = Δt Ω_{n+½} = Δt m⁻¹ ½(Π_n + Π_{n+1})         (5.23), (5.27)

With Π_{n+1} = Ad*_τ(Θ) Π_n it is one equation for Θ in the algebra, solved by Newton's method from a second-order
guess, each matrix being used three times (`newton.chords`):

    F(Θ) = m Θ − ½Δt (Π_n + Ad*_τ(Θ) Π_n) = 0,    F′ = m − ½Δt ad*(Π_{n+1}) H(Θ)

where ad*(Π)ξ = ad*_ξ Π and H is the derivative of τ (5.28). F′ is (Δt/2) times the matrix of (5.30), times H.

A right-invariant metric is a left-invariant one for q⁻¹, whose body momentum is −π and whose spatial momentum is −Π. So
the same equation, with −½Δt π_n for ½Δt Π_n, gives q_{n+1} = τ(Θ)⁻¹ q_n and π_{n+1} = Ad*_τ(Θ) π_n.

On SE(3) and similar groups Ad*_τ and τ are computed in closed form (`groups.closed_forms`).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import count, named
from lieint_jax._numerics import small_linalg as la
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.maps import Tau, as_tau, cayley, cayley_lands, exponential
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.group_newton import Equation, ad_star_matrix, any_map, as_vector
from lieint_jax.systems._equations import AbstractGeodesicFlow, AbstractRightGeodesicFlow

__all__ = ["group_midpoint"]

PROPERTIES = SchemeProperties(
    name="group_midpoint",
    systems="geodesics of any matrix group",
    conserves=("energy", "momentum", "form (where the map is symplectic)"),
    limit="where the map is injective",
    aliases=("midpoint rule on T*G",),
    source="Lewis & Simo 1994, (5.23) to (5.27), Results 9 to 11",
    accepts=(AbstractGeodesicFlow, AbstractRightGeodesicFlow),
    instead="; with a potential use group_energy_momentum",
)


@pytree
class GroupMidpoint(Step):
    """The generalized midpoint rule (5.23) with (5.27), for a geodesic system on any group and any map τ.

    Spatial momentum is conserved bit for bit (Result 9), and energy to round-off at a converged step (Result 10);
    rounding errors add up, to 1.3e-10 of the energy in 10⁵ steps of `systems.kirchhoff()` with Δt = 0.1. The scheme is
    of second order and time-symmetric if τ(−Θ) = τ(Θ)⁻¹, which is measured; otherwise `symmetric` is False and `order`
    1. The symplectic form is conserved if and only if (5.31) holds (Result 11), which `maps.symplectic_residual`
    measures; otherwise its defect is O(Δt³) per step.

    For a right-invariant metric the body momentum Π = Ad*_q π is conserved instead, to round-off.

    On groups that are not compact, Ad_q can grow exponentially, and Π = Ad*_q π then loses digits with any scheme. The
    worst case is ε‖Ad_q‖²; for the energy on SL(2) a growth like ε‖Ad_q‖ was observed. The step reports
    `converged=False` where ε‖Ad_q‖² exceeds about 1e-6 (float64), or q has left the group by as much.

    Args:
        system: `systems.euler(group, metric)`, left- or right-invariant.
        tau: `maps.exponential`, `maps.cayley` (where it lands in the group), `maps.arcsine`, or a custom map
            (group, Θ) ↦ τ(Θ) with Ad_τ(Θ) Θ = Θ, which is checked at three random Θ. `compose`, `splitting` and
            `li.ReversibleAdjoint` accept symmetric maps only.
        iterations: the most Newton matrices per step, each used three times. For |Δt Ω| ≤ 0.05 a step needs 1, for
            ≤ 0.2 it needs 2, for ≤ 0.5 it needs 3; the largest number in a batch decides. More than the default of 8
            help where |Δt Ω| > 1, or if the eigenvalues of the metric differ much.

    Raises:
        ValueError: not a geodesic flow; a τ that does not fit; bad iterations.

    Source: Lewis & Simo 1994, Results 9–11.
    """

    system: AbstractGeodesicFlow | AbstractRightGeodesicFlow = argument(converter=PROPERTIES.check)
    tau: Converted[Tau] = argument(converter=any_map, default=exponential)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=8)
    order: float = static(init=False)
    symmetric: bool = static(init=False)
    loops = True

    def check_fields(self) -> dict[str, object]:
        tau = as_tau(self.tau, self.system.group)
        return {"tau": tau, "order": 2 if tau.symmetric else 1, "symmetric": tau.symmetric}

    @property
    def name(self) -> str:
        return f"group_midpoint[{self.tau.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        equation, theta, Theta, info = self._solution(state, dt)
        if isinstance(self.system, AbstractGeodesicFlow):
            return state._replace(q=equation.translate(Theta)), info
        group = self.system.group
        after = la.as_array(equation.coadjoint(theta, as_vector(theta, state.p)), state.p)
        return state._replace(q=group.multiply(group.inverse(self.tau(group, Theta)), state.q), p=after), info

    def _solution(self, state: State, dt: ArrayLike) -> tuple[Equation, la.Vector, Array, StepInfo]:
        """The equation for Θ, its root as a vector of the equation and as an array, and the report on it."""
        equation = Equation.from_state(self.system, self.tau, state, 0.5 * jnp.asarray(dt))
        return equation, *equation.root(lambda theta: equation.coadjoint(theta, equation.a), self.iterations)

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        """(m − ½Δt ad*(Π_{n+1}) H) δΘ = ½Δt (δΠ_n + δ'Π_{n+1}) with δΠ = Ad*_q (δπ + ad*_δθ π) at fixed Θ."""
        if not isinstance(self.system, AbstractGeodesicFlow):
            return super().advance_tangents(state, dt, T)
        group, d = self.system.group, self.system.group.dim
        equation, theta, Theta, info = self._solution(state, dt)
        m, H = equation.m, equation.slope(theta, exact=True)
        K = la.factored(m - ad_star_matrix(group, m @ theta - equation.a) @ H)
        end = state._replace(q=equation.translate(Theta))

        def propagate(tangent: Array) -> Array:
            p = equation.half * (tangent[d:] + group.ad_star(tangent[:d], state.p))
            turned = as_vector(m, group.Ad_star(state.q, p) + group.Ad_star(end.q, p))
            rotation = la.as_array(H @ K.solve(turned), state.p)
            return jnp.concatenate([tangent[:d] + group.Ad(end.q, rotation), tangent[d:]])

        return end, info, lax.map(propagate, T.T).T

    def advice(self, state: State, dt: ArrayLike) -> str:
        m, left = self.system.metric, isinstance(self.system, AbstractGeodesicFlow)
        Pi = np.asarray(self.system.group.Ad_star(state.q, state.p) if left else state.p)
        Omega = Pi / m if m.ndim == 1 else np.linalg.solve(m, Pi)
        turn = float(np.abs(dt) * np.linalg.norm(Omega))
        return (
            f"{self.name} on {self.system.group} does not converge: |Δt Ω| = {turn:.3g} at dt = {dt}. Use a smaller "
            f"dt, or more iterations than {self.iterations} if |Δt Ω| < 1. If Ad_q is large, no digits of Π = Ad*_q π "
            "are left"
        )


@PROPERTIES.by_name
def examples(system: AbstractGeodesicFlow | AbstractRightGeodesicFlow) -> list[Step]:
    """The exponential map, and the Cayley map where it lands in the group."""
    return [group_midpoint(system, tau) for tau in [exponential] + [cayley] * cayley_lands(system.group)]


group_midpoint = GroupMidpoint
