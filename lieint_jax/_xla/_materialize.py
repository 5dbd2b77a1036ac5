"""Numbers that XLA computes once and stores in memory; and those that reverse mode computes again instead.

A step of a long loop has about a hundred intermediate values, each of which would be an array over the steps, written
entry by entry. Computing them again is faster than storing them, halves the compile time and needs hardly any memory.
Values that are expensive to compute, such as a root found by iteration, are `saved`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir

from lieint_jax._xla._compile import Tree

once_p = Primitive("once")  # the same array, computed once
_SAVED = "lieint_jax"
_Function = TypeVar("_Function", bound=Callable[..., Tree])
_Tree = TypeVar("_Tree")


def materialized(numbers: Tree) -> Tree:
    """The same numbers, an array (n,) or a list of arrays of one shape, each computed once and stored in memory."""
    return tuple(map(once_p.bind, numbers))


def unfused(x: Tree) -> Tree:
    """The same array, which XLA computes before the operations that use it."""
    return lax.optimization_barrier(x)


def materialized_arrays(tree: Tree) -> Tree:
    """The same arrays, those of real numbers each computed once and stored in memory."""
    return jax.tree.map(lambda x: once_p.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def with_materialized_derivatives(tree: Tree) -> Tree:
    """The same arrays of real numbers, materialized together with their tangents where forward mode differentiates.

    XLA computes the tangent of a long function again for each of its results. Without a derivative this costs nothing.
    """
    return jax.tree.map(_identity, tree)


@jax.custom_jvp
def _identity(x: Array) -> Array:
    return x


@_identity.defjvp
def _identity_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return once_p.bind(*primals), once_p.bind(*tangents)


def _divide_by_one(x: Array) -> Array:
    """x/1 with a 1 that the compiler cannot know, since x may be NaN.

    XLA on CPUs has no barrier that persists until fusion, but it does not compute a division twice. A divisor that is a
    broadcast array would not do: XLA multiplies by its reciprocal. So this is a primitive, which sees its final shape.
    """
    return x / (1 + 0 * x)


once_p.def_impl(lambda x: x)
once_p.def_abstract_eval(lambda aval: aval)
ad.deflinear2(once_p, lambda ct, _: [once_p.bind(ct)])
batching.defvectorized(once_p)
mlir.register_lowering(once_p, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(once_p, mlir.lower_fun(_divide_by_one, multiple_results=False), platform="cpu")


def rematerialized(function: _Function) -> _Function:
    """The body of a loop, of which reverse mode stores only the arguments and the values that are `saved`."""
    return jax.checkpoint(function, prevent_cse=False, policy=_is_saved)  # pyright: ignore[reportReturnType]


def saved(tree: _Tree) -> _Tree:
    """The same arrays, which a function that is `rematerialized` does not compute again."""
    return jax.tree.map(lambda x: checkpoint_name(x, _SAVED), tree)


def _is_saved(primitive: object, *_: object, **parameters: Any) -> bool:
    """True if the results of an operation are saved; a `custom_root` with a saved root is one operation here."""
    composite = parameters["_prim"].params if "_prim" in parameters else {}  # what `custom_root` is in JAX ≥ 0.12
    inside = [getattr(x, "jaxpr", x) for x in (*parameters.values(), *composite.values())]
    equations = [equation for x in inside if isinstance(x, Jaxpr | ClosedJaxpr) for equation in x.eqns]
    return _SAVED in (parameters.get("name"), *(equation.params.get("name") for equation in equations))
