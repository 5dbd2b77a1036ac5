"""The energy-momentum schemes of a rigid body with torques or with internal friction: an exact balance of power.

With Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}) = 2y, h = ½Θ = κ(|Θ̄|²) y, a = ½ΔtΠ_n, s = ¼Δt², one step is

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n + Δt Στ̄_k,    τ̄_k = Λ̄T̄_k,  Λ̄ = ½(Λ_n + Λ_{n+1})
    J y + κ y × J y = a + s ΣT̄_k                                                     (vector form)

for mean torques T̄_k given in the body. For a torque given in space, τ̄ = Λ_nT, T̄ = T − h × T. Since cay Θ Θ̄ = Θ̄,
for any torques and any κ

    ½ Π·J⁻¹Π |_n^{n+1} = Δt Ω̄·ΣT̄_k = Δt ω̄·Στ̄_k,    Ω̄ = Θ̄/Δt,  ω̄ = Λ_nΩ̄ = Λ_{n+1}Ω̄

so that with the work W_k = Δt Ω̄·T̄_k + ΔE_k of each law, E_k its energy, ½ Π·J⁻¹Π + ΣE_k − ΣW_k is constant.

With internal friction instead, π is constant, see `_shared.damped_midpoint`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.core import Function, State, Step, StepInfo, clock, labels, pytree, static
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.damped_midpoint import DampedMidpoint, advice
from lieint_jax.schemes._shared.inertia_in_time import advice_in_time, step_in_time
from lieint_jax.schemes._shared.torque_equation import TorqueEquation
from lieint_jax.systems._equations import AbstractDampedBody, AbstractTorquedBody, AbstractTorquedBodyInTime

__all__ = ["DampedMidpoint", "torqued_midpoint"]


@pytree
class TorquedMidpoint(Step):
    """The step made by `torqued_midpoint` for a body with a torque."""

    system: AbstractTorquedBody | AbstractTorquedBodyInTime
    kappa: Kappa
    iterations: int = static()
    order: float = static(default=2)
    symmetric: bool = static(default=True)
    loops = True

    @property
    def name(self) -> str:
        return f"torqued_midpoint[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state, fits = self.system.sampled(state, jnp.asarray(dt))
        if isinstance(self.system, AbstractTorquedBodyInTime):
            end, info = step_in_time(self.system, state, dt, lambda body, z: self._advance(body, z, dt))
        else:
            end, info = self._advance(self.system, state, dt)
        return end, info if fits is True else info._replace(converged=info.converged & fits)

    def _advance(self, system: AbstractTorquedBody, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """The step of a body of constant inertia."""
        equation = TorqueEquation.from_state(self.kappa, system, state, dt)
        rotation, torques, info = equation.solution(self.iterations)
        q = state.q + jnp.stack(so3.cayley_difference(state.q, rotation.h))
        rotation = rotation._replace(q_next=q)
        impulses = [] if torques.space is None else [torques.space]
        if torques.body is not None:
            impulses.append((so3.Ad(state.q, torques.body) + so3.Ad(q, torques.body)) / 2)
        end = state._replace(q=q, p=state.p + jnp.asarray(dt) * functools.reduce(jnp.add, impulses))
        works = [law.work(rotation, *found) for law, found in zip(equation.laws, torques.each, strict=True)]
        if state.work is not None:
            end = end._replace(work=state.work + sum(works))
        if state.extra is None:
            return end, info
        after = {law.key: each[2] for law, each in zip(equation.laws, torques.each, strict=True) if law.key is not None}
        counted = {"works": state.extra["works"] + jnp.stack(works)} if "works" in state.extra else {}
        return end._replace(extra=state.extra | after | counted), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        if not self.system.sampled(state, jnp.asarray(dt))[1]:
            return next(law.refusal(clock(state), dt) for law in self.system.laws if law.held)
        dtype = state.p.dtype
        number, q, vector = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (4,), (3,)))
        for name, law in zip(labels(self.system), self.system.laws, strict=True):
            now = functools.partial(law)  # of a function itself JAX would return what it has found before
            found = jax.eval_shape(now, number, q, vector).dtype if isinstance(law, Function) else dtype
            if jnp.issubdtype(found, jnp.floating) and found.itemsize < dtype.itemsize:
                return (
                    f"the torque {name} returns {found}, so that no step converges to round-off of {dtype}, the type "
                    "of the state: compute it in the type of its arguments"
                )
        in_time = isinstance(self.system, AbstractTorquedBodyInTime) and advice_in_time(self.system, state, dt)
        return in_time or advice(self, dt, "the torque is too stiff")


def torqued_midpoint(
    system: AbstractTorquedBody | AbstractTorquedBodyInTime | AbstractDampedBody,
    kappa: Kappa | Callable[[Array], Array] = kappa_cayley,
    iterations: int | None = None,
) -> TorquedMidpoint | DampedMidpoint:
    """The energy-momentum scheme of a rigid body with any torques, or with internal friction; for any κ.

    | balance of a step | to |
    |---|---|
    | ΔH = ΣW_k: the energy changes by the works of the laws, which `State.work` counts; H − W is constant | round-off |
    | Δπ = Δt Στ̄_k; with internal friction, π is constant | the impulse's rounding; bit for bit |
    | π plus the momenta of wheels and dampers is constant, where no other law acts | round-off |
    | drag, dampers, torquers, PD laws and friction dissipate energy in every step with Δt > 0 | exactly |

    The scheme is of second order and time-symmetric, also with dissipation, unless a law is not symmetric
    (`torques.hysteresis`, wheels with a limit of momentum). `schemes.compose` raises the order; its negative sub-steps
    add energy, so energy decreases over its whole steps only, while H − W is constant in each sub-step.
    `State.extra["works"]`, if it exists, counts the work of each law.

    The torque of a function is evaluated at t + ½Δt, at the attitude half-way, (q_n + q_{n+1})/|…|, and at ω̄. A law
    defines its own mean torque, such as that of a potential, whose balance is then exact too. A body whose inertia is a
    function of time moves in each step with J(t + ½Δt); `State.work` counts the changes of J at both ends too.

    Args:
        system: `systems.torqued_body(...)`, `systems.damped_body(...)`, or `systems.inertia_in_time(..., torque=...)`.
        kappa: κ as in `so3_midpoint`. The symplectic κ ends at |ΔtΩ| ≈ 1, the Cayley κ at 2 to 4.
        iterations: the most Newton corrections per step, by default 5. A step that does not converge reports
            `converged=False`.

    Raises:
        ValueError: the system is none of these, κ is not callable, iterations is not a positive int; at the start of a
            run, the state has no time, or the torque is not finite.

    Source: the identities of Lewis & Simo 1994, Results 1 to 3, with a torque: this package.
    """
    PROPERTIES.check(system)
    kappa = as_kappa(kappa)
    count = _checks.count("iterations", 5 if iterations is None else iterations, 1)
    if isinstance(system, AbstractDampedBody):
        return DampedMidpoint(system, kappa, count)
    return TorquedMidpoint(system, kappa, count, symmetric=all(law.symmetric for law in system.laws))


PROPERTIES = SchemeProperties(
    name="torqued_midpoint",
    systems="bodies with torques, also with J(t), or internal friction",
    conserves=("energy less work",),
    limit="|ΔtΩ| ≈ 1 for the symplectic κ, 2 to 4 for others",
    aliases=("energy–momentum midpoint rule",),
    source="Lewis & Simo 1994, Results 1 to 3, with torques: this package",
    accepts=(AbstractTorquedBody, AbstractDampedBody, AbstractTorquedBodyInTime),
)


@PROPERTIES.by_name
def examples(system: AbstractTorquedBody | AbstractTorquedBodyInTime | AbstractDampedBody) -> list[Step]:
    """The paper's three κ's, for bodies with a torque or with internal friction."""
    return [torqued_midpoint(system, kappa) for kappa in KAPPAS]
