"""Steps of a body whose inertia is a function of time, by steps of the body frozen at the middle of each.

    ½ Π·J⁻¹Π |_n^{n+1} = ½ Π_n·(J_m⁻¹ − J_n⁻¹)Π_n + (that of the frozen step) + ½ Π_{n+1}·(J_{n+1}⁻¹ − J_m⁻¹)Π_{n+1}

for J_m = J(t + ½Δt). The frozen step is symmetric, of second order, and exact in its energy and work, so the whole step
is too, with the outer terms as the work of what moves the masses; and it is symplectic where the frozen step is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics.vectors import Symmetric, dot, symmetric
from lieint_jax.core import State, StepInfo, clock
from lieint_jax.groups import so3
from lieint_jax.systems._equations import AbstractBodyInTime


def step_in_time(
    system: AbstractBodyInTime, state: State, dt: ArrayLike, advance: Callable[[Any, State], tuple[State, StepInfo]]
) -> tuple[State, StepInfo]:
    """The step, by `advance(frozen body, state)`; `converged` only if J is positive definite at its three times."""
    t = clock(state)
    middle = t + jnp.asarray(dt) / 2
    end, info = advance(system.frozen(middle), state)
    start, mid, last = [symmetric(system.inertia_at(x)) for x in (t, middle, t + dt)]
    if state.work is not None and end.work is not None:
        before, after = so3.Ad_star(state.q, state.p), so3.Ad_star(end.q, end.p)
        end = end._replace(work=end.work + (_change(before, start, mid) + _change(after, mid, last)))
    return end, info._replace(converged=info.converged & _positive(start) & _positive(mid) & _positive(last))


def advice_in_time(system: AbstractBodyInTime, state: State, dt: ArrayLike) -> str:
    """The advice where J is not positive definite in a step; empty where it is."""
    for part in (0, 0.5, 1):
        t = clock(state) + part * jnp.asarray(dt)
        if not bool(_positive(symmetric(J := system.inertia_at(t)))):
            return (
                f"the inertia is not positive definite at t = {float(t):g}, where the function of time returns "
                f"{J.tolist()}: end the run before, or correct the function"
            )
    return ""


def _change(Pi: Array, before: Symmetric, after: Symmetric) -> Array:
    """½ Π·(J′⁻¹ − J⁻¹)Π = −½ J⁻¹Π·(J′ − J)J′⁻¹Π, which has no cancellation."""
    return -dot(before.solve(Pi), (after - before) @ after.solve(Pi)) / 2


def _positive(J: Symmetric) -> Array:
    trace = J.trace
    return (trace > 0) & ((1 / jnp.where(trace > 0, trace, 1)) * J).positive_definite
