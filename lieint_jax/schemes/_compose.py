"""Compositions of symmetric steps: order 4, 6, 8, 10, with every invariant of the base step.

    Ψ_{γ_sΔt} ∘ … ∘ Ψ_{γ₁Δt},    γ a palindrome, some γ negative

A symmetric step is exp(hY₁ + h³Y₃ + h⁵Y₅ + …). In general the order conditions are those of non-commuting Y's: 2, 4, 8,
16 of them at orders 4, 6, 8, 10. But steps of the symplectic scheme for the free body commute, whatever their sizes:
all are translations on the same tori. Then only power sums are left,

    Σγ = 1,    Σγ³ = Σγ⁵ = … = Σγ^{p−1} = 0    (p/2 conditions at order p)

and the best composition found uses one value often, and p/2 − 1 others to cancel its power sums:

| order | stages | commuting: s·\\|Σγ^{p+1}\\|^{1/p} | the same for the best general palindrome here |
|---|---|---|---|
| 4 | 8 × 1/6, −1/3 | 2.12 | 2.61 (Suzuki, 5) |
| 6 | 10 + 2 + 1 = 13 | 3.41 | 5.16 (Kahan & Li, 9) |
| 8 | 14 + 2 + 2 + 1 = 19 | 4.67 | 6.92 (Kahan & Li, 17) |
| 10 | 16 + 2 + 2 + 2 + 1 = 23 | 6.11 | 9.07 (Sofroniou & Spaletta, 35) |
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import listed, named, optional
from lieint_jax.core import Converted, State, Step, StepInfo, System, clock, counts_work, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.compositions import METHODS
from lieint_jax.schemes._shared.stages import compose_stages
from lieint_jax.schemes._so3_midpoint import examples as base_examples

__all__ = ["Composition", "compose"]

_GENERAL = {4: "suzuki", 6: "kahan_li_6", 8: "kahan_li_8", 10: "sofroniou_spaletta_10"}

PROPERTIES = SchemeProperties(
    name="compose",
    systems="any symmetric step of order 2",
    conserves=("what the step conserves",),
    order=4,
    limit="that of the step over its longest stage",
    aliases=("Suzuki composition", "Yoshida composition", "Kahan–Li composition"),
    source="Suzuki 1990; Yoshida 1990; Kahan & Li 1997",
)


@pytree
class Composition(Step):
    """A composition of higher order of a symmetric step of order 2 (Suzuki, Yoshida, Kahan–Li), with its invariants.

    Energy, momentum maps and the symplectic form are conserved to round-off if the base step conserves them, since each
    sub-step does. The composition is symmetric too, and costs as many base steps as it has stages.

    Args:
        step: a symmetric step of order 2, such as `so3_midpoint(...)`.
        order: 4, 6, 8 or 10.
        method: a key of `METHODS` of that order, by default the cheapest: "commuting_4" … "commuting_10" where the base
            step commutes with itself at other step sizes, otherwise "suzuki", "kahan_li_6", "kahan_li_8",
            "sofroniou_spaletta_10". Also "triple_jump", "yoshida_6", "suzuki_umeno_8".

    Raises:
        ValueError: the step is not symmetric or not of order 2, the order or the method does not exist, or a commuting
            method is given for a step that does not commute.

    Source: for each method, see `METHODS`; Hairer, Lubich & Wanner, Geometric Numerical Integration, V.3.2; the
    commuting ones: this package.
    """

    step: Step
    order: Converted[int] = static(converter=named(listed, "order", _GENERAL))
    method: Converted[str] = static(converter=optional, default=None)
    symmetric: bool = static(default=True, init=False)

    def check_fields(self) -> dict[str, str]:
        step, order = self.step, self.order
        if not isinstance(step, Step) or not step.symmetric or step.order != 2:
            given = step.name if isinstance(step, Step) else step
            raise ValueError(f"compose needs a symmetric step of order 2, got {given!r}")
        default = f"commuting_{order}" if step.commuting else _GENERAL[order]
        method = default if self.method is None else self.method
        fitting = [name for name, m in METHODS.items() if m.order == order and (step.commuting or not m.counts)]
        if method not in fitting:
            known = f"{', '.join(fitting)} for {step.name} at order {order}"
            raise ValueError(f"method must be one of {known}, got {method!r}")
        return {"method": method}

    @property
    def system(self) -> System:
        return self.step.system

    @property
    def commuting(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.step.commuting

    @property
    def own_time(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.step.own_time

    def start(self, state: State) -> State:
        return self.step.start(state)

    @property
    def name(self) -> str:
        return f"compose[{self.method}]({self.step.name})"

    @property
    def gammas(self) -> tuple[float, ...]:
        """The sub-steps, in units of dt; they sum to 1."""
        return METHODS[self.method].gammas

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        if self.own_time or not counts_work(state):
            return compose_stages(self.step.substep, state, (self._sizes(state, dt),), store=False)

        def substep_to(state: State, h: Array, end: Array) -> tuple[State, StepInfo]:
            """A sub-step that ends at a given time to the last bit, as in `UniformClock.rounded`: no work is lost."""
            return self.step.substep(state, h + lax.stop_gradient(end - clock(state) - h))

        parts = np.append(np.cumsum(self.gammas)[:-1], 1)
        ends = clock(state) + jnp.asarray(parts, state.p.dtype) * dt
        return compose_stages(substep_to, state, (self._sizes(state, dt), ends), store=False)

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        if state.extra is not None:  # it may depend on q and p, from one sub-step to the next
            return super().advance_tangents(state, dt, T)

        def substep_tangent(pair: tuple[State, Array], h: Array) -> tuple[tuple[State, Array], StepInfo]:
            end, info, T = self.step.tangent(pair[0], h, pair[1])
            return (end, T), info

        (end, T), info = compose_stages(substep_tangent, (state, T), (self._sizes(state, dt),), store=False)
        return end, info, T

    def _sizes(self, state: State, dt: ArrayLike) -> Array:
        """The sizes of the sub-steps, γΔt."""
        return jnp.asarray(self.gammas, state.p.dtype) * dt

    def advice(self, state: State, dt: ArrayLike) -> str:
        largest = max(self.gammas, key=abs)
        size = abs(largest)  # a step back fails where a step on does, and is easier to read
        return f"{self.name} has sub-steps of up to {size:.3g} dt; {self.step.advice(state, size * dt)}"


def examples(system: System) -> dict[str, Step]:
    """Compositions of the steps of `so3_midpoint`: order 8 of the symplectic one, order 4 of the others."""
    made = [compose(step, 8 if step.commuting else 4) for step in base_examples(system).values()]
    return {step.name: step for step in made}


compose = Composition
