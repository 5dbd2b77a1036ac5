"""The Poisson error of a trajectory: the transported Poisson matrix less ω⁻¹ (Sections 3.3 and 5.3)."""

from __future__ import annotations

from functools import partial
from typing import Literal, get_args

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import MatrixSeries
from lieint_jax._xla import compiled
from lieint_jax.capabilities import (
    AbstractDampedBody,
    AbstractForcedSystem,
    AbstractRightGeodesicFlow,
    AbstractTorquedBody,
)
from lieint_jax.core import State, Step
from lieint_jax.diagnostics._symplectic import linearization
from lieint_jax.phase_spaces import CotangentGroup

_Method = Literal["recursion", "product"]
_OTHERS = (
    AbstractForcedSystem,
    AbstractRightGeodesicFlow,
    AbstractTorquedBody,
    AbstractDampedBody,
)  # than left-invariant systems without potential


def poisson_error(
    step: Step, state: State, dt: ArrayLike, num_steps: int, *, method: _Method | None = None
) -> MatrixSeries:
    """The Poisson error along a run, which is zero if and only if all its steps are symplectic.

    The linearized steps transport the Poisson matrix, P_{n+1} = L_n P_n L_nᵀ (5.34) from P₀ = ω⁻¹(z₀). For
    left-invariant systems on T*G without potential, P_n stays of the form [[σ_n, −1], [1, α]] (5.35), and the error is
    σ_n, shape (num_steps+1, d, d), skew. For all others it is P_n − ω⁻¹(z_n), shape (num_steps+1, 2d, 2d).

    Args:
        step: a scheme's step.
        state: the initial state.
        dt: step size.
        num_steps: the number of steps.
        method: "recursion" sums (5.36) from the block C_n of the linearized step (5.29), and stays at round-off for a
            symplectic scheme; "product" multiplies by (5.34) and returns the block σ_n. For left-invariant systems
            without potential both give the same, and "recursion" is the default; all others require "product".

    Returns:
        The error, of one of the shapes above.

    Raises:
        ValueError: a bad count, an unknown method, or "recursion" for a system with a potential, with a right-invariant
            metric, or not on a T*G.
    """
    num_steps = _checks.count("num_steps", num_steps, 0)
    if method not in (None, *get_args(_Method)):
        raise ValueError(f"method must be one of {', '.join(get_args(_Method))}, got {method!r}")
    step.check(state, dt)
    space = step.system.phase_space
    if not isinstance(space, CotangentGroup) or isinstance(step.system, _OTHERS):
        if method == "recursion":
            raise ValueError(
                f"the recursion (5.36) is for left-invariant systems on T*G without potential, got "
                f"{type(step.system).__name__}; use method='product'"
            )
        return _all_errors(step, state, dt, num_steps)
    if method == "product":
        d = space.dim // 2
        return _all_errors(step, state, dt, num_steps)[:, :d, :d]
    return _recursion(step, state, dt, num_steps)


@partial(compiled, static_argnums=3)
def _recursion(step: Step, state: State, dt: ArrayLike, num_steps: int) -> MatrixSeries:
    """σ_n by (5.36), shape (num_steps+1, d, d)."""
    space = step.system.phase_space
    d, omega = space.dim // 2, space.omega(state)
    alpha, one = omega[:d, :d], jnp.eye(d, dtype=omega.dtype)

    def one_step(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], Array]:
        state, sigma = carry
        C = linearization(step, state, dt)[:d, d:]
        M = C @ (one + alpha @ sigma) @ (2 * one - alpha @ C.T)
        sigma = sigma + (M - M.T) / 2
        return (step(state, dt)[0], sigma), sigma

    _, sigma = lax.scan(one_step, (state, 0 * one), None, length=num_steps)
    return jnp.concatenate([0 * one[None], sigma])


@partial(compiled, static_argnums=3)
def _all_errors(step: Step, state: State, dt: ArrayLike, num_steps: int) -> MatrixSeries:
    """P_n − ω⁻¹(z_n), shape (num_steps+1, 2d, 2d)."""
    space = step.system.phase_space

    def poisson(state: State) -> Array:
        return jnp.linalg.inv(space.omega(state))

    def one_step(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], Array]:
        state, P = carry
        L = linearization(step, state, dt)
        state, P = step(state, dt)[0], L @ P @ L.T
        return (state, P), P - poisson(state)

    P = poisson(state)
    _, errors = lax.scan(one_step, (state, P), None, length=num_steps)
    return jnp.concatenate([0 * P[None], errors])
