"""The linearized step, and the defect of the symplectic form under it (3.1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax.types import PhaseSpace, State, Step
from lieint_jax.types.shapes import PhaseMatrix, Scalar

_Aux = TypeVar("_Aux")


def linearization(step: Step, state: State, dt: ArrayLike) -> PhaseMatrix:
    """The linearization L_n of a step, δz_{n+1} = L_n δz_n, by jacfwd.

    Args:
        step, state, dt: as in a call of the step.

    Returns:
        L_n, (2d, 2d). Rows and columns are the phase space's own coordinates: (δθ, δπ) on T*G, with δq = δθ q.
    """
    step.check(state, dt)
    return pushed(step.system.phase_space, lambda z: step(z, dt), state)[2]


# Dimensions above which the columns of a derivative are taken one by one: XLA fuses a batch of them so that each
# element is computed again for each of its uses. With 64 molecules, and with three bodies by `nystrom`, a certificate
# took many minutes.
_LARGE = 24


def pushed(
    space: PhaseSpace, function: Callable[[State], tuple[State, _Aux]], state: State
) -> tuple[State, _Aux, Array]:
    """end, aux = function(state), and the derivative of end, (2d, 2d), in the coordinates of the phase space."""

    def push(delta: Array) -> tuple[State, tuple[State, _Aux]]:
        end, aux = function(space.perturb(state, delta))
        return end, (end, aux)

    start = jnp.zeros(space.dim, state.p.dtype)
    if space.dim > _LARGE:
        _, along, (end, aux) = jax.linearize(push, start, has_aux=True)
        columns = jax.lax.map(lambda delta: space.trivialize(end, along(delta)), jnp.eye(space.dim, dtype=start.dtype))
        return end, aux, columns.T
    tangents, (end, aux) = jax.jacfwd(push, has_aux=True)(start)
    return end, aux, jax.vmap(lambda tangent: space.trivialize(end, tangent), in_axes=-1, out_axes=-1)(tangents)


def symplectic_defect(step: Step, state: State, dt: ArrayLike) -> Scalar:
    """max|Lᵀω(z₁)L − ω(z₀)|: zero if and only if the step is symplectic at this state (3.1).

    Args:
        step, state, dt: as in a call of the step.

    Returns:
        A scalar in the units of the state: the (δθ, δθ) block is a momentum, the (δθ, δπ) blocks are numbers.
    """
    return jnp.max(jnp.abs(defect_matrix(step, state, dt)))


def defect_matrix(step: Step, state: State, dt: ArrayLike) -> PhaseMatrix:
    """Lᵀω(z₁)L − ω(z₀), shape (2d, 2d)."""
    step.check(state, dt)
    space = step.system.phase_space
    end, _, L = pushed(space, lambda z: step(z, dt), state)
    return L.T @ space.omega(end) @ L - space.omega(state)
