"""Which operations act on each row of an axis by itself, so that one map over the rows computes them.

An array has its rows along one axis, or is the same for all rows (None). A rule finds, from the axes of the operands,
those that they must have, and those of the results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from lieint_jax.native._primitives.abstract_walk import shapes_of
from lieint_jax.native._primitives.control_flow import CALLS, jaxprs_of, split_scan, split_while
from lieint_jax.native._primitives.elementwise import ELEMENTWISE, MOVES
from lieint_jax.native._primitives.reductions import REDUCTIONS

Axes = list[int | None]
_Rule = Callable[[JaxprEqn, Axes], tuple[Axes, Axes]]


class NotParallelError(Exception):
    """The rows of a result depend on several rows of the operands."""


def rows_along(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """The axes of the operands and of the results of an equation, from those of its operands, some of which are known.

    Raises:
        NotParallelError: its rows depend on one another, or there is no rule.
    """
    name = equation.primitive.name
    if name not in _RULES:
        raise NotParallelError(name)
    return _RULES[name](equation, axes)


def _check(fine: bool) -> None:
    if not fine:
        raise NotParallelError


def _one(axes: Axes) -> int:
    """The axis of all operands that have one."""
    found = {d for d in axes if d is not None}
    _check(len(found) == 1)
    return found.pop()


def _shapes(variables: Sequence[Any]) -> list[tuple[int, ...]]:
    return [x.shape for x in shapes_of(variables)]


def _alike(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """Operands and results of one shape; operands may be scalars, or have one entry along some axes."""
    d, shape = _one(axes), _shapes(equation.outvars)[0]
    return [d if s and s[d] == shape[d] else None for s in _shapes(equation.invars)], [d] * len(equation.outvars)


def _moved(place: Callable[[int, dict[str, Any], tuple[int, ...]], int | None]) -> _Rule:
    """Of one operand: the axis of the results from (that of the operand, parameters, its shape); None if not parallel.

    Other operands are the same for all rows.
    """

    def rule(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
        _check(axes[0] is not None and all(d is None for d in axes[1:]))
        to = place(axes[0], equation.params, _shapes(equation.invars)[0])  # pyright: ignore[reportArgumentType]
        _check(to is not None)
        return axes, [None if to is None else int(to) for _ in equation.outvars]

    return rule


def _reshaped(d: int, parameters: dict[str, Any], shape: tuple[int, ...]) -> int | None:
    sizes = list(parameters["new_sizes"])
    if parameters.get("dimensions") is not None:
        return None
    before = int(np.prod(shape[:d]))
    return next((k for k, n in enumerate(sizes) if n == shape[d] and np.prod(sizes[:k]) == before), None)


def _without(removed: Sequence[int], d: int) -> int | None:
    return None if d in removed else d - sum(n < d for n in removed)


def _expanded(d: int, parameters: dict[str, Any], shape: tuple[int, ...]) -> int:
    added = parameters["dimensions"]
    return [n for n in range(len(shape) + len(added)) if n not in added][d]


def _sliced(d: int, parameters: dict[str, Any], shape: tuple[int, ...]) -> int | None:
    begin, end = parameters["start_indices"][d], parameters["limit_indices"][d]
    whole = (begin, end) == (0, shape[d]) and (parameters["strides"] is None or parameters["strides"][d] == 1)
    return d if whole else None


def _joined(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """Operands that are put next to one another, along another axis."""
    d = _one(axes)
    _check(equation.params["dimension"] != d)
    return [d] * len(axes), [d]


def _stacked(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    d = _one(axes)
    return [d] * len(axes), [d + (equation.params["axis"] <= d)]


def _product(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    (a_sum, b_sum), (a_each, b_each) = equation.params["dimension_numbers"]
    for k, each in enumerate((a_each, b_each)):
        if axes[k] in each:
            n = list(each).index(axes[k])
            needed: Axes = [a_each[n], b_each[n]]
            _check(all(x in (None, y) for x, y in zip(axes, needed, strict=True)))
            found: Axes = [n]
            return needed, found
    _one([d for d in axes if d is not None])
    _check(None in axes)
    k = int(axes[0] is None)
    own = [
        [n for n in range(len(s)) if n not in (*each, *summed)]
        for s, each, summed in zip(_shapes(equation.invars), (a_each, b_each), (a_sum, b_sum), strict=True)
    ]
    _check(axes[k] in own[k])
    return axes, [len(a_each) + k * len(own[0]) + own[k].index(axes[k])]  # pyright: ignore[reportArgumentType]


def _of_matrices(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """Linear algebra of the two last axes."""
    d = _one(axes)
    _check(all(d < len(s) - 2 for s in _shapes(equation.invars)))
    return [d] * len(axes), [d] * len(equation.outvars)


def _gathered(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """Windows that contain all rows, or the same window of all rows at indices of each."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    shape, indices = _shapes(equation.invars)
    batches = [n for n in range(len(_shapes(equation.outvars)[0])) if n not in numbers.offset_dims]
    batching, of_indices = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    x, k = axes
    if x is not None and x not in batching:
        kept = [n for n in range(len(shape)) if n not in (*numbers.collapsed_slice_dims, *batching)]
        _check(k is None and x in kept and sizes[x] == shape[x] and x not in numbers.start_index_map)
        return axes, [numbers.offset_dims[kept.index(x)]]
    if x is not None:
        n = list(batching).index(x)
        _check(k in (None, of_indices[n]))
        return [x, of_indices[n]], [batches[of_indices[n]]]
    _check(k is not None and k < len(indices) - 1 and k not in of_indices)
    return axes, [batches[k]]  # pyright: ignore[reportArgumentType, reportCallIssue]


def _called(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    inner = jaxprs_of(equation.params)
    _check(len(inner) == 1)
    return axes, _results(inner[0], axes)


def _results(jaxpr: Any, axes: Axes, strict: bool = True) -> Axes:
    """The axes of the results of a jaxpr, in which, if it is `strict`, nothing is computed of all rows at once."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    known = dict(zip(inner.invars, axes, strict=True))
    lengths = {x.aval.shape[d] for x, d in zip(inner.invars, axes, strict=True) if d is not None}

    def axis(atom: Any) -> int | None:
        return None if hasattr(atom, "val") else known.get(atom)

    for equation in inner.eqns:
        given = [axis(x) for x in equation.invars]
        if any(d is not None for d in given):
            known.update(zip(equation.outvars, rows_along(equation, given)[1], strict=True))
        elif strict:
            _check(equation.primitive.name in MOVES or not any(lengths & {*s} for s in _shapes(equation.outvars)))
    return [axis(x) for x in inner.outvars]


def _merged(first: Axes, second: Axes) -> Axes:
    _check(all(None in (a, b) or a == b for a, b in zip(first, second, strict=True)))
    return [b if a is None else a for a, b in zip(first, second, strict=True)]


def _while(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """All that it carries has rows, if its test has."""
    cond, body = equation.params["cond_jaxpr"], equation.params["body_jaxpr"]
    of_test, of_body, carry = split_while(axes, cond, body, equation.outvars)
    shapes, strict = _shapes(equation.outvars), False
    while True:
        after = _merged(carry, _results(body, [*of_body, *carry], strict))
        [d] = _results(cond, [*of_test, *after], strict)
        if d is not None:
            _check(all(len(s) > d for s in shapes))
            after = _merged(after, [d] * len(after))
        if after == carry and strict:
            return [*of_test, *of_body, *carry], carry
        carry, strict = after, after == carry


def _scan(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    step = equation.params["jaxpr"]
    consts, carry, series = split_scan(axes, step, shapes_of(equation.invars), shapes_of(equation.outvars))
    _check(0 not in series)
    rows, strict = [None if d is None else d - 1 for d in series], False
    while True:
        found = _results(step, [*consts, *carry, *rows], strict)
        after = _merged(carry, found[: len(carry)])
        if after == carry and strict:
            return [*consts, *carry, *series], [*carry, *(None if d is None else d + 1 for d in found[len(carry) :])]
        carry, strict = after, after == carry


def _cond(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    _check(axes[0] is None)
    found: Axes = [None] * len(equation.outvars)
    for side in equation.params["branches"]:
        found = _merged(found, _results(side, axes[1:]))
    return axes, found


_RULES: dict[str, _Rule] = (
    dict.fromkeys(ELEMENTWISE, _alike)
    | dict.fromkeys(CALLS, _called)
    | dict.fromkeys(REDUCTIONS, _moved(lambda d, p, s: _without(p["axes"], d)))
    | dict.fromkeys(
        [x for x in REDUCTIONS if x.startswith("cum")], _moved(lambda d, p, s: None if p["axis"] == d else d)
    )
    | {
        "broadcast_in_dim": _moved(lambda d, p, s: p["broadcast_dimensions"][d]),
        "cholesky": _of_matrices,
        "concatenate": _joined,
        "cond": _cond,
        "dot_general": _product,
        "dynamic_slice": _moved(lambda d, p, s: d if p["slice_sizes"][d] == s[d] else None),
        "expand_dims": _moved(_expanded),
        "gather": _gathered,
        "lu": _of_matrices,
        "optimization_barrier": lambda equation, axes: (axes, axes),
        "pad": _moved(lambda d, p, s: d if tuple(p["padding_config"][d]) == (0, 0, 0) else None),
        "reshape": _moved(_reshaped),
        "rev": _moved(lambda d, p, s: None if d in p["dimensions"] else d),
        "scan": _scan,
        "slice": _moved(_sliced),
        "split": _moved(lambda d, p, s: None if p["axis"] == d else d),
        "squeeze": _moved(lambda d, p, s: _without(p["dimensions"], d)),
        "stack": _stacked,
        "transpose": _moved(lambda d, p, s: list(p["permutation"]).index(d)),
        "triangular_solve": _of_matrices,
        "unstack": _moved(lambda d, p, s: _without([p["axis"]], d)),
        "while": _while,
    }
)


def of_one_row(name: str, parameters: dict[str, Any], axes: Axes, out: Axes) -> dict[str, Any]:
    """The parameters of a primitive for arrays of one row, along these axes of its operands and results."""
    place = {
        "broadcast_in_dim": ("shape", out),
        "dynamic_slice": ("slice_sizes", axes),
        "gather": ("slice_sizes", axes),
        "reshape": ("new_sizes", out),
        "slice": ("limit_indices", axes),
    }.get(name)
    if place is None or place[1][0] is None:
        return parameters
    sizes = list(parameters[place[0]])
    sizes[place[1][0]] = 1
    return {**parameters, place[0]: tuple(sizes)}
