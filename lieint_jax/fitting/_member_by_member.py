"""A model whose values and derivatives are computed together, and one member of a batch after the other."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax import Array
from jax.custom_batching import sequential_vmap
from jax.flatten_util import ravel_pytree

from lieint_jax._numerics.arrays import PyTree


def member_by_member(function: Callable[[PyTree, PyTree], Array]) -> Callable[[PyTree, PyTree], Array]:
    """The same function of (params, data), for which `vmap` is a loop and whose Jacobian is computed in one piece.

    Use it for a long computation of few numbers, such as the closed form of a free body's motion: otherwise XLA fuses a
    batch of its derivatives so that each element is computed again for each of its uses, in seconds instead of
    milliseconds.

    Args:
        function: params, data ↦ an array. It is differentiated with respect to the parameters, in forward mode; the
            data are constants.
    """

    @sequential_vmap
    def value_and_jacobian(params: PyTree, data: PyTree) -> tuple[Array, Array]:
        x, unravel = ravel_pytree(params)

        def twice(x: Array) -> tuple[Array, Array]:
            value = function(unravel(x), data)
            return value, value

        J, value = jax.jacfwd(twice, has_aux=True)(x)
        return value, J

    @jax.custom_jvp
    def call(params: PyTree, data: PyTree) -> Array:
        return value_and_jacobian(params, data)[0]

    @call.defjvp
    def _(primals: tuple[PyTree, PyTree], tangents: tuple[PyTree, PyTree]) -> tuple[Array, Array]:
        value, J = value_and_jacobian(*primals)
        return value, J @ ravel_pytree(tangents[0])[0]

    return call
