"""`scan`: loops of users in machine code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lieint_jax import _checks
from lieint_jax.native import _march_derivatives, _march_members  # noqa: F401  # the rules of the primitive
from lieint_jax.native._march import TracedStep, march, traced_step

_Carry = TypeVar("_Carry")
_X = TypeVar("_X")
_Y = TypeVar("_Y")


def scan(
    f: Callable[[_Carry, _X], tuple[_Carry, _Y]],
    init: _Carry,
    xs: _X | None = None,
    length: int | None = None,
    *,
    every: int = 1,
    reverse: bool = False,
) -> tuple[_Carry, _Y]:
    """`jax.lax.scan` in machine code: small steps, and above all their gradients, run faster.

    Under `jax.vmap` the members are the lanes of the processor's vectors. A step that XLA fuses into one operation on
    all members, such as the logistic map, gains in its gradient only. All transformations of JAX apply: `jit`, `vmap`,
    `jvp`, `grad`, `jax.checkpoint`, derivatives of derivatives. Reverse mode stores the carries before about 2√length
    steps, and computes the others again. On a GPU the loop is one kernel. Where a step has an operation without a
    formula in machine code, XLA runs the loop; the log says so. Outside of `jax.jit` a function is compiled once, and
    again if it reads other numbers from outside than before; a derivative is compiled in each call.

    Args:
        f: (carry, x) ↦ (carry, y), a pure function of small arrays: each of their entries is a number of the program.
        init: the first carry, a tree of arrays.
        xs: a tree of arrays with a leading axis of steps, or None.
        length: the number of steps, if xs is None.
        every: only each `every`-th y is stored; it divides the number of steps.
        reverse: whether the steps go from the last x to the first.

    Returns:
        (carry, ys): the last carry, and the stored y with a leading axis of length // every.

    Raises:
        ValueError: the lengths do not agree, or f does not return (carry, y) with a carry like `init`.

    Example:
        >>> import jax, jax.numpy as jnp, lieint_jax as li
        >>> def logistic(x, _):
        ...     return 3.2 * x * (1 - x), x
        >>> end, path = jax.vmap(lambda x: li.scan(logistic, x, length=1000, every=500))(jnp.array([0.2, 0.7]))
        >>> path.shape
        (2, 2)
    """
    length = None if length is None else _checks.count("length", length, 0)
    every = _checks.count("every", every, 1)
    shapes = [np.shape(x) for x in jax.tree.leaves(xs)]
    lengths = {shape[:1] for shape in shapes} | ({(length,)} if length is not None else set())
    if len(lengths) != 1 or () in lengths:
        raise ValueError(
            "scan needs one number of steps, the leading axis of each array of xs, and length if it is given: "
            f"got length={length} and xs of shapes {shapes}"
        )
    [(steps,)] = lengths
    if steps % every:
        raise ValueError(f"every must divide the number of steps, {steps}, got {every}")
    init, step = _with_common_types(f, init, xs)
    carry, ys = march(step, init, xs, rows=steps // every, every=every, reverse=reverse)
    return _weakly_typed(carry, _are_weak(jax.tree.leaves(step.after))), ys


class _Unnumbered(NamedTuple):
    """A step that does not read its number, equal to another of the same function.

    Attributes:
        f: the function.
        weak: which arrays of the carry take the type of others, as Python's numbers do.
    """

    f: Callable[[Any, Any], tuple[Any, Any]]
    weak: tuple[bool, ...]

    def __call__(self, n: Any, carry: Any, x: Any) -> tuple[Any, Any]:
        return self.f(_weakly_typed(carry, self.weak), x)


def _with_common_types(f: Callable[[Any, Any], Any], init: Any, xs: Any) -> tuple[Any, TracedStep]:
    """The first carry in the types that `jax.lax.scan` carries, and the step of f for it.

    Where f returns another type of a weakly typed array, such as a Python number, the array gets the type that they
    have in common. Where it is not the type that f then returns, `march` says so.
    """
    given, structure = jax.tree.flatten(init)
    carried, rows = [jax.typeof(x) for x in given], jax.tree.map(jax.typeof, xs)

    def traced() -> TracedStep:
        return traced_step(_Unnumbered(f, _are_weak(carried)), jax.tree.unflatten(structure, carried), rows)

    step = traced()
    pairs = list(zip(carried, jax.tree.leaves(step.after), strict=True))
    if any(x.weak_type and x.dtype != y.dtype for x, y in pairs):
        carried = [_common_type(x, y) if x.weak_type else x for x, y in pairs]
        given = [jnp.asarray(x, t.dtype) for x, t in zip(given, carried, strict=True)]
        step = traced()
    return jax.tree.unflatten(structure, given), step


def _are_weak(types: Sequence[Any]) -> tuple[bool, ...]:
    return tuple(x.weak_type for x in types)


def _common_type(x: Any, y: Any) -> Any:
    """The type of x, or of the kind of number that it and y have in common if y has another."""
    if x.dtype == y.dtype:
        return x
    scalars = (jax.ShapeDtypeStruct((), of.dtype, weak_type=of.weak_type) for of in (x, y))
    common = jax.eval_shape(lambda x, y: jnp.where(True, x, y), *scalars)
    return jax.ShapeDtypeStruct(x.shape, common.dtype)


def _weakly_typed(tree: Any, weak: tuple[bool, ...]) -> Any:
    """A tree in which the arrays that are marked take the type of others."""
    if not any(weak):
        return tree
    leaves, structure = jax.tree.flatten(tree)
    made = [
        lax.convert_element_type_p.bind(x, new_dtype=x.dtype, weak_type=True, sharding=None) if w else x
        for x, w in zip(leaves, weak, strict=True)
    ]
    return jax.tree.unflatten(structure, made)
