"""The symplectic step with an inertia calibrated to trajectory and step size, so that it is the exact flow.

The discrete free body moves along the exact trajectory with an error in time only (see `preprocessed`). With

    1/J̃_j = s/J_j + d

two constants remove this error entirely: one for the motion of Π along its polhode, one for the rotation about π. They
depend on the step size and on energy and |π|, so `prepare` computes them once, in closed form (`_free_body.clock`), and
every later step costs as much as one of order 2.
"""

from __future__ import annotations

import math
from dataclasses import field
from typing import NamedTuple, Self

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _free_body
from lieint_jax._checks import count, named
from lieint_jax._numerics.vectors import cross, dot, norm, symmetric
from lieint_jax._xla import compiled
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static, with_fields
from lieint_jax.groups import so3
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._preprocessed import with_modified_inertia
from lieint_jax.systems._equations import AbstractFreeBody

__all__ = ["calibrated"]


class Clock(NamedTuple):
    """The constants s and d, whether they exist, and the step size, energy and |π|² that they belong to."""

    s: Array
    d: Array
    on_branch: Array
    dt: Array
    energy: Array
    square: Array


PROPERTIES = SchemeProperties(
    name="calibrated",
    systems="free bodies",
    conserves=("energy", "momentum", "form"),
    order=float("inf"),
    limit="less than 90° a step",
    aliases=("exact discrete Moser–Veselov",),
    source="McLachlan & Zanna 2005",
    accepts=(AbstractFreeBody,),
)


@pytree
class Calibrated(Step):
    """The symplectic step of a free rigid body with an inertia that makes it the exact flow, at any step size.

    | conserved | to |
    |---|---|
    | energy, polhode | round-off |
    | spatial momentum | bit for bit |
    | the symplectic form | round-off, whether the constants are held fixed or computed for each state |

    `integrate` and `run` call `prepare` once, and a step then costs as much as one of `so3_midpoint`. A direct
    call without `prepare` computes the constants at every step. Prepared for one trajectory or step size and used
    with another, it reports `converged=False`. Use `exact` for one large step, `calibrated` for many small ones.

    Args:
        system: `systems.rigid_body(...)`.
        iterations: Newton corrections per step. 3, the default, reach round-off where a step rotates the body by up to
            70°, 4 up to 80°, 5 to 86°, 6 to 89°; the branch ends at 90°. A step that does not converge reports
            `converged=False`.

    Attributes:
        clock: the constants s and d, which `prepare` computes; None before.

    Raises:
        ValueError: not a free rigid body; bad iterations.

    Source: McLachlan & Zanna 2005, Found. Comput. Math. 5 (that s and d exist); the closed form: this package.
    """

    system: AbstractFreeBody = argument(converter=PROPERTIES.check)
    clock: Clock | None = field(default=None, init=False)
    iterations: Converted[int | None] = static(converter=named(count, "iterations", 1, optional=True), default=None)
    order: float = static(default=math.inf, init=False)
    symmetric: bool = static(default=True, init=False)
    commuting = True

    def with_constants(self, state: State, dt: ArrayLike) -> Self:
        found = _free_body.clock(self.system.inertia, so3.Ad_star(state.q, state.p), dt)
        clock = Clock(*found, jnp.asarray(dt, state.p.dtype), *self._invariants(state))
        return with_fields(self, clock=clock)

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """One step. A prepared step requires a state of its trajectory and its dt; otherwise it prepares itself."""
        if self.clock is None:
            return self.prepare(state, dt)(state, dt)
        after, info = with_modified_inertia(self.system, self.clock.s, self.clock.d, self.iterations).substep(state, dt)
        return after, info._replace(converged=info.converged & self._fits(state, dt))

    def advice(self, state: State, dt: ArrayLike) -> str:
        step = self if self.clock is not None else _prepared(self, state, dt)
        assert step.clock is not None
        if not step.clock.on_branch:
            return f"{self.name} turns by more than 90° at dt = {dt}: use a smaller dt, or `exact` for any dt"
        if not step._fits(state, dt):
            return f"{self.name} was prepared for another trajectory or for dt = {step.clock.dt}: prepare it again"
        return f"{self.name} turns by nearly 90° at dt = {dt}: use a smaller dt or up to 6 iterations"

    def _invariants(self, state: State) -> tuple[Array, Array]:
        return self.system.energy(state), dot(state.p, state.p)

    def _fits(self, state: State, dt: ArrayLike) -> Array:
        """Whether the clock is that of dt and of the trajectory of `state`, up to a drift of energy by round-off.

        An error of the attitude changes the energy by its angle times |Π × Ω|, the more the thinner a rod.
        """
        assert self.clock is not None
        energy, square = lax.stop_gradient(self._invariants(state))
        Pi = so3.Ad_star(state.q, state.p)
        near = 2**16 * jnp.finfo(square.dtype).eps
        drift = self.clock.energy + lax.stop_gradient(norm(cross(Pi, symmetric(self.system.inertia).solve(Pi))))
        return (
            self.clock.on_branch
            & (jnp.abs(dt) == jnp.abs(self.clock.dt))
            & (jnp.abs(energy - self.clock.energy) <= near * drift)
            & (jnp.abs(square - self.clock.square) <= near * self.clock.square)
        )


@compiled
def _prepared(step: Calibrated, state: State, dt: ArrayLike) -> Calibrated:
    """`Calibrated.prepare`, compiled: without compilation it needs seconds, too long for an error message."""
    return step.prepare(state, dt)


@PROPERTIES.by_name
def examples(system: AbstractFreeBody) -> list[Step]:
    """The calibrated step, for free rigid bodies."""
    return [calibrated(system)]


calibrated = Calibrated
