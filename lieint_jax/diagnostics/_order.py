"""Measured order and reversibility. The reference is the flow of the system's vector field, not the scheme itself."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import as_array, concrete, plain
from lieint_jax._numerics import collocation
from lieint_jax._numerics.arrays import Scalar
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, System, clock, time_derivative
from lieint_jax.core.tangent import distance, scale_at, swinging
from lieint_jax.diagnostics import _measure
from lieint_jax.runs import steps

_STAGES, _ITERATIONS = 8, 24


def flow(system: System, state: State, t: ArrayLike, num_steps: int) -> State:
    """A reference solution: the state after time t, by Gauss–Legendre collocation of order 16 of `system.vector_field`.

    It shares no code with the schemes: it uses ambient coordinates, and fixed-point iteration for the stages. Its error
    is a few round-offs for |t Ω| / num_steps ≤ 1/2. NaN where the iteration does not converge.

    Args:
        system: the system.
        state: the initial state.
        t: the time, of either sign.
        num_steps: the number of steps.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, II.1.3.
    """
    return _flow(system, state, plain("t", t), _checks.count("num_steps", num_steps, 1))


@partial(compiled, static_argnums=3)
def _flow(system: System, state: State, t: ArrayLike, num_steps: int) -> State:
    z0, unravel = ravel_pytree(state)
    _, A, b = (jnp.asarray(x, z0.dtype) for x in collocation.gauss(_STAGES))
    h = jnp.asarray(t, z0.dtype) / num_steps

    def begin(z: Array) -> Array:
        return ravel_pytree(system.sampled(unravel(z), h)[0])[0]

    f = jax.vmap(lambda z: ravel_pytree(time_derivative(system, unravel(z)))[0])

    def step_once(z: Array, _: None) -> tuple[Array, None]:
        z = begin(z)
        start = jnp.zeros((_STAGES, z.size), z.dtype)
        k, before = lax.fori_loop(0, _ITERATIONS, lambda _, k: (f(z[None] + h * (A @ k[0])), k[0]), (start, start))
        change, size = (jnp.max(jnp.abs(x)) for x in (h * (k - before), z))
        return jnp.where(change <= jnp.sqrt(jnp.finfo(z.dtype).eps) * size, z + h * (b @ k), jnp.nan), None

    return unravel(lax.scan(step_once, z0, None, length=num_steps)[0])


def order(step: Step, state: State, dt: float, num_steps: int = 8) -> float:
    """The order of accuracy, fitted to the errors at time T = num_steps·dt of runs with different step sizes.

    The sizes are dt, dt/2, dt/4; if fewer than two of these have errors above round-off, also 2dt, 4dt, … up to T. If
    the step advances the time itself, a run is compared with the flow at the time at which the run ends.

    Args:
        step: a scheme's step.
        state: the initial state, not an equilibrium.
        dt: a step size within the scheme's limit.
        num_steps: the number of steps of that size.

    Returns:
        The slope of log error against log step size, over the converged runs with errors above the floor of round-off;
        inf if there are fewer than two such runs, that is, if no error is measurable.
    """
    num_steps = _checks.count("num_steps", num_steps, 1)
    most = 4 * num_steps
    step, state, _ = _measure.checked(step, state, dt, most)
    return fitted_order(step, state, dt, num_steps, most)


def fitted_order(step: Step, state: State, dt: float, num_steps: int, most: int) -> float:
    """`order` of checked arguments, by the program of runs of up to `most` steps."""
    dtype, T = state.p.dtype, num_steps * dt
    floor = 100 * np.sqrt(num_steps) * float(jnp.finfo(dtype).eps)
    seen: dict[float, float] = {}

    def exact(t: ArrayLike) -> State:
        return flow(step.system, state, t, 2 * num_steps)

    end = None if step.own_time else exact(T)

    def look(n: int) -> None:
        run = _measure.run(step, state, as_array(T / n, dtype), n, most)
        last = _measure.last(run)
        true = exact(clock(last) - clock(state)) if end is None else end
        error = float(_distance(step, last, true, true))
        if error > floor and run.info.converged.all():
            seen[T / n] = error

    for fine in (1, 2, 4):
        look(fine * num_steps)
    n = num_steps
    while len(seen) < 2 and n > 1:
        n //= 2
        if not _measure.run(step, state, as_array(T / n, dtype), 1, most).info.converged[1]:
            break
        look(n)
    if len(seen) < 2:
        return float("inf")
    return float(np.polyfit(np.log(np.abs(list(seen))), np.log(list(seen.values())), 1)[0])


@partial(compiled, once=True)
def _distance(step: Step, a: State, b: State, scale: State) -> Scalar:
    return distance(a, b, step.system.phase_space, scale=scale)


def reversibility(step: Step, state: State, dt: ArrayLike) -> Scalar:
    """`distance` of z and step(step(z, dt), −dt): zero to round-off if and only if the step is time-symmetric here.

    It is infinite if the step of −dt does not converge, as those of a sampled law, which has no way back.
    """
    step, state, h = _measure.checked(step, state, dt, 1)
    return reversibility_of_run(step, state, h, 1, scale_at(step.system, state))


def reversibility_of_run(step: Step, state: State, dt: Array, most: int, scale: State) -> Scalar:
    """`reversibility` of checked arguments, by the program of runs of up to `most` steps."""
    back = as_array(-np.asarray(dt)) if concrete(dt) else -dt
    there = _measure.last(_measure.run(step, state, dt, 1, most))
    returned = _measure.run(step, there, back, 1, most)
    found, accepted = _distance(step, _measure.last(returned), state, scale), returned.info.converged[1]
    if step.approximate or (concrete(accepted) and accepted):
        return found
    return jnp.where(accepted, found, jnp.inf)


def round_trip_error(step: Step, state: State, dt: ArrayLike, num_steps: int) -> Array:
    """The distance between the initial state and its image after `num_steps` steps of dt and as many of −dt.

    It is the error of the states that `ReversibleAdjoint` rebuilds, in q, and in p over max|p|. On a regular motion it
    is a few round-offs per step; on others it grows like the distance of neighboring trajectories, over a time t on a
    chaotic motion of Lyapunov exponent λ like e^(λt). The gradient's relative error is about this error times the
    second derivative of the flow.

    Raises:
        ValueError: a bad number of steps; the step is not symmetric; or the first step does not converge.
    """
    num_steps = _checks.count("num_steps", num_steps, 0)
    step, state, h = _measure.checked(step, state, dt, 1)
    if not step.symmetric:
        raise ValueError(f"{step.name} is not symmetric, so steps of −dt do not undo its steps: use a symmetric scheme")
    return _there_and_back(step, state, h, num_steps)


@compiled
def _there_and_back(step: Step, state: State, h: Array, num_steps: ArrayLike) -> Array:
    prepared = step.prepare(state, h)
    end, _ = steps(prepared, state, h, num_steps)
    back, _ = steps(prepared, end, -h, num_steps)
    return distance(back, state, step.system.phase_space, scale=swinging(step.system, state))
