"""Extrapolated steps of the modified midpoint rule (Gragg, Bulirsch, Stoer): explicit, of any even order, any system.

With increments δ from the start u, n sub-steps of size h = Δt/n,

    δ₁ = h f(u),    δ_{m+1} = δ_{m−1} + 2h f(u + δ_m),    S_n = ½(δ_{n−1} + δ_n + h f(u + δ_n))

has an error in even powers of h, which the combination Σ w_n S_n over n = 2, 4, … cancels one by one.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax.schemes.so3_midpoint import FREE_BODIES
from lieint_jax.types import Bodies, State, Step, StepInfo, System, Top, all_finite, pytree, static, time_derivative

_ROUGH = 1e-3  # the largest relative difference between the last two orders of a step that converged


@pytree
class Extrapolated(Step):
    """The step made by `extrapolate`.

    Attributes:
        system: any system.
        order: even.
    """

    system: System
    order: float = static()
    symmetric: bool = static(default=False)

    @property
    def name(self) -> str:
        return f"extrapolate[{self.order:g}]"

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        numbers = [2 * (j + 1) for j in range(int(self.order) // 2)]
        slope = time_derivative(self.system, state)
        found = [self._midpoint(state, slope, jnp.asarray(dt, state.p.dtype), n) for n in numbers]
        best, second = (_combined(found[:m], weights(numbers[:m])) for m in (len(numbers), len(numbers) - 1))
        end = jax.tree.map(jnp.add, state, best)
        off = jnp.maximum(*(_relative(a - b, z) for a, b, z in ((best.q, second.q, end.q), (best.p, second.p, end.p))))
        return end, StepInfo(lax.stop_gradient(off), all_finite(end) & (off <= _ROUGH))

    def _midpoint(self, start: State, slope: State, dt: Array, n: int) -> State:
        """S_n."""
        h = dt / n

        def after(delta: State, factor: Array) -> State:
            moved = jax.tree.map(jnp.add, start, delta)
            return jax.tree.map(lambda x: factor * x, time_derivative(self.system, moved))

        def one(_: int, last: tuple[State, State]) -> tuple[State, State]:
            before, delta = last
            return delta, jax.tree.map(jnp.add, before, after(delta, 2 * h))

        zero = jax.tree.map(jnp.zeros_like, start)
        first = jax.tree.map(lambda x: h * x, slope)
        before, delta = lax.fori_loop(1, n, one, (zero, first))
        return jax.tree.map(lambda a, b, c: (a + b + c) / 2, before, delta, after(delta, h))

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} is rough at dt = {dt}: its last two orders differ by more than {_ROUGH:g} of the state. Take "
            "a smaller dt"
        )


def extrapolate(system: System, order: int = 12) -> Extrapolated:
    """Explicit steps of high order for any system, by its vector field alone. No structure is kept beyond accuracy.

    43 evaluations of the vector field a step at order 12. Nothing is conserved but to the size of the error, which
    grows with time: for short, accurate runs, and for comparison. `residual` is the relative difference between the
    last two orders; above 1e-3 the step says `converged=False`.

    Args:
        system: any.
        order: even, 4 to 20.

    Raises:
        ValueError: another order.

    Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, II.9.
    """
    if isinstance(order, bool) or order not in range(4, 21, 2):
        raise ValueError(f"order must be an even number from 4 to 20, got {order!r}")
    if not isinstance(system, System):
        raise ValueError(f"extrapolate integrates systems, got {type(system).__name__}")
    return Extrapolated(system, order)


def weights(numbers: list[int]) -> list[float]:
    """w_n, which cancel the errors in h², h⁴, …, of sub-steps in these numbers."""
    return [math.prod(n * n / (n * n - k * k) for k in numbers if k != n) for n in numbers]


def _combined(found: list[State], factors: list[float]) -> State:
    return jax.tree.map(lambda *x: sum(w * y for w, y in zip(factors, x, strict=True)), *found)


def _relative(difference: Array, like: Array) -> Array:
    size = jnp.max(jnp.abs(like))
    return jnp.max(jnp.abs(difference)) / jnp.where(size > 0, size, 1)


def examples(system: Any) -> dict[str, Step]:
    """Order 12, for free bodies, tops and several bodies."""
    if not (FREE_BODIES.declared(system) or isinstance(system, Top | Bodies)):
        return {}
    return {"extrapolate[12]": extrapolate(system)}
