"""Extrapolated steps of the modified midpoint rule (Gragg, Bulirsch, Stoer): explicit, of any even order, any system.

With increments δ from the start u, n sub-steps of size h = Δt/n,

    δ₁ = h f(u),    δ_{m+1} = δ_{m−1} + 2h f(u + δ_m),    S_n = ½(δ_{n−1} + δ_n + h f(u + δ_n))

has an error in even powers of h, which the combination Σ w_n S_n over n = 2, 4, … cancels one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._numerics import kernel
from lieint_jax.schemes import _body_axes, _several_bodies
from lieint_jax.schemes.so3_midpoint import FREE_BODIES
from lieint_jax.types import Bodies, State, Step, StepInfo, System, Top, all_finite, pytree, static, time_derivative

_FORMS: dict[str, Any] = {"one body": _body_axes, "several bodies": _several_bodies}
_ROUGH = 1e-3  # the largest relative difference between the last two orders of a step that converged


@pytree
class Extrapolated(Step):
    """The step made by `extrapolate`.

    Attributes:
        system: any system.
        order: even.
        form: a key of `_FORMS`, whose unknowns it integrates in place of the states themselves; "" for the states.
    """

    system: System
    order: float = static()
    form: str = static()
    symmetric: bool = static(default=False)

    @property
    def name(self) -> str:
        return f"extrapolate[{self.order:g}]"

    @property
    def one_kernel(self) -> bool:
        return True

    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        start, rate = self._unknowns(state)
        best, second = _extrapolated(rate, start, jnp.asarray(dt, state.p.dtype), int(self.order))
        end, other = (self._moved(state, start, x) for x in (best, second))
        off = lax.stop_gradient(jnp.maximum(_relative(end.q, other.q), _relative(end.p, other.p)))
        return end, StepInfo(off, all_finite(end) & (off <= _ROUGH))

    def _unknowns(self, state: State) -> tuple[Any, Callable[[Any], Any]]:
        """What is integrated, and its time derivative."""
        if not self.form:
            return state, partial(time_derivative, self.system)
        form = _FORMS[self.form]
        return form.unknowns(state), form.rate(self.system)

    def _moved(self, state: State, start: Any, delta: Any) -> State:
        return _FORMS[self.form].moved(state, start, delta) if self.form else jax.tree.map(jnp.add, start, delta)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} is rough at dt = {dt}: its last two orders differ by more than {_ROUGH:g} of the state. Take "
            "a smaller dt"
        )


def _extrapolated(rate: Callable[[Any], Any], start: Any, dt: Array, order: int) -> tuple[Any, Any]:
    """Σ w_n S_n of this order, and of two less: one loop over pairs of sub-steps, that is compiled soon."""
    slope = kernel.stored(rate(start))

    def at(delta: Any) -> Any:
        return rate(jax.tree.map(jnp.add, start, delta))

    @kernel.stage
    def after(h: Array, before: Any, delta: Any) -> Any:
        return jax.tree.map(lambda x, f: x + 2 * h * f, before, at(delta))

    def first(h: Array) -> Any:
        return jax.tree.map(lambda x: h * x, slope)

    def two(carry: Any, row: tuple[Array, ...]) -> tuple[Any, None]:
        before, delta, best, second = carry
        h, last, w, v, following = row
        middle = after(h, before, delta)
        end = after(jnp.where(last, h / 2, h), delta, middle)

        def closed() -> Any:
            sums = (
                jax.tree.map(lambda s, x, y, w=w: s + w * ((x + y) / 2), sum_, middle, end)
                for sum_, w in ((best, w), (second, v))
            )
            return zero, first(following), *sums

        return lax.cond(last, closed, lambda: (middle, end, best, second)), None

    zero = jax.tree.map(jnp.zeros_like, start)
    last, *numbers = _rows(order)
    share, w, v, following = (jnp.asarray(x, dt.dtype) for x in numbers)
    rows: Any = (dt * share, last, w, v, dt * following)
    return lax.scan(two, (zero, first(dt * share[0]), zero, zero), rows)[0][2:]


def _rows(order: int) -> tuple[np.ndarray, ...]:
    """Of each pair of sub-steps: whether it ends a sequence, its size over Δt, both weights w_n, the size after it."""
    numbers = [2 * (j + 1) for j in range(order // 2)]
    of = np.repeat(np.arange(len(numbers)), [n // 2 for n in numbers])
    size, w, v = (np.array(x)[of] for x in (1 / np.array(numbers), weights(numbers), [*weights(numbers[:-1]), 0.0]))
    return np.append(np.diff(of) > 0, True), size, w, v, np.append(size[1:], 0.0)


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
    return Extrapolated(system, order, next((name for name, form in _FORMS.items() if form.known(system)), ""))


def weights(numbers: list[int]) -> list[float]:
    """w_n, which cancel the errors in h², h⁴, …, of sub-steps in these numbers."""
    return [math.prod(n * n / (n * n - k * k) for k in numbers if k != n) for n in numbers]


def _relative(x: Array, y: Array) -> Array:
    size = jnp.max(jnp.abs(x))
    return jnp.max(jnp.abs(x - y)) / jnp.where(size > 0, size, 1)


def examples(system: Any) -> dict[str, Step]:
    """Order 12, for free bodies, tops and several bodies."""
    if not (FREE_BODIES.declared(system) or isinstance(system, Top | Bodies)):
        return {}
    return {"extrapolate[12]": extrapolate(system)}
