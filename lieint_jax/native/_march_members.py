"""`march` under `jax.vmap`: the axis becomes one of members, or one of the arrays inside of a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters import batching

from lieint_jax.native._march import AnyArray, AnyArrays, Arrays, Loop, function_of, jaxpr_of, march_p, shape_of
from lieint_jax.native._primitives.abstract_walk import shapes_of
from lieint_jax.native._primitives.control_flow import CALLS, jaxprs_of, split_scan

_SHORT = 12  # the longest axis, such as that of tangent vectors, that may go inside of a step
_COMMON = 0.3  # the least part of a carry without the axis, such as the point of the tangents, for which it does
Axis = int | None
_Batched = tuple[Arrays, list[Axis]]


def _batch(axis_data: Any, arguments: AnyArrays, axes: Sequence[Axis], *, loop: Loop) -> _Batched:
    """The results of a loop, and their axes, if some of its arguments have another axis."""
    if loop.every is None and any(axis is not None for axis in axes[loop.carried : loop.carried + 2]):
        return _batch_counts(axis_data, arguments, axes, loop)
    has = [axis is not None for axis in axes]
    varying = varying_in_loop(jaxpr_of(loop.step), [False, *has], 1, loop.carried)
    has[: loop.carried] = varying[: loop.carried]
    carries = loop.step.in_avals[1 : 1 + loop.carried]
    size = [int(np.prod(x.shape)) * jnp.issubdtype(x.dtype, jnp.floating) for x in carries]
    common = sum(n for n, v in zip(size, varying, strict=False) if not v)
    if axis_data.size <= _SHORT and common > _COMMON * sum(size):
        return _inside(axis_data, arguments, axes, has, varying, loop)
    return _as_members(axis_data.size, arguments, axes, varying, loop)


batching.fancy_primitive_batchers[march_p] = _batch


def _batch_counts(axis_data: Any, arguments: AnyArrays, axes: Sequence[Axis], loop: Loop) -> _Batched:
    """`_batch` where members have their own numbers of steps: each runs as many as the one with the most."""
    n, place = loop.carried, loop.carried + 2  # of the number of a member's steps, among the arguments of a step
    if loop.rows > 1 or len(loop.step.out_avals) > n or axes[n + 1] is not None:
        raise NotImplementedError("members with their own numbers of steps between rows of results")
    function = function_of(loop.step)

    def step(number: AnyArray, *arguments: AnyArray) -> Arrays:
        before, count = arguments[:n], arguments[place]
        after = function(number, *arguments[:place], *arguments[place + 1 :])
        return [jnp.where(number < count, x, y) for x, y in zip(after, before, strict=True)]

    number, *shapes = map(shape_of, loop.step.in_avals)
    made = jax.make_jaxpr(step)(number, *shapes[:place], shapes[n], *shapes[place:])
    longer = loop._replace(step=made, fixed=loop.fixed + 1, own=(False, *loop.own), origin=None)
    counts = arguments[n]
    given = [*arguments[:n], jnp.max(counts, initial=0), arguments[n + 1], counts, *arguments[place:]]
    return _batch(axis_data, given, [*axes[:n], None, None, axes[n], *axes[place:]], loop=longer)


def _as_members(size: int, arguments: AnyArrays, axes: Sequence[Axis], varying: list[bool], loop: Loop) -> _Batched:
    """The axis, times the one of members, if there is one, is that of members."""
    old = loop.members
    given, own = [], []
    for k, (x, axis, owns) in enumerate(zip(arguments, axes, loop.owns, strict=True)):
        place = int(loop.is_series(k))
        own.append(axis is not None or owns or k < loop.carried)
        given.append(_joined(x, axis, place, size, old, owns) if own[-1] else x)
    more = loop._replace(members=size * (old or 1), own=tuple(own[loop.carried :]))
    found = more.bind(given)
    results, out_axes = [], []
    for k, (x, varies) in enumerate(zip(found, varying, strict=True)):
        place = int(k >= loop.carried)
        x = x if old is None else x.reshape(*x.shape[:place], size, old, *x.shape[place + 1 :])
        results.append(x if varies else jnp.take(x, 0, place))
        out_axes.append(place if varies else None)
    return results, out_axes


def _joined(x: AnyArray, axis: Axis, place: int, size: int, old: int | None, owns: bool) -> AnyArray:
    """An array with one axis of members at `place`: the new axis times the old one."""
    x = _with_axis(x, axis, place, size)
    if old is None:
        return x
    x = x if owns else _with_axis(x, None, place + 1, old)
    return x.reshape(*x.shape[:place], size * old, *x.shape[place + 2 :])


def _with_axis(x: AnyArray, axis: Axis, place: int, size: int) -> AnyArray:
    """An array with its axis at `place`, or, if it has none, with a new axis of equal entries."""
    if axis is not None:
        return jnp.moveaxis(x, axis, place)
    return jnp.broadcast_to(jnp.expand_dims(x, place), (*x.shape[:place], size, *x.shape[place:]))


def _inside(
    axis_data: Any, arguments: AnyArrays, axes: Sequence[Axis], has: list[bool], varying: list[bool], loop: Loop
) -> _Batched:
    """The axis is the first one of each array inside of a step; what has none is computed once."""
    size, old = axis_data.size, int(loop.members is not None)
    given = [
        _with_axis(x, axis, loop.is_series(k) + owns, size) if h else x
        for k, (x, axis, h, owns) in enumerate(zip(arguments, axes, has, loop.owns, strict=True))
    ]
    inner_axes = [None, *(0 if h else None for h in has)]
    batched = jax.vmap(function_of(loop.step), inner_axes, 0, axis_name=axis_data.name, axis_size=size)

    def step(*arguments: AnyArray) -> Arrays:
        return [x if v else x[0] for x, v in zip(batched(*arguments), varying, strict=True)]

    number, *shapes = map(shape_of, loop.step.in_avals)
    wide = [x.update(shape=(size, *x.shape)) if h else x for x, h in zip(shapes, has, strict=True)]
    made = jax.make_jaxpr(step)(number, *wide)
    found = loop._replace(step=made, origin=None).bind(given)
    return found, [old + (k >= loop.carried) if v else None for k, v in enumerate(varying)]


def _varying_results(jaxpr: ClosedJaxpr | Jaxpr, varying: Sequence[bool]) -> list[bool]:
    """For each result, whether it depends on an argument that is marked as varying."""
    inner: Any = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    known = dict(zip(inner.invars, varying, strict=True))

    def is_varying(atom: Any) -> bool:
        return not isinstance(atom, Literal) and known.get(atom, False)

    for equation in inner.eqns:
        given = [is_varying(x) for x in equation.invars]
        found = _of_equation(equation, given) if any(given) else [False] * len(equation.outvars)
        known.update(zip(equation.outvars, found, strict=True))
    return [is_varying(x) for x in inner.outvars]


def varying_in_loop(step: ClosedJaxpr, varying: Sequence[bool], first: int, carried: int) -> list[bool]:
    """The results of a repeated step that vary; its first results become its arguments from position `first` on."""
    given = list(varying)
    while True:
        after = _varying_results(step, given)
        carries = [a or b for a, b in zip(given[first : first + carried], after, strict=False)]
        if carries == given[first : first + carried]:
            return [*carries, *after[carried:]]
        given[first : first + carried] = carries


def _of_equation(equation: Any, given: list[bool]) -> list[bool]:
    name, inner, out = equation.primitive.name, jaxprs_of(equation.params), equation.outvars
    if name == "scan":
        consts, carry, _ = split_scan(given, inner[0], shapes_of(equation.invars), shapes_of(out))
        return varying_in_loop(inner[0], given, len(consts), len(carry))
    if name == "cond":
        sides = [_varying_results(x, given[1:]) for x in inner]
        return [given[0] or any(side) for side in zip(*sides, strict=True)]
    if name in CALLS and len(inner) == 1:
        return _varying_results(inner[0], given)
    return [True] * len(out)
