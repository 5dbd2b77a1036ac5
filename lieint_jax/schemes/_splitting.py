"""Strang splitting, kick–drift–kick: a symplectic scheme for systems with a potential, unlike those of Section 4.

    π ← π + ½Δt F(q, t),    (q, π, t) ← a step of the same system without its potential,    π ← π + ½Δt F(q, t)
    W ← W + ½Δt ∂V/∂t                                                                       W ← W + ½Δt ∂V/∂t

Each kick is the exact flow of the potential, and the drift is a symplectic step of the kinetic energy, so both conserve
the form, and every momentum map that the potential conserves. The step is the flow of a nearby Hamiltonian, so the
error of the energy is bounded and does not drift. For a gyrostat rotations replace the kicks; the drift of an elastic
body is a straight line. Many bodies drift, are kicked, and drift: their drift costs much less than their forces, which
are then evaluated once per step. The forces of a chain, such as a rod, cost less than its drift; the loop of a run
evaluates those at the end of a step for the next one, too.
"""

from __future__ import annotations

from typing import Any, overload

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._numerics.vectors import matrix, max_abs, symmetric
from lieint_jax.core import Group, State, Step, StepInfo, clock, pytree, static
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup
from lieint_jax.potentials import is_chain
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.default_drift import default_drift
from lieint_jax.schemes._shared.half_rotation import attitude_error_limit
from lieint_jax.systems._equations import (
    AbstractDrivenSystem,
    AbstractElasticBody,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractGyrostat,
    AbstractRigidBodies,
)

__all__ = ["GyrostatSplitting", "Splitting", "splitting"]

# Bodies from which a drift costs less than their forces: 19 and 310 µs for 64 molecules, 260 and 140 ns for two.
_MANY = 8


def _force(system: AbstractForcedSystem | AbstractDrivenSystem, state: State) -> Array:
    """The force at a state, which for a driven system is that at its time."""
    return system.force(state.q, clock(state)) if isinstance(system, AbstractDrivenSystem) else system.force(state.q)


def kick(system: AbstractForcedSystem | AbstractDrivenSystem, state: State, dt: ArrayLike) -> State:
    """The exact flow of the potential alone, at the time of the state."""
    if isinstance(system, AbstractDrivenSystem) and state.work is not None:
        state = state._replace(work=state.work + dt * system.power(state.q, clock(state)))
    return state._replace(p=state.p + dt * _force(system, state))


@pytree
class Splitting(Step):
    """The step made by `splitting`.

    Attributes:
        kick_first: whether a step begins and ends with half of the kick, or of the drift.
    """

    system: AbstractForcedSystem | AbstractDrivenSystem
    drift: Step
    kick_first: bool = static(default=True)
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"splitting[{self.drift.name}]"

    @property
    def reuses(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the force at the end serves the next step, too: for several bodies, of which it is expensive."""
        of_bodies = isinstance(self.system, AbstractRigidBodies) and not isinstance(self.system, AbstractDrivenSystem)
        return type(self) is Splitting and self.kick_first and of_bodies  # a subclass may have an `advance` of its own

    def reusable(self, state: State) -> Array:
        return _force(self.system, state)

    def advance_reusing(self, state: State, dt: ArrayLike, known: Array) -> tuple[State, StepInfo, Array]:
        state, info = self.drift.substep(state._replace(p=state.p + 0.5 * dt * known), dt)
        force = self.reusable(state)
        return state._replace(p=state.p + 0.5 * dt * force), info, force

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        if self.kick_first:
            state, info = self.drift.substep(self._kick(state, dt), dt)
            return self._kick(state, dt), info
        state, first = self.drift.substep(state, 0.5 * dt)
        state, last = self.drift.substep(kick(self.system, state, dt), 0.5 * dt)
        return state, first.merge(last)

    def advice(self, state: State, dt: ArrayLike) -> str:
        start, h = (self._kick(state, dt), dt) if self.kick_first else (state, 0.5 * dt)
        return f"{self.name}: {self.drift.advice(start, h)}"

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        space = self.system.phase_space
        if not (isinstance(space, CotangentGroup) and self.kick_first):
            return super().advance_tangents(state, dt, T)
        state, T = self._kick_tangent(space.group, state, dt, T)
        end, info, T = self.drift.tangent(state, dt, T)
        end, T = self._kick_tangent(space.group, end, dt, T)
        return end, info, T

    def _kick_tangent(self, group: Group, state: State, dt: ArrayLike, T: Array) -> tuple[State, Array]:
        """The state and its tangent vectors after a kick: δπ gains ½Δt times the derivative of the force."""

        def kick_derivative(tangent: Array) -> Array:
            theta, pi = jnp.split(tangent, 2)
            moved = group.spatial_tangent(state.q, theta)
            slope = jax.jvp(lambda q: _force(self.system, state._replace(q=q)), (state.q,), (moved,))[1]
            return jnp.concatenate([theta, pi + 0.5 * dt * slope])

        return self._kick(state, dt), jax.vmap(kick_derivative, -1, -1)(T)

    def _kick(self, state: State, dt: ArrayLike) -> State:
        return kick(self.system, state, 0.5 * dt)


@pytree
class GyrostatSplitting(Step):
    """The step that `splitting` makes for a gyrostat: rotation, drift, rotation.

        H = ½(Π − h_r)·J⁻¹(Π − h_r) = ½ Π·J⁻¹Π − c·Π + ½ h_r·c,    c = J⁻¹h_r

    −c·Π generates Λ ← Λ exp(−tĉ), π ← π, a rotation about an axis in the body, exactly and for every J. So one step is

        Λ ← Λ exp(−½Δt ĉ),    (Λ, π) ← a step of the free body,    Λ ← Λ exp(−½Δt ĉ)
    """

    system: AbstractGyrostat
    drift: Step
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"splitting[{self.drift.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state, info = self.drift.substep(self._turn(state, dt), dt)
        return self._turn(state, dt), self._report(info, state, dt)

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        state, info, T = self.drift.tangent(self._turn(state, dt), dt, T)  # turns about body axes leave (δθ, δπ)
        return self._turn(state, dt), self._report(info, state, dt), T

    def _report(self, info: StepInfo, state: State, dt: ArrayLike) -> StepInfo:
        known = jnp.finfo(state.q.dtype).eps * self._angle(dt) <= attitude_error_limit(state.q.dtype)
        return info._replace(converged=info.converged & known)

    def advice(self, state: State, dt: ArrayLike) -> str:
        turned = self._turn(state, dt)
        if not self.drift(turned, dt)[1].converged:
            return f"{self.name}: {self.drift.advice(turned, dt)}"
        return f"{self.name}: the rotor turns the body by {float(self._angle(dt)):.3g} rad in a step: use a smaller dt"

    def _turn(self, state: State, dt: ArrayLike) -> State:
        turn = so3.exp(jnp.asarray(-0.5 * dt) * _velocity(self.system))
        return state._replace(q=so3.normalize(so3.multiply(state.q, turn)))

    def _angle(self, dt: ArrayLike) -> Array:
        return lax.stop_gradient(jnp.abs(dt) * max_abs(_velocity(self.system)))


def _velocity(system: AbstractGyrostat) -> Array:
    """c = J⁻¹h_r."""
    return jnp.stack(symmetric(system.inertia).solve(system.rotor))


@pytree
class ElasticSplitting(Step):
    """The step that `splitting` makes for a pseudo-rigid body, on T*GL⁺(3): the central difference method.

        P ← P − ½Δt F S,  S = 2∇W(FᵀF),    F ← F + Δt P E⁻¹,    P ← P − ½Δt F S

    F S Fᵀ and P E⁻¹Pᵀ are symmetric, so neither a kick nor a drift changes rot[PFᵀ].
    """

    system: AbstractElasticBody
    order: float = static(default=2)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return "splitting"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state = self._kick(state, dt)
        F = state.q + dt * self.system.vector_field(state).q
        return self._kick(state._replace(q=F), dt), StepInfo(jnp.zeros((), F.dtype), matrix(F).det() > 0)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return f"{self.name} inverts the body (det F ≤ 0) at dt = {dt}: use a smaller dt, or schemes.additive"

    def _kick(self, state: State, dt: ArrayLike) -> State:
        return state._replace(p=state.p + 0.5 * dt * self.system.vector_field(state).p)


@overload
def splitting(system: AbstractGyrostat, drift: Step | None = None) -> GyrostatSplitting: ...
@overload
def splitting(system: AbstractElasticBody) -> ElasticSplitting: ...
@overload
def splitting(system: AbstractForcedSystem | AbstractDrivenSystem, drift: Step | None = None) -> Splitting: ...
def splitting(
    system: AbstractForcedSystem | AbstractDrivenSystem | AbstractGyrostat | AbstractElasticBody,
    drift: Step | None = None,
) -> Splitting | GyrostatSplitting | ElasticSplitting:
    """Strang splitting: kick–drift–kick for a system with any potential, rotation–drift–rotation for a gyrostat.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off, with a symplectic drift |
    | γ·π, if the potential has an axis γ; rot[PFᵀ] of an elastic body | round-off |
    | π, in a gyrostat | bit for bit |
    | energy; for a driven system, energy less work | O(Δt²), bounded, no drift |

    For a gyrostat the rotations are Λ ← Λ exp(−½Δt ĉ) with c = J⁻¹h_r: the exact flow of the rotor's part of H. A fast
    rotor reduces accuracy: with J = (1, 2, 3), |Ω| = 1 and Δt = 0.05 the relative error of the energy is 4e-5 at
    |h_r| = 0.8 and 3e-3 at 10. `so3_midpoint` conserves the energy of a gyrostat, but not the form.

    With eight bodies or more a step is half a drift, a kick, and half a drift, so that the forces between the bodies,
    which dominate the cost, are evaluated once per step. Of fewer bodies and of a rod they are evaluated once per step
    by `integrate` and `run`, twice by a single step.

    For an elastic body this is the central difference method (Störmer–Verlet): explicit, at a sixth of the cost of
    `additive`, and stable only for Δt < 2/ω, where ω is the frequency of the fastest vibration at the most deformed
    shape of the motion. `mooney_rivlin` with the inertia E·1 has ω² = (6λ + 2μ)/E at F = 1 (`diagnostics.normal_modes`
    computes it), and ω² ≈ 2λ|cof F|²/E far from it. Beyond the limit the energy grows without bound until a step
    inverts the body (det F ≤ 0) and reports `converged=False`.

    The step is of second order and time-symmetric; `compose` raises the order.

    Args:
        system: `systems.heavy_top(...)`, `systems.potential_top(...)`, `systems.group_potential(...)`; a driven one,
            `systems.driven_top(...)`, `systems.gravity_gradient(...)`, with kicks at t and t + Δt, whose steps are
            symplectic at given t and Δt, and on the phase space extended by time and −work; or
            `systems.rigid_bodies(...)`; `systems.gyrostat(...)`; or `systems.pseudo_rigid_body(...)` without viscosity.
        drift: a symmetric step of `system.free`; by default the symplectic `so3_midpoint`; on other groups the exact
            q exp(Δt m⁻¹Π) of a bi-invariant metric; on products too `group_midpoint` with `maps.arcsine` where it is
            symplectic; on SE(3) with an isotropic mass `so3_midpoint` for the attitude and the exact motion of the
            center; for several bodies the exact step, in place of which `preprocessed(system.free, 10)` runs in a
            quarter of the time where no body rotates by more
            than |ΔtΩ| = ½. `exact(system.free)`, the default for a gyrostat, has smaller errors where the body rotates
            fast in a weak potential, and no limit on |Δt Ω|.

    Raises:
        ValueError: the system has neither a potential nor a rotor, is viscous or incompressible; the drift is not
            symmetric, or given for an elastic body; or no drift is given and no symplectic one is known.

    Source: Strang 1968, SIAM J. Numer. Anal. 5; for rigid bodies Touma & Wisdom 1994, Astron. J. 107; for elastic ones
    Lewis & Simo 1994, Section 1.2, and Simo, Tarnow & Wong 1992, Comput. Methods Appl. Mech. Engrg. 100.
    """
    PROPERTIES.check(system)
    if isinstance(system, AbstractElasticBody):
        if drift is not None:
            raise ValueError(f"the drift of an elastic body is a straight line: give none, got {drift!r}")
        return ElasticSplitting(system)
    drift = default_drift(system) if drift is None else drift
    PROPERTIES.check_drift(system.free, drift)
    if isinstance(system, AbstractGyrostat):
        return GyrostatSplitting(system, drift)
    many = isinstance(drift.system, AbstractFreeBodies) and len(drift.system.masses) >= _MANY
    chain = isinstance(system, AbstractRigidBodies) and is_chain(system.potential)
    return Splitting(system, drift, kick_first=chain or not many)


PROPERTIES = SchemeProperties(
    name="splitting",
    systems="tops, satellites, gyrostats, groups with a potential, several bodies, elastic bodies",
    conserves=("momentum", "form"),
    limit="that of the drift; elastic bodies: Δtω < 2",
    aliases=("Strang splitting", "kick–drift–kick", "Störmer–Verlet", "central difference method"),
    source="Strang 1968; McLachlan & Quispel 2002",
    accepts=(AbstractForcedSystem, AbstractDrivenSystem, AbstractGyrostat, AbstractElasticBody),
)


@PROPERTIES.by_name
def examples(system: Any) -> list[Step]:
    """The splitting of gyrostats, elastic bodies, rigid bodies in a potential, and any driven system."""
    of_any_kind = isinstance(system, AbstractDrivenSystem | AbstractElasticBody)
    return [splitting(system)] if of_any_kind or isinstance(system.free, AbstractFreeBody | AbstractFreeBodies) else []
