"""Tangent vectors in the coordinates of a phase space, and their images under a map of states."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.types._group import PhaseSpace
from lieint_jax.types._state import State
from lieint_jax.types.shapes import PhaseVector, TangentVectors

__all__ = ["push_forward"]

_Aux = TypeVar("_Aux")


def push_forward(
    space: PhaseSpace, function: Callable[[State], tuple[State, _Aux]], state: State, T: TangentVectors
) -> tuple[State, _Aux, TangentVectors]:
    """end, aux = function(state), and the images LT of tangent vectors, columns of T, under the derivative of end.

    Time, work and extra are held fixed.
    """

    def push(delta: Array) -> tuple[Array, State, _Aux]:
        start = state.q, state.p
        along = jax.tree.map(lambda x, slope: slope.astype(x.dtype), start, _tangent_vector(space, state, delta))
        end, tangent, aux = jax.jvp(lambda q, p: function(state._replace(q=q, p=p)), start, along, has_aux=True)
        return space.trivialize(end, tangent), end, aux

    LT, *values = jax.vmap(push, -1, -1)(T)
    end, aux = jax.tree.map(lambda x: x[..., 0], values)  # the same for all vectors, and so computed once
    return end, aux, LT


def _tangent_vector(space: PhaseSpace, state: State, delta: PhaseVector) -> tuple[Array, Array]:
    """(δq, δp), the inverse of `trivialize`; a space may have it as `tangent`, faster than the derivative here."""
    own = getattr(space, "tangent", None)
    if own is not None:
        return own(state, delta)
    tangent = jax.jvp(lambda x: space.perturb(state, x), (jnp.zeros_like(delta),), (delta,))[1]
    return tangent.q, tangent.p
