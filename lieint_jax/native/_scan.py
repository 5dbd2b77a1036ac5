"""`scan`: loops of users in machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from lieint_jax.native import _march_derivatives, _march_members  # noqa: F401  # the rules of the primitive
from lieint_jax.native._march import march

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
    shapes = [np.shape(x) for x in jax.tree.leaves(xs)]
    lengths = {shape[:1] for shape in shapes} | ({(length,)} if length is not None else set())
    if len(lengths) != 1 or () in lengths:
        raise ValueError(
            "scan needs one number of steps, the leading axis of each array of xs, and length if it is given: "
            f"got length={length} and xs of shapes {shapes}"
        )
    [(steps,)] = lengths
    if every < 1 or steps % every:
        raise ValueError(f"every must divide the number of steps, {steps}, got {every}")
    return march(_Unnumbered(f), init, xs, rows=steps // every, every=every, reverse=reverse)


class _Unnumbered(NamedTuple):
    """A step that does not read its number, equal to another of the same function."""

    f: Callable[[Any, Any], tuple[Any, Any]]

    def __call__(self, n: Any, carry: Any, x: Any) -> tuple[Any, Any]:
        return self.f(carry, x)
