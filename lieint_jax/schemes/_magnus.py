"""The exponential of the truncated Magnus series: steps of a motion with a given rate, order 2, 4 or 6.

With ω_i = ω(t + c_iΔt) at the Gauss–Legendre nodes, one step is q_{n+1} = exp(Θ) q_n for a rate in space, and
q_{n+1} = q_n exp(Θ) for one in the body, where every bracket has the other sign:

    order 2:  Θ = Δt ω₁,    order 4:  Θ = ½Δt(ω₁ + ω₂) + (√3/12)Δt² [ω₂, ω₁]
    order 6:  Θ = α₁ + α₃/12 + [−20α₁ − α₃ + C₁, α₂ + C₂]/240,    C₁ = [α₁, α₂],    C₂ = −[α₁, 2α₃ + C₁]/60
              α₁ = Δt ω₂,    α₂ = (√15/3)Δt(ω₃ − ω₁),    α₃ = (10/3)Δt(ω₃ − 2ω₂ + ω₁)

Without commutators, order 4 is a product of two exponentials, of Δt(aω₁ + bω₂), then of Δt(bω₁ + aω₂), with
a, b = ¼ ± √3/6.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import listed, named
from lieint_jax._numerics import collocation
from lieint_jax._numerics.arrays import AlgebraVector, GroupElement
from lieint_jax.core import AnalyticGroup, Converted, State, Step, StepInfo, argument, clock, pytree, static
from lieint_jax.groups import MatrixGroup, so3
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.systems._equations import AbstractKinematics

__all__ = ["Magnus", "magnus"]

_LARGEST = 0.5  # commutators over the rotation: with perpendicular rates, |ΔtΩ| = π

PROPERTIES = SchemeProperties(
    name="magnus",
    systems="motions with given rates",
    conserves=(),
    order=4,
    limit="|ΔtΩ| ≈ π",
    aliases=("Magnus integrator", "exponential midpoint rule", "coning algorithm", "commutator-free CF4"),
    source="Blanes, Casas & Ros 2000; Blanes & Moan 2006",
    accepts=(AbstractKinematics,),
)


@pytree
class Magnus(Step):
    """Magnus integrators: attitudes and propagators from given rates, on the group to round-off, and reversible.

    They evaluate the rate at 1, 2 or 3 Gauss nodes a step, solve no equation, and are exact for a rate with a constant
    direction that is a polynomial of degree < order. `residual` is the part of commutators in the largest component of
    the rotation vector of a step; above ½, where the series does not converge, `converged` is False.

    On `groups.so3` steps are increments of the quaternion, which correct its length. On matrix groups the defect grows
    by rounding.

    With a log, `systems.sampled_rate`, choose dt as the interval of the log, or a part of it. A log of means is
    integrated by order 2 without, and by order 4 with the coning correction; order 6 gains nothing there.

    Args:
        system: `systems.kinematics(group, rate)`.
        order: 2 (the exponential midpoint rule), 4 or 6.
        commutators: False selects the commutator-free method of order 4, a product of two exponentials.

    Raises:
        ValueError: not a motion with a given rate; another order; commutators=False with an order other than 4.

    Source: Blanes, Casas & Ros, BIT 40 (2000) 434; Blanes & Moan, Appl. Numer. Math. 56 (2006) 1519, commutator-free.
    """

    system: AbstractKinematics = argument(converter=PROPERTIES.check)
    order: Converted[int] = static(converter=named(listed, "order", (2, 4, 6)), default=4)
    commutators: Converted[bool] = static(converter=bool, default=True, kw_only=True)
    symmetric: bool = static(default=True, init=False)

    def check_fields(self) -> None:
        if not self.commutators and self.order != 4:
            raise ValueError(f"commutators=False is of order 4, got order {self.order}")

    @property
    def name(self) -> str:
        return f"magnus[{self.order:g}{'' if self.commutators else ', commutator-free'}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        group, t, q = self.system.group, clock(state), state.q
        h = jnp.asarray(dt)
        parts, brackets = self._exponents(t, h)
        good = jnp.ones((), bool)
        for part in parts:
            q = self._multiply_exp(q, part)
            good = good & group.near(part) if isinstance(group, AnalyticGroup) else good
        size, left_out = (lax.stop_gradient(jnp.max(jnp.abs(x))) for x in (jnp.stack(parts), brackets))
        ratio = left_out / jnp.where(size > 0, size, 1)
        return state._replace(q=q), StepInfo(ratio, good & (ratio <= _LARGEST))

    def _exponents(self, t: Array, h: Array) -> tuple[list[AlgebraVector], AlgebraVector]:
        """The exponents of a step in the order of time, and the sum of the commutators in them."""
        if self.order == 2:
            once = h * self.system.mean_rate(t, h)
            return [once], jnp.zeros_like(once)
        nodes = collocation.nodes(int(self.order) // 2)
        w = [h * jnp.asarray(self.system.rate(t + float(c) * h), h.dtype) for c in nodes]
        if not self.commutators:
            a, b = 0.25 + math.sqrt(3) / 6, 0.25 - math.sqrt(3) / 6
            return [a * w[0] + b * w[1], b * w[0] + a * w[1]], jnp.zeros_like(w[0])
        plain, brackets = (_fourth if self.order == 4 else _sixth)(self._bracket, *w)
        return [plain + brackets], brackets

    def _bracket(self, x: AlgebraVector, y: AlgebraVector) -> AlgebraVector:
        """[x, y] for a rate in space, [y, x] for one in the body."""
        return self.system.group.ad(x, y) if self.system.frame == "space" else self.system.group.ad(y, x)

    def _multiply_exp(self, q: GroupElement, theta: AlgebraVector) -> GroupElement:
        """q exp θ in the body, exp θ q in space."""
        group, left = self.system.group, self.system.frame == "space"
        if group is so3:
            return so3.exp_increment(q, theta, left)  # which corrects the length of q
        if isinstance(group, MatrixGroup):
            return group.exp_increment(q, theta, left)
        turn = group.exp(theta)
        return group.multiply(turn, q) if left else group.multiply(q, turn)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name}: the Magnus series does not converge at dt = {dt}: its commutators exceed {_LARGEST:g} of "
            "the rotation of a step, or a step is too large for exp, or a sampled rate has no value there. Use a "
            "smaller dt, and times inside of the log"
        )


Bracket = Callable[[Array, Array], Array]


def _fourth(bracket: Bracket, a: Array, b: Array) -> tuple[Array, Array]:
    """The sum of the terms of Θ without commutators, and of those with them, at order 4."""
    return (a + b) / 2, math.sqrt(3) / 12 * bracket(b, a)


def _sixth(bracket: Bracket, a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """The same at order 6."""
    second, third = math.sqrt(15) / 3 * (c - a), 10 / 3 * ((c - b) - (b - a))
    once = bracket(b, second)
    twice = bracket(b, 2 * third + once) / -60
    return b + third / 12, bracket(-20 * b - third + once, second + twice) / 240


@PROPERTIES.by_name
def examples(system: AbstractKinematics) -> list[Step]:
    """All orders, and the commutator-free method."""
    return [*(magnus(system, order) for order in (2, 4, 6)), magnus(system, commutators=False)]


magnus = Magnus
