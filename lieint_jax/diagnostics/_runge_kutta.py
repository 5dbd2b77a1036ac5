"""The classical Runge–Kutta method, to compare with, and the cost of a step."""

from __future__ import annotations

import timeit
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics import vectors
from lieint_jax.core import PhaseSpace, State, Step, StepInfo, System, pytree, static, time_derivative
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentMotions
from lieint_jax.runs import compiler_options, integrate

__all__ = ["RungeKutta", "step_cost"]

_BODIES, _STEPS, _ROUNDS = 256, 50, 5


@pytree
class RungeKutta(Step):
    """The classical Runge–Kutta step of order 4, which conserves nothing: what a scheme of this package improves on.

    It evaluates the vector field four times, and normalizes quaternions, and the direction of a pendulum, after each
    step.

    Args:
        system: any system with a vector field.

    Example:
        >>> from lieint_jax import systems
        >>> body = systems.rigid_body([1.0, 2.0, 3.0])
        >>> start = body.state(angular_velocity=[0.2, 0.0, 1.0])
        >>> run = integrate(RungeKutta(body), start, 0.2, 1000, save_every=1000)
        >>> lost = 1 - body.energy(jax.tree.map(lambda x: x[-1], run.state)) / body.energy(start)
        >>> bool(1e-6 < lost < 1e-3)
        True
    """

    system: System
    order: float = static(default=4)
    symmetric: bool = static(default=False)

    @property
    def name(self) -> str:
        return "Runge–Kutta 4"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        state, fits = self.system.sampled(state, jnp.asarray(dt))

        def slope_after(h: ArrayLike, slope: State) -> State:
            return time_derivative(self.system, jax.tree.map(lambda x, v: x + h * v, state, slope))

        k1 = time_derivative(self.system, state)
        k2 = slope_after(dt / 2, k1)
        k3 = slope_after(dt / 2, k2)
        k4 = slope_after(dt, k3)
        end = jax.tree.map(lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4)
        info = StepInfo(jnp.zeros_like(dt), jnp.isfinite(end.p).all() & fits)
        return end._replace(q=_normalize(self.system.phase_space, end.q)), info


def _normalize(space: PhaseSpace, q: Array) -> Array:
    """Attitudes and directions of length 1; matrices as they are."""
    if isinstance(space, CotangentMotions):
        return jnp.concatenate([q[:, :3], jax.vmap(so3.normalize)(q[:, 3:])], axis=1)
    if q.ndim > 1:
        return q
    return so3.normalize(q) if q.shape == (4,) else q / vectors.norm(q)


def step_cost(step: Step, state: State, dt: float) -> float:
    """Measure the seconds per step of a batch of 256 members, without compilation: the least of five rounds.

    Args:
        step: the step.
        state: the state from which all members start.
        dt: the step size.
    """

    @partial(jax.jit, compiler_options=compiler_options())
    def run(states: State) -> Any:
        return jax.vmap(lambda z: integrate(step, z, dt, _STEPS, save_every=_STEPS))(states).state

    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (_BODIES, *jnp.shape(x))), state)
    jax.block_until_ready(run(states))
    return min(timeit.repeat(lambda: jax.block_until_ready(run(states)), repeat=_ROUNDS, number=1)) / _STEPS
