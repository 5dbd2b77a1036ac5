"""A loop over a function of small arrays, evaluated component by component.

The transpose of v[i] is a `pad`, and the pull-back of a step is full of them; XLA does not fuse pads, and works on all
components even where only one is not zero. Here every small array of a jaxpr is a numpy array of scalars, so indexing,
stacking and padding cost nothing, and zeros are dropped. Over a batch, the pull-back of a free body's step is 3 times
faster. Primitives that are not listed here are applied to whole arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

_LONGEST = 10_000  # the most scalar operations of a function that is evaluated by components
_MOST = 64  # the most entries of an array that is split into scalars
_NAMES = """
add sub mul div neg sign abs max min sqrt rsqrt cbrt square exp exp2 log log1p expm1 pow integer_pow sin cos tan asin
acos atan atan2 sinh cosh tanh asinh acosh atanh logistic floor ceil round is_finite and or xor not eq ne lt le gt ge
add_any convert_element_type select_n stop_gradient clamp copy nextafter rem name
"""
_ELEMENTWISE = frozenset(_NAMES.split())


def repeat(count: Any, function: Callable[[Any, Any], Any], carry: Any, over: tuple[float, ...]) -> Any:
    """Apply carry ← function(carry, x) for each x in `over`, and all that `count` times, by loops that carry scalars.

    Not to be differentiated. A function of more than ten thousand scalar operations, which would compile slowly, is
    applied to whole arrays.
    """
    leaves, structure = jax.tree.flatten(carry)
    ends = np.cumsum([leaf.size for leaf in leaves])
    dtype = jnp.result_type(*leaves)

    def joined(scalars: list[Array]) -> Any:
        arrays = [
            jnp.stack(scalars[end - leaf.size : end]).reshape(leaf.shape) if leaf.size else leaf
            for end, leaf in zip(ends, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, arrays)

    def flat(scalars: list[Array], x: Any) -> list[Array]:
        after = jax.tree.leaves(function(joined(scalars), x))
        return [leaf.ravel()[k] for leaf in after for k in range(leaf.size)]

    scalars = [leaf.ravel()[k] for leaf in leaves for k in range(leaf.size)]
    closed = jax.make_jaxpr(flat)(scalars, jnp.ones((), dtype))
    if _length(closed.jaxpr) > _LONGEST:
        return _looped(count, function, carry, over, dtype)
    consts = [_apart(c) for c in closed.consts]

    def by_scalars(scalars: list[Array], x: Any) -> list[Array]:
        return [_whole(y) for y in _evaluate(closed.jaxpr, consts, [*map(_apart, scalars), _apart(x)])]

    return joined(_looped(count, by_scalars, scalars, over, dtype))


def _looped(count: Any, function: Callable[[Any, Any], Any], carry: Any, over: tuple[float, ...], dtype: Any) -> Any:
    if len(over) == 1:
        return lax.fori_loop(0, count, lambda _, c: function(c, np.asarray(over[0], dtype)), carry)

    # x is carried, since XLA would fuse a slice of `over` into every loop over a batch
    def one(carry: tuple[Any, Array], following: Array) -> tuple[tuple[Any, Array], None]:
        return (function(*carry), following), None

    xs = jnp.asarray(over, dtype)
    return lax.fori_loop(0, count, lambda _, c: lax.scan(one, (c, xs[0]), jnp.roll(xs, -1))[0][0], carry)


def _length(jaxpr: Jaxpr) -> int:
    """About the number of scalar operations of a jaxpr."""
    return sum(_operations(eqn) for eqn in jaxpr.eqns)


def _operations(eqn: Any) -> int:
    within = [getattr(sub, "jaxpr", sub) for sub in jax.tree.leaves(eqn.params, is_leaf=_is_jaxpr) if _is_jaxpr(sub)]
    if within:
        return sum(_length(sub) for sub in within)
    return sum(math.prod(v.aval.shape) for v in eqn.outvars) if eqn.primitive.name in _ELEMENTWISE else 0


def _is_jaxpr(x: Any) -> bool:
    return isinstance(x, ClosedJaxpr | Jaxpr)


def _apart(x: Any) -> Any:
    """An array as a numpy array of its entries, if it has at most `_MOST`; else the array itself."""
    if np.size(x) > _MOST or jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key):
        return x
    entries = np.empty(np.shape(x), object)
    for index in np.ndindex(entries.shape):
        entries[index] = np.asarray(x)[index] if isinstance(x, np.ndarray | np.generic | float | int) else x[index]
    return entries


def _whole(x: Any) -> Any:
    if not (isinstance(x, np.ndarray) and x.dtype == object):
        return x
    if x.ndim == 0:
        return jnp.asarray(x.item())
    return jnp.stack([jnp.asarray(entry) for entry in x.ravel()]).reshape(x.shape)


def _closed(closed: ClosedJaxpr, arguments: list[Any]) -> list[Any]:
    return _evaluate(closed.jaxpr, [_apart(c) for c in closed.consts], arguments)


def _evaluate(jaxpr: Jaxpr, consts: list[Any], arguments: list[Any]) -> list[Any]:
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, Literal):
            return _apart(np.asarray(atom.val, atom.aval.dtype))  # pyright: ignore[reportAttributeAccessIssue]
        return values[atom]

    for eqn in jaxpr.eqns:
        values.update(zip(eqn.outvars, _equation(eqn, [read(x) for x in eqn.invars]), strict=True))
    return [read(x) for x in jaxpr.outvars]


def _equation(eqn: Any, inputs: list[Any]) -> list[Any]:
    name, params = eqn.primitive.name, eqn.params
    if name in ("pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "core_call", "remat", "checkpoint"):
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        return _closed(inner, inputs) if hasattr(inner, "consts") else _evaluate(inner, [], inputs)
    if name == "custom_linear_solve":
        first, count = sum(params["const_lengths"][:2]), params["const_lengths"].solve
        rest = inputs[sum(params["const_lengths"]) :]
        return _closed(params["jaxprs"].solve, [*inputs[first : first + count], *rest])
    known = all(isinstance(x, np.ndarray) and x.dtype == object for x in inputs)
    small = all(int(np.prod(v.aval.shape)) <= _MOST for v in eqn.outvars)
    if known and small and len(eqn.outvars) == 1:
        if name in _ELEMENTWISE:
            return [_elementwise(eqn, inputs)]
        if name in _STRUCTURAL:
            return [_STRUCTURAL[name](*inputs, **params)]
    if known and name == "split":
        return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], params["axis"])
    found = eqn.primitive.bind(*[_whole(x) for x in inputs], **params)
    return [_apart(x) for x in (found if eqn.primitive.multiple_results else [found])]


def _is(x: Any, number: float) -> bool:
    return isinstance(x, np.ndarray | np.generic) and bool(x == number)


def _elementwise(eqn: Any, inputs: list[Any]) -> Any:
    name = eqn.primitive.name
    dtype = eqn.outvars[0].aval.dtype
    shape = np.broadcast_shapes(*(x.shape for x in inputs))
    out = np.empty(shape, object)
    spread = [np.broadcast_to(x, shape) for x in inputs]
    for index in np.ndindex(shape):
        x = [s[index] for s in spread]
        if name in ("add", "add_any") and (_is(x[0], 0) or _is(x[1], 0)):
            out[index] = x[1] if _is(x[0], 0) else x[0]
        elif name == "sub" and _is(x[1], 0):
            out[index] = x[0]
        elif name == "mul" and (_is(x[0], 0) or _is(x[1], 0)):
            out[index] = np.zeros((), dtype)
        elif name == "mul" and (_is(x[0], 1) or _is(x[1], 1)):
            out[index] = x[1] if _is(x[0], 1) else x[0]
        elif name == "neg" and _is(x[0], 0):
            out[index] = x[0]
        else:
            out[index] = eqn.primitive.bind(*[jnp.asarray(v) for v in x], **eqn.params)
    return out


def _pad(x: Any, value: Any, padding_config: Any) -> Any:
    shape = tuple(lo + hi + max(n + (n - 1) * gap, 0) for n, (lo, hi, gap) in zip(x.shape, padding_config, strict=True))
    out = np.empty(shape, object)
    out[...] = value.item()
    for index in np.ndindex(x.shape):
        at = tuple(lo + k * (gap + 1) for k, (lo, _, gap) in zip(index, padding_config, strict=True))
        if all(0 <= k < n for k, n in zip(at, shape, strict=True)):
            out[at] = x[index]
    return out


def _broadcast(x: Any, shape: Any, broadcast_dimensions: Any, **_: Any) -> Any:
    kept = [1] * len(shape)
    for axis, n in zip(broadcast_dimensions, x.shape, strict=True):
        kept[axis] = n
    return np.broadcast_to(x.reshape(kept), shape)


def _slice(x: Any, start_indices: Any, limit_indices: Any, strides: Any) -> Any:
    strides = strides or (1,) * x.ndim
    return x[tuple(slice(*s) for s in zip(start_indices, limit_indices, strides, strict=True))]


def _sum(x: Any, axes: Any, **_: Any) -> Any:
    moved = np.moveaxis(x, axes, range(len(axes)))
    kept = moved.shape[len(axes) :]
    out = np.empty(kept, object)
    for index in np.ndindex(kept):
        terms = [t for t in moved[(Ellipsis, *index)].ravel() if not _is(t, 0)]
        out[index] = sum(terms[1:], terms[0]) if terms else moved[(Ellipsis, *index)].ravel()[0]
    return out


_STRUCTURAL: dict[str, Callable[..., Any]] = {
    "pad": _pad,
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reduce_sum": _sum,
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, dimensions),
    "rev": lambda x, dimensions: np.flip(x, dimensions),
}
