"""An energy-momentum scheme for any potential on any group (Section 5.4, Result 13, with a new discrete force).

    q_{n+1} = q_n exp Θ,    π_{n+1} = π_n + Δt 𝓕,    Θ = Δt m⁻¹ ½(Π_n + Π_{n+1})               (5.43), (5.27)
    𝓕 = −∫₀¹ T*R dV(q_n exp(sΘ)) ds

Since d/ds V(q_n exp(sΘ)) = ⟨T*R dV, Ad_{q_n} Θ⟩, it holds that Δt⟨𝓕, Ad_{q_n} Ω_{n+½}⟩ = V(q_n) − V(q_{n+1}), which is
(5.49), for every V and every group; and 𝓕 has the symmetries of V. The integral is computed by five Gauss nodes. There
is one equation for Θ,

    F(Θ) = m Θ − ½Δt Π_n − Ad*_exp(Θ) ½Δt (Π_n + Δt Ad*_{q_n} 𝓕) = 0

and Newton's matrix is that of `group_midpoint` with the second derivative of V at the middle of the step
(`newton.chords`).
"""

from __future__ import annotations

from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import count, named
from lieint_jax._numerics import small_linalg as la
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.maps import Tau, as_tau, exponential
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.group_newton import Equation, as_vector
from lieint_jax.systems._equations import AbstractMechanicalSystem

__all__ = ["group_energy_momentum"]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2

PROPERTIES = SchemeProperties(
    name="group_energy_momentum",
    systems="matrix groups with a potential",
    conserves=("energy", "momentum"),
    limit="where the map is injective",
    aliases=("energy–momentum method on T*G",),
    source="Lewis & Simo 1994, (5.49), Result 13",
    accepts=(AbstractMechanicalSystem,),
)


@pytree
class GroupEnergyMomentum(Step):
    """An energy–momentum scheme for any potential on any matrix group.

    | conserved | to |
    |---|---|
    | energy | round-off, where five Gauss nodes integrate dV along a step to round-off: their error is O(Δt¹¹) |
    | ⟨π, η⟩ for each left symmetry η of V | round-off |
    | the symplectic form | no: defect O(Δt³) per step (Result 8); `splitting` with a symplectic drift conserves it |

    The scheme is of second order and time-symmetric.

    Args:
        system: `systems.group_potential(...)`.
        iterations: the most Newton matrices per step, each used three times. A step that does not converge reports
            `converged=False`.

    Raises:
        ValueError: not a metric and a potential on a group; bad iterations.

    Source: Lewis & Simo 1994, Result 13; the discrete force: this package.
    """

    system: AbstractMechanicalSystem = argument(converter=PROPERTIES.check)
    tau: Tau = field(init=False)  # the exponential map
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=6)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)
    loops = True

    def check_fields(self) -> dict[str, Tau]:
        return {"tau": as_tau(exponential, self.system.group)}

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        system, dt = self.system, jnp.asarray(dt)
        equation, s = Equation.from_state(system, self.tau, state, 0.5 * dt), 0.5 * dt * dt
        m, a = equation.m, equation.a
        pull = as_vector(m, s * system.body_force(state.q))  # what the kick is, nearly

        def configurations(theta: la.Vector, s: ArrayLike) -> Array:
            """q_n exp(sΘ) at each s."""
            return equation.translate(la.as_array(theta, state.p), s)

        def force(curve: Array) -> Array:
            """𝓕(q_n, Θ), from the nodes of the curve."""
            return jnp.tensordot(jnp.asarray(_WEIGHTS, state.p.dtype), jax.vmap(system.force)(curve), 1)

        def after(theta: la.Vector) -> la.Vector:
            """½Δt Π_{n+1}."""
            kick = system.group.Ad_star(state.q, force(configurations(theta, _NODES)))
            return equation.coadjoint(theta, a + as_vector(m, s * kick))

        def bend(theta: la.Vector) -> la.Matrix:
            return equation.force_jacobian(system, configurations(theta, 0.5), s / 2)

        theta, _, info = equation.root(after, self.iterations, pull, bend)
        curve = configurations(theta, np.append(_NODES, 1.0))
        return state._replace(q=curve[-1], p=state.p + dt * force(curve[:-1])), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} on {self.system.group} does not converge at dt = {dt}: use a smaller dt, or more iterations "
            f"than {self.iterations} if the potential is stiff"
        )


@PROPERTIES.by_name
def examples(system: AbstractMechanicalSystem) -> list[Step]:
    """The energy-momentum step, for systems with a potential on a group."""
    return [group_energy_momentum(system)]


group_energy_momentum = GroupEnergyMomentum
