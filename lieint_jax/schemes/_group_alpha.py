"""The algorithms of Result 14 on any group, with velocity at n+α and force at n+1−α (Section 5.4, Appendix B).

With Π_{n+α} = (1−α)Π_n + αΠ_{n+1}, one step is

    q_{n+1} = q_n τ(Θ),    π_{n+1} = π_n + Δt 𝓕(q_n, Θ),    Θ = Δt m⁻¹ Π_{n+α}          (5.43), (5.45) with its Δt
    𝓕(q_n, Θ) = −T*R dV(q_{n+1−α}),    q_{n+1−α} = q_n τ((1−α)Θ)

so that Ψ_n = (1−α)Δt m⁻¹ and Ψ_{n+1} = αΔt m⁻¹ (5.51). With the velocity at n+α the force is evaluated at n+1−α: on
abelian groups (5.46) and the conditions 1″ to 3″ of Result 14 then hold for every α. There is one equation for Θ,

    F(Θ) = m Θ − (1−α)Δt Π_n − αΔt Π_{n+1} = 0,    Π_{n+1} = Ad*_τ(Θ) (Π_n + Δt Ad*_{q_n} 𝓕)

and Newton's matrix is m − αΔt ad*(Π_{n+1}) H less the second derivative of V (`newton.chords`).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import concrete, count, fraction, named
from lieint_jax._numerics import small_linalg as la
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.maps import Tau, as_tau, exponential
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.group_newton import Equation, any_map, as_vector
from lieint_jax.systems._equations import AbstractGeodesicFlow, AbstractMechanicalSystem

__all__ = ["group_alpha"]

PROPERTIES = SchemeProperties(
    name="group_alpha",
    systems="matrix groups, with or without a potential",
    conserves=("momentum",),
    limit="where the map is injective",
    aliases=("α-family on T*G",),
    source="Lewis & Simo 1994, (5.43), Results 12 to 14",
    accepts=(AbstractGeodesicFlow, AbstractMechanicalSystem),
)


@pytree
class GroupAlpha(Step):
    """The class (5.43) of Result 14 with velocity at n+α and force at n+1−α, with or without a potential.

    | | α = ½ | another α |
    |---|---|---|
    | π without a potential; ⟨π, η⟩ for each left symmetry η of V (5.44) | exact | exact |
    | energy without a potential | exact (Result 10) | O(Δt²) per step |
    | energy with a potential | O(Δt³) per step (`group_energy_momentum` conserves it) | O(Δt²) per step |
    | symplectic form, abelian groups (1″ to 3″) | exact | exact |
    | symplectic form without a potential | as in `group_midpoint`: (5.31) | O(Δt²) per step |
    | symplectic form with a potential, other groups | O(Δt³) per step | O(Δt²) per step |
    | order | 2 | 1 |

    "Exact" is to round-off at a converged step. Without a potential the step of α = ½ is that of `group_midpoint`; on
    a group of translations it is the implicit midpoint rule for every potential, and α = 0 and 1 are the two symplectic
    Euler schemes. The inverse of a step of α is the step of 1 − α with −Δt if τ(−Θ) = τ(Θ)⁻¹ and if there is no
    potential or τ is the exponential map (or any map for which τ(sΘ) is a one-parameter group).

    `diagnostics.conditions` measures the three conditions of Result 14 for a step.

    Args:
        system: `systems.euler(group, metric)` or `systems.group_potential(...)`.
        alpha: α in [0, 1], a leaf of the step with respect to which it can be differentiated.
        tau: as in `group_midpoint`.
        iterations: the most Newton matrices per step, each used three times; α = 0 is explicit.

    Raises:
        ValueError: neither a geodesic flow nor a metric and a potential on a group; a τ that does not fit; α out of
            range; bad iterations.

    Source: Lewis & Simo 1994, Results 12 to 14, Appendix B; the place of the force: (6.5), (6.9) and (6.17).
    """

    system: AbstractGeodesicFlow | AbstractMechanicalSystem = argument(converter=PROPERTIES.check)
    alpha: Converted[Array] = argument(converter=named(fraction, "alpha"), default=0.5)
    tau: Converted[Tau] = argument(converter=any_map, default=exponential)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=8)
    order: float = static(init=False)
    symmetric: bool = static(init=False)
    loops = True

    def check_fields(self) -> dict[str, object]:
        tau = as_tau(self.tau, self.system.group)
        middle = tau.symmetric and (not concrete(self.alpha) or float(self.alpha) == 0.5)
        return {"tau": tau, "order": 2 if middle else 1, "symmetric": middle}

    @property
    def name(self) -> str:
        return f"group_alpha[{self.tau.name}]"

    @property
    def velocity_weight(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.alpha

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        system, alpha, q, dt = self.system, self.alpha, state.q, jnp.asarray(dt)
        equation, s = Equation.from_state(system, self.tau, state, 0.5 * dt), 0.5 * dt * dt
        m, a = equation.m, equation.a
        equation = equation._replace(known=2 * (1 - alpha) * a)
        if isinstance(system, AbstractGeodesicFlow):
            _, Theta, info = equation.root(lambda theta: 2 * alpha * equation.coadjoint(theta, a), self.iterations)
            return state._replace(q=equation.translate(Theta)), info

        def configuration(theta: la.Vector) -> Array:
            """q_{n+1−α}."""
            return equation.translate(la.as_array(theta, state.p), 1 - alpha)

        def force(theta: la.Vector) -> Array:
            """𝓕(q_n, Θ)."""
            return system.force(configuration(theta))

        def after(theta: la.Vector) -> la.Vector:
            """αΔt Π_{n+1}."""
            kick = as_vector(m, s * system.group.Ad_star(q, force(theta)))
            return 2 * alpha * equation.coadjoint(theta, a + kick)

        def bend(theta: la.Vector) -> la.Matrix:
            return equation.force_jacobian(system, configuration(theta), 2 * alpha * (1 - alpha) * s)

        theta, Theta, info = equation.root(after, self.iterations, as_vector(m, s * system.body_force(q)), bend)
        return state._replace(q=equation.translate(Theta), p=state.p + dt * force(theta)), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} on {self.system.group} does not converge at dt = {dt}: use a smaller dt, or more iterations "
            f"than {self.iterations}. If Ad_q is large, no digits of Π = Ad*_q π are left"
        )


@PROPERTIES.by_name
def examples(system: AbstractGeodesicFlow | AbstractMechanicalSystem) -> list[Step]:
    """The step of α = ½ by the exponential map, on small groups; it costs as much as `group_midpoint`."""
    return [group_alpha(system)] if system.group.dim <= 3 else []


group_alpha = GroupAlpha
