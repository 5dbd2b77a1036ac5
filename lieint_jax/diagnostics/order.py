"""Measured order and reversibility. The reference is the system's own vector field, not another run of the scheme."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax.integrate import integrate
from lieint_jax.types import State, Step, System

_ROWS = 8


def flow(system: System, state: State, t: ArrayLike, num_steps: int) -> State:
    """The state after time t, by extrapolating Gragg's modified midpoint rule for `system.vector_field` to order 16.

    Good to a few times round-off for |t Ω| / num_steps ≤ 1. It conserves nothing by construction: a reference that
    shares nothing with the schemes. Source: Hairer, Nørsett & Wanner, Solving ODEs I, II.9.
    """
    z0, unravel = ravel_pytree(state)
    H = jnp.asarray(t, z0.dtype) / num_steps

    def f(z: Array) -> Array:
        return ravel_pytree(system.vector_field(unravel(z)))[0]

    def midpoint(z: Array, n: int) -> Array:
        h = H / n
        pair = lax.fori_loop(1, n, lambda _, p: (p[1], p[0] + 2 * h * f(p[1])), (z, z + h * f(z)))
        return pair[1]

    def one(z: Array, _: None) -> tuple[Array, None]:
        counts = [2 * (j + 1) for j in range(_ROWS)]
        row = [midpoint(z, n) for n in counts]
        for k in range(1, _ROWS):
            row = [
                b + (b - a) / ((counts[j + k] / counts[j]) ** 2 - 1) for j, (a, b) in enumerate(itertools.pairwise(row))
            ]
        return row[0], None

    return unravel(lax.scan(one, z0, None, length=num_steps)[0])


def order(step: Step, state: State, dt: float, num_steps: int = 8, levels: int = 3) -> float:
    """The order of accuracy, fitted to the errors at time T = num_steps·dt of runs with dt, dt/2, …

    Args:
        step: a scheme's step.
        state: the initial state; one whose motion is not an equilibrium.
        dt: the largest step.
        num_steps: steps of that size.
        levels: how many step sizes.

    Returns:
        The slope of log error against log dt over the errors above the floor of round-off; inf if fewer than two are
        above it, that is, if the scheme is exact as far as can be seen.
    """
    end = flow(step.system, state, num_steps * dt, num_steps)
    dts = dt / 2.0 ** np.arange(levels)
    errors = []
    for k, h in enumerate(dts):
        n = num_steps * 2**k
        last = jax.tree.map(lambda leaf: leaf[-1], integrate(step, state, float(h), n, n).state)
        errors.append(float(distance(last, end)))
    errors = np.array(errors)
    scale = max(float(jnp.max(jnp.abs(leaf))) for leaf in end)
    above = errors > 100 * np.sqrt(num_steps) * jnp.finfo(end.p.dtype).eps * scale
    if above.sum() < 2:
        return float("inf")
    return float(np.polyfit(np.log(dts[above]), np.log(errors[above]), 1)[0])


def distance(a: State, b: State) -> Array:
    """The largest difference of two states in the coordinates of `State`."""
    return jnp.maximum(jnp.max(jnp.abs(a.q - b.q)), jnp.max(jnp.abs(a.p - b.p)))


def reversibility(step: Step, state: State, dt: ArrayLike) -> Array:
    """max|z − step(step(z, dt), −dt)|: zero to round-off if and only if the step is time-symmetric here."""
    back, _ = step(step(state, dt)[0], -jnp.asarray(dt))
    return distance(back, state)
