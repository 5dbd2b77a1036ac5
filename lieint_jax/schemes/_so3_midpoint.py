"""The energy-momentum schemes of the free rigid body (Sections 2.2 and 3), including the symplectic one; gyrostats.

With Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}) and Θ = κ(|Θ̄|²) Θ̄, one step is

    Λ_{n+1} = Λ_n cay Θ,    π_{n+1} = π_n                                            (2.24), (3.3)

Put a = ½Δt Π_n. Then Θ̄ = 2y solves (3.4), which for a Cayley map loses its square roots:

    J y + κ y × J y = a,    κ = κ(4|y|²),    h = ½Θ = κ y                            (vector form)

For the symplectic κ it is 1 + |h|² (3.16). Multiplying by (1 + ĥ)⁻¹ = (1 − ĥ + h⊗h)/(1 + |h|²) leaves an equation that
is linear in h except for one scalar, m = a·h:

    J h = a + a × h + m h,    so  h = (J − m − â)⁻¹ a  and  m = a·(J − m − â)⁻¹ a     (scalar form)

a quartic for m, the same for every step of a trajectory.

For a gyrostat Θ̄ = Δt J⁻¹(½(Π_n + Π_{n+1}) − h̄_r), where h̄_r is the rotor's momentum, or the mean of it at the ends
of the step if a motor drives the rotor. With b = ½Δt h̄_r,

    J y + b + κ y × (J y + b) = a                                                    (vector form)

and from Π_{n+1} = cay(Θ)ᵀΠ_n, with cay(Θ)Θ̄ = Θ̄, follows H_{n+1} − H_n = −Ω̄·(h_{r,n+1} − h_{r,n}) with Ω̄ = Θ̄/Δt.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import count, named
from lieint_jax._numerics.vectors import cross, dot, symmetric, vector
from lieint_jax.core import Converted, State, Step, StepInfo, argument, clock, pytree, static, with_fields
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS, Kappa, as_kappa, kappa_symplectic
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.half_rotation import (
    ITERATIONS,
    SLENDER,
    bias,
    half_rotation,
    half_rotation_derivative,
    scaled,
)
from lieint_jax.schemes._shared.inertia_in_time import advice_in_time, step_in_time
from lieint_jax.systems._equations import (
    AbstractDrivenGyrostat,
    AbstractFreeBody,
    AbstractFreeBodyInTime,
    AbstractGyrostat,
)

__all__ = ["SO3Midpoint", "so3_midpoint"]

PROPERTIES = SchemeProperties(
    name="so3_midpoint",
    systems="free bodies, also with J(t), gyrostats",
    conserves=("energy", "momentum", "form (symplectic κ, free body)"),
    limit="|ΔtΩ| ≈ 1 for the symplectic κ, 2 to 4 for others",
    aliases=("discrete Moser–Veselov (symplectic κ)", "RATTLE (symplectic κ)"),
    source="Lewis & Simo 1994, (2.24), (2.28), Results 1 to 5",
    accepts=(AbstractFreeBody, AbstractGyrostat, AbstractDrivenGyrostat, AbstractFreeBodyInTime),
)


@pytree
class SO3Midpoint(Step):
    """Energy–momentum schemes of a free body or a gyrostat; with the symplectic κ, discrete Moser–Veselov (RATTLE).

    They are (2.24) with (2.28), which is (3.3), for any scaling κ.

    | κ | energy | spatial momentum | symplectic form |
    |---|---|---|---|
    | `maps.kappa_symplectic`, free body | exact | exact, bit for bit | exact (Result 5) |
    | any other, free body | exact (Result 3) | exact, bit for bit | defect O(Δt³) per step |
    | any, gyrostat | exact | exact, bit for bit | defect O(Δt³) per step: `splitting` is symplectic |
    | any, driven gyrostat | energy less work exact | exact, bit for bit | defect O(Δt³) per step |
    | as a free body, for J(t) | energy less work exact | exact, bit for bit | as a free body |

    In a driven gyrostat each step changes the rotor's momentum by Δh_r = Δt τ(t_n + ½Δt), and the work, if it is
    tracked, by −Ω̄·Δh_r. A body whose inertia is a function of time moves in each step with J(t_n + ½Δt); the work is
    that of the changes of J at both ends.

    All are of second order and time-symmetric, with |q| = 1 to round-off. Momentum is the Noether invariant of
    rotations in space; energy is ½ Π·J⁻¹Π. "Exact" is to round-off at a converged step; rounding errors add up, to
    2e-13 of the energy in 10⁷ steps of J = (1, 2, 2.7) with Δt = 0.1 (`so3_explicit` corrects them).

    Args:
        system: `systems.rigid_body(...)`, `systems.gyrostat(...)`, `systems.driven_gyrostat(...)`,
            or `systems.inertia_in_time(...)` without a torque.
        kappa: κ as a callable of x = |Θ̄|² with κ(0) = 1. A κ with parameters is a `jax.tree_util.Partial`.
        iterations: Newton corrections per step; by default 3 for the scalar form (the symplectic κ of a free body), 4
            for the vector form. The scalar form reaches round-off with 2 for |Δt Ω| ≤ 0.7, with 3 for ≤ 0.95; the
            vector form with 2 for ≤ 0.2, 3 for ≤ 0.5, 4 for ≤ 0.8. A step that does not converge reports
            `converged=False`, and so does one whose iterations were not steady, as they may be for |Δt Ω| > 1.4: it
            could be at a root of another branch.

    A full tensor whose moments differ by more than 1 : 3.5e4 does not represent the smallest to enough digits; then
    every step reports `converged=False`. Principal moments have no such limit.

    The scalar form loses digits on rods (J₁ ≪ J₂) at large |Δt Ω|, and reports this in `converged`. There use the
    slower vector form, `dataclasses.replace(maps.kappa_symplectic, solve_by="vector")`.

    The rotation of a step is at most 90° for the symplectic κ, which is real for |Θ̄| ≤ 1 only: on a principal axis the
    branch ends at |Δt Ω| = 1, off axis a little later (1.18 for J = (1, 2, 3)).

    Raises:
        ValueError: not a free rigid body or gyrostat, κ is not callable, iterations is not a positive int.

    Source: Lewis & Simo 1994, Results 1–5; scalar form and quaternion increments: this package.
    """

    system: Converted[AbstractFreeBody | AbstractFreeBodyInTime | AbstractGyrostat | AbstractDrivenGyrostat] = argument(
        converter=PROPERTIES.check
    )
    kappa: Converted[Kappa] = argument(converter=as_kappa, default=kappa_symplectic)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1, optional=True), default=None)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)

    def check_fields(self) -> dict[str, int]:
        free = isinstance(self.system, AbstractFreeBody | AbstractFreeBodyInTime)
        default = ITERATIONS[self.kappa.solve_by if free else "vector"]
        return {"iterations": default if self.iterations is None else self.iterations}

    @property
    def commuting(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.kappa.symplectic and isinstance(self.system, AbstractFreeBody)

    @property
    def name(self) -> str:
        return f"so3_midpoint[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        if isinstance(self.system, AbstractFreeBodyInTime):
            return step_in_time(self.system, state, dt, lambda body, z: with_fields(self, system=body).advance(z, dt))
        if isinstance(self.system, AbstractDrivenGyrostat):
            return self._driven_step(self.system, state, jnp.asarray(dt))
        J, a = scaled(self.system, state, dt)
        h, info = half_rotation(J, a, self.kappa, self.iterations, bias(self.system, dt))
        return state._replace(q=so3.cayley_increment(state.q, h)), info

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        body = self.system
        if self.kappa.solve_by != "scalar" or not isinstance(body, AbstractFreeBody):
            return super().advance_tangents(state, dt, T)
        J, a = scaled(body, state, dt)
        h, info = half_rotation(J, a, self.kappa, self.iterations)

        def propagate(tangent: Array) -> Array:
            theta, p = vector(tangent[:3]), vector(tangent[3:]) - cross(tangent[:3], state.p)
            da = scaled(body, state._replace(p=jnp.stack(p)), dt)[1]
            dh = half_rotation_derivative(J, a, h, da)
            return jnp.stack([*(theta + so3.Ad(state.q, dh)), *tangent[3:]])

        T = lax.map(propagate, T.T).T  # vmap would take 1.4 times as long
        return state._replace(q=so3.cayley_increment(state.q, h)), info, T

    def _driven_step(self, system: AbstractDrivenGyrostat, state: State, dt: Array) -> tuple[State, StepInfo]:
        """The step of the gyrostat with the mean rotor momentum h̄_r, with the change of h_r and the motor's work."""
        rotor, change = system.rotor(state), dt * system.torque(clock(state) + 0.5 * dt)
        mean = rotor + 0.5 * change
        end, info = with_fields(self, system=system.with_rotor(mean))(state, dt)
        end = end._replace(extra=(state.extra or {}) | {"rotor": rotor + change})
        if state.work is None:
            return end, info
        own = 0.5 * (so3.Ad_star(state.q, state.p) + so3.Ad_star(end.q, end.p)) - mean  # JΩ̄
        Omega = symmetric(system.inertia).solve(own)
        return end._replace(work=state.work - dot(Omega, change)), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return self.advice_to(self.name, state, dt, f", or more iterations than {self.iterations}")

    def advice_to(self, name: str, state: State, dt: ArrayLike, iterations: str = "") -> str:
        """The advice to a step of this name with the same equation; `iterations` is what helps Newton's method."""
        system = self.system
        if isinstance(system, AbstractFreeBodyInTime):
            if wrong := advice_in_time(system, state, dt):
                return wrong
            system = system.frozen(clock(state) + jnp.asarray(dt) / 2)
        J = np.asarray(system.inertia)
        rotor = system.rotor if isinstance(system, AbstractGyrostat) else 0.0  # h_r
        rotor = system.rotor(state) if isinstance(system, AbstractDrivenGyrostat) else rotor
        own = np.asarray(so3.Ad_star(state.q, state.p) - rotor)
        turn = float(np.abs(dt) * np.linalg.norm(own / J if J.ndim == 1 else np.linalg.solve(J, own)))
        more = iterations if turn < 1 else ""  # beyond, Newton may fail to converge
        rod = self.kappa.solve_by == "scalar" and turn < 0.9 * self.kappa.limit
        more += ", or for a slender body the vector form (see so3_midpoint)" if rod else ""
        if not symmetric(system.inertia).well_conditioned:
            return f"{name}: {SLENDER}"
        return (
            f"{name} does not converge: |Δt Ω| = {turn:.3g} at dt = {dt}, the rotation in a step, rad; the branch "
            f"of this κ {self.kappa.branch}. Use a smaller dt{more}"
        )


@PROPERTIES.by_name
def examples(
    system: AbstractFreeBody | AbstractFreeBodyInTime | AbstractGyrostat | AbstractDrivenGyrostat,
) -> list[Step]:
    """The paper's three κ's, for free rigid bodies and gyrostats."""
    return [so3_midpoint(system, kappa) for kappa in KAPPAS]


so3_midpoint = SO3Midpoint
