"""The linearized step, and the defect of the symplectic form under it (3.1)."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics.arrays import PhaseMatrix, Scalar
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step
from lieint_jax.core.tangent import units, value_and_jacobian


def linearization(step: Step, state: State, dt: ArrayLike) -> PhaseMatrix:
    """The linearization L_n of a step, δz_{n+1} = L_n δz_n, by jacfwd.

    Args:
        step, state, dt: as in a call of the step.

    Returns:
        L_n, (2d, 2d). Rows and columns are the phase space's own coordinates: (δθ, δπ) on T*G, with δq = δθ q.
    """
    step.check(state, dt)
    return value_and_jacobian(step.system.phase_space, lambda z: step(z, dt), state)[2]


def symplectic_defect(step: Step, state: State, dt: ArrayLike) -> Scalar:
    """max|Lᵀω(z₁)L − ω(z₀)|: zero if and only if the step is symplectic at this state (3.1).

    Args:
        step, state, dt: as in a call of the step.

    Returns:
        A scalar in the units of the state: the (δθ, δθ) block is a momentum, the (δθ, δπ) blocks are numbers.
    """
    return jnp.max(jnp.abs(defect_matrix(step, state, dt)))


@partial(compiled, once=True)
def dimensionless_defect(step: Step, state: State, dt: Array, scale: State) -> Scalar:
    """The symplectic defect with δq and δp in units of the state `scale`, such as max|π|."""
    of_q, of_p = units(step.system.phase_space, scale)
    unit = jnp.sqrt(jnp.concatenate([of_q / of_p, of_p / of_q]))
    return jnp.max(jnp.abs(unit[:, None] * defect_matrix(step, state, dt) * unit[None]))


def defect_matrix(step: Step, state: State, dt: ArrayLike) -> PhaseMatrix:
    """Lᵀω(z₁)L − ω(z₀), shape (2d, 2d)."""
    step.check(state, dt)
    space = step.system.phase_space
    end, _, L = value_and_jacobian(space, lambda z: step(z, dt), state)
    return L.T @ space.omega(end) @ L - space.omega(state)
