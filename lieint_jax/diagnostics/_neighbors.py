"""Lyapunov exponents by other means than the tangent flow of the step: to verify `lyapunov`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from lieint_jax import _checks
from lieint_jax.core import State, Step, System
from lieint_jax.core.tangent import orthonormalize, units_at_start, value_and_jacobian
from lieint_jax.diagnostics._order import flow
from lieint_jax.runs import saves

__all__ = ["exponent_of_neighbors", "exponents_of_flow"]


def exponents_of_flow(system: System, state: State, t: float, pieces: int) -> Array:
    """The finite-time Lyapunov exponents of a system, from its vector field alone: an independent test of `lyapunov`.

    They are those of the derivative of `flow`, by autodiff through collocation of order 16.

    Args:
        system: the system.
        state: the initial state of one body.
        t: the time over which the exponents are taken.
        pieces: the number of QR decompositions; each piece is integrated in two steps.

    Returns:
        (2d,), in the order of the coordinates of the phase space, 1/time.
    """
    _checks.all_plain(t=t)
    pieces, space = _checks.count("pieces", pieces, 1), system.phase_space
    unit = units_at_start(system, state)[:, None]

    def step_once(carry: tuple[State, Array, Array], _: None) -> tuple[tuple[State, Array, Array], None]:
        state, frame, sums = carry
        end, _, L = value_and_jacobian(space, lambda z: (flow(system, z, t / pieces, 2), None), state)
        frame, growth = orthonormalize(L @ (unit * frame) / unit)
        return (end, frame, sums + growth), None

    start = (state, jnp.eye(space.dim), jnp.zeros(space.dim))
    return lax.scan(step_once, start, None, length=pieces)[0][2] / t


def exponent_of_neighbors(
    step: Step, state: State, dt: float, num_steps: int, *, every: int = 20, distance: float = 1e-8
) -> Array:
    """The largest Lyapunov exponent from two neighboring trajectories, without derivatives: another test of `lyapunov`.

    Args:
        step: the step.
        state: the initial state of one body.
        dt: step size.
        num_steps: a multiple of `every`.
        every: steps after which the separation is rescaled.
        distance: to which it is rescaled, in the units of the phase space's coordinates at the start, such as max|π|.

    Source: Benettin, Galgani & Strelcyn 1976, Phys. Rev. A 14, 2338.
    """
    _checks.all_plain(dt=dt, distance=distance)
    every = _checks.count("every", every, 1)
    rounds = saves(_checks.count("num_steps", num_steps, 1), every)
    space = step.system.phase_space
    unit = units_at_start(step.system, state)

    def separation(a: State, b: State) -> Array:
        return space.trivialize(a, jax.tree.map(jnp.subtract, b, a)) / unit

    def step_once(carry: tuple[State, State, Array], _: None) -> tuple[tuple[State, State, Array], None]:
        a, b, total = carry
        a, b = lax.fori_loop(0, every, lambda _, z: (step(z[0], dt)[0], step(z[1], dt)[0]), (a, b))
        delta = separation(a, b)
        size = jnp.linalg.norm(delta)
        return (a, space.perturb(a, unit * delta * (distance / size)), total + jnp.log(size / distance)), None

    first = jnp.zeros(space.dim).at[0].set(distance)
    start = state, space.perturb(state, unit * first), jnp.zeros(())
    return lax.scan(step_once, start, None, length=rounds)[0][2] / (dt * every * rounds)
