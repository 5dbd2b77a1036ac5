"""Orders 4 to 10 at the cost of order 2, for the free body: the symplectic step of a modified inertia.

    1/J̃_j = s/J_j + d                                    (s and d from energy and momentum, both constant)

The discrete body of inertia J moves along the exact trajectory with an error in time only. The inertia J̃ corrects the
time to higher order, and as s/J_j + d has the same polhodes as 1/J_j, all that was conserved still is. With
C = ½Δt²|Π|², H = Δt²·energy, S₁ = ΣJ, X₁ = ΣJ⁻¹ and D = det J, to order 4

    s = 1 + S₁C/(6D) − X₁H/3,    d = −C/(3D) + S₁H/(6D)

and with the further terms of `_shared.clock_coefficients` to orders 6, 8 and 10.
"""

from __future__ import annotations

import dataclasses
from typing import overload

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.vectors import dot, symmetric, unit_trace
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.clock_coefficients import constants
from lieint_jax.schemes._shared.free_bodies import FreeFlight
from lieint_jax.schemes._so3_midpoint import SO3Midpoint, so3_midpoint
from lieint_jax.systems._equations import AbstractFreeBodies, AbstractFreeBody

__all__ = ["Preprocessed", "preprocessed"]

ORDERS = (4, 6, 8, 10)


@pytree
class Preprocessed(Step):
    """The step made by `preprocessed`."""

    system: AbstractFreeBody
    order: float = static()
    iterations: int | None = static(default=None)
    symmetric: bool = static(default=True)

    @property
    def name(self) -> str:
        return f"preprocessed[{self.order}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        s, d, holds = self._clock(state, dt)
        end, info = with_modified_inertia(self.system, s, d, self.iterations).substep(state, dt)
        return end, info._replace(converged=info.converged & holds)

    def advice(self, state: State, dt: ArrayLike) -> str:
        s, d, holds = self._clock(state, dt)
        if not holds:
            return f"{self.name}: the series that correct its inertia do not hold at dt = {dt}: use a smaller dt"
        base = with_modified_inertia(self.system, s, d, self.iterations)
        return f"{self.name} is a step of so3_midpoint with another inertia; {base.advice(state, dt)}"

    def _clock(self, state: State, dt: ArrayLike) -> tuple[Array, Array, Array]:
        """s and d, the latter over the trace of J: computed for J of trace 1, so that no power overflows.

        The third value is whether the series are accurate.
        """
        J, r = unit_trace(self.system.inertia)
        adj = J.adjugate
        C = dot(state.p, state.p) * (r * dt) ** 2 / 2
        H = self.system.energy(state) * r * dt * dt
        s, d, holds = constants(adj.trace, J.det(adj), C, H, int(self.order) // 2 - 1)
        return s, d * r, holds


def with_modified_inertia(system: AbstractFreeBody, s: Array, d: Array, iterations: int | None) -> SO3Midpoint:
    """The symplectic step of the inertia J̃ = J(s + dJ)⁻¹."""
    J = system.inertia
    if J.ndim == 1:
        modified = J / (s + d * J)
    else:
        M = symmetric(s * jnp.eye(3, dtype=J.dtype) + d * J)
        modified = jnp.stack([jnp.stack(M.solve(J[:, k])) for k in range(3)], axis=1)
    body = dataclasses.replace(system, inertia=modified)  # pyright: ignore[reportArgumentType, reportCallIssue]
    return so3_midpoint(body, iterations=iterations)


@overload
def preprocessed(system: AbstractFreeBody, order: int, iterations: int | None = None) -> Preprocessed: ...
@overload
def preprocessed(system: AbstractFreeBodies, order: int, iterations: int | None = None) -> FreeFlight: ...
def preprocessed(
    system: AbstractFreeBody | AbstractFreeBodies, order: int, iterations: int | None = None
) -> Preprocessed | FreeFlight:
    """The preprocessed discrete Moser–Veselov step of a free rigid body: order 4, 6, 8 or 10 in one stage.

    | conserved | to |
    |---|---|
    | energy, spatial momentum, polhode | round-off; momentum bit for bit |
    | the reduced Lie–Poisson structure (the motion of Π) | round-off |
    | the canonical form on T*SO(3) | O(Δt^{order+1}) only: s and d depend on the state |

    The step is symmetric; its branch ends near |Δt Ω| = 1, like that of `so3_midpoint`. Where the series for s and d
    are not accurate, at |Δt Ω| above about 1 for order 4, 1.2 for order 10, a step reports `converged=False`.

    Args:
        system: `systems.rigid_body(...)`, or `systems.rigid_bodies(...).free`, whose centers move on straight lines.
        order: 4, 6, 8 or 10.
        iterations: as in `so3_midpoint`.

    Raises:
        ValueError: the system is not a free rigid body, the order is none of these, or iterations is not a positive
            int.

    Source: McLachlan & Zanna 2005, Found. Comput. Math. 5; Hairer & Vilmart 2006, J. Phys. A 39.
    """
    order = _checks.listed("order", order, ORDERS, "; calibrated(system) is exact")
    if iterations is not None:
        iterations = _checks.count("iterations", iterations, 1)
    PROPERTIES.check(system)
    if isinstance(system, AbstractFreeBodies):
        return FreeFlight.with_step(system, lambda body: Preprocessed(body, order, iterations))
    return Preprocessed(system, order, iterations)


PROPERTIES = SchemeProperties(
    name="preprocessed",
    systems="free bodies, several free bodies",
    conserves=("energy", "momentum"),
    order=4,
    limit="|ΔtΩ| ≈ 1",
    aliases=("preprocessed discrete Moser–Veselov",),
    source="McLachlan & Zanna 2005; Hairer & Vilmart 2006",
    accepts=(AbstractFreeBody, AbstractFreeBodies),
)


@PROPERTIES.by_name
def examples(system: AbstractFreeBody | AbstractFreeBodies) -> list[Step]:
    """Orders 4, 6 and 10, for free rigid bodies."""
    return [preprocessed(system, order) for order in (4, 6, 10)] if isinstance(system, AbstractFreeBody) else []
