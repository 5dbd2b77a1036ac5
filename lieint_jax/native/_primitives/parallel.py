"""Maps over long axes: operations that act on each row of an axis by itself become one loop over its rows.

An array has its rows along one axis, or is the same for all rows (None). A rule finds, from the axes of the operands,
those that they must have, and those of the results.

A jaxpr of many bodies is a sequence of operations on arrays with an axis of bodies, or of the elements between them. A
region is a set of its equations that `rows_along` finds parallel along axes of one length. All equations join one that
can; those that need the results of a region in another way wait. Then the equations of a region are walked for one row,
as the body of a map, and those that waited come next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from lieint_jax.native._primitives.abstract_walk import Table, long_axis, shapes_of
from lieint_jax.native._primitives.control_flow import CALLS, jaxprs_of, size_of, split_scan, split_while
from lieint_jax.native._primitives.elementwise import ELEMENTWISE, MOVES
from lieint_jax.native._primitives.reductions import REDUCTIONS

_LITTLE = 64  # operations on all rows that are not worth a map
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


def _common_axis(axes: Axes) -> int:
    """The axis of all operands that have one."""
    found = {d for d in axes if d is not None}
    _check(len(found) == 1)
    return found.pop()


def _shapes(variables: Sequence[Any]) -> list[tuple[int, ...]]:
    return [x.shape for x in shapes_of(variables)]


def _elementwise(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    """Operands and results of one shape; operands may be scalars, or have one entry along some axes."""
    d, shape = _common_axis(axes), _shapes(equation.outvars)[0]
    return [d if s and s[d] == shape[d] else None for s in _shapes(equation.invars)], [d] * len(equation.outvars)


def _with_moved_axis(place: Callable[[int, dict[str, Any], tuple[int, ...]], int | None]) -> _Rule:
    """A rule for one operand: (its axis, parameters, its shape) ↦ the axis of the results; None if not parallel.

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


def _axis_after_removal(removed: Sequence[int], d: int) -> int | None:
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
    d = _common_axis(axes)
    _check(equation.params["dimension"] != d)
    return [d] * len(axes), [d]


def _stacked(equation: JaxprEqn, axes: Axes) -> tuple[Axes, Axes]:
    d = _common_axis(axes)
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
    _common_axis([d for d in axes if d is not None])
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
    d = _common_axis(axes)
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
    inner = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    known = dict(zip(inner.invars, axes, strict=True))
    lengths = {x.aval.shape[d] for x, d in zip(inner.invars, axes, strict=True) if d is not None}

    def axis(atom: Any) -> int | None:
        return None if isinstance(atom, Literal) else known.get(atom)

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
    dict.fromkeys(ELEMENTWISE, _elementwise)
    | dict.fromkeys(CALLS, _called)
    | dict.fromkeys(REDUCTIONS, _with_moved_axis(lambda d, p, s: _axis_after_removal(p["axes"], d)))
    | dict.fromkeys(
        [x for x in REDUCTIONS if x.startswith("cum")], _with_moved_axis(lambda d, p, s: None if p["axis"] == d else d)
    )
    | {
        "broadcast_in_dim": _with_moved_axis(lambda d, p, s: p["broadcast_dimensions"][d]),
        "cholesky": _of_matrices,
        "concatenate": _joined,
        "cond": _cond,
        "dot_general": _product,
        "dynamic_slice": _with_moved_axis(lambda d, p, s: d if p["slice_sizes"][d] == s[d] else None),
        "expand_dims": _with_moved_axis(_expanded),
        "gather": _gathered,
        "lu": _of_matrices,
        "optimization_barrier": lambda equation, axes: (axes, axes),
        "pad": _with_moved_axis(lambda d, p, s: d if tuple(p["padding_config"][d]) == (0, 0, 0) else None),
        "reshape": _with_moved_axis(_reshaped),
        "rev": _with_moved_axis(lambda d, p, s: None if d in p["dimensions"] else d),
        "scan": _scan,
        "slice": _with_moved_axis(_sliced),
        "split": _with_moved_axis(lambda d, p, s: None if p["axis"] == d else d),
        "squeeze": _with_moved_axis(lambda d, p, s: _axis_after_removal(p["dimensions"], d)),
        "stack": _stacked,
        "transpose": _with_moved_axis(lambda d, p, s: list(p["permutation"]).index(d)),
        "triangular_solve": _of_matrices,
        "unstack": _with_moved_axis(lambda d, p, s: _axis_after_removal([p["axis"]], d)),
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


class Region:
    """Equations that are parallel along axes of one length.

    Attributes:
        length: the number of rows.
        equations: with the axes of their operands and of their results.
        axes: those of the results, by variable.
    """

    def __init__(self, length: int):
        self.length = length
        self.equations: list[tuple[JaxprEqn, Axes, Axes]] = []
        self.axes: dict[Any, int | None] = {}

    def join(self, equation: JaxprEqn, axes: Axes) -> bool:
        """Add an equation if it is parallel along these axes of its operands."""
        try:
            needed, out = rows_along(equation, axes)
        except NotParallelError:
            return False
        for variables, along in ((equation.invars, needed), (equation.outvars, out)):
            if any(d is not None and s[d] != self.length for s, d in zip(_shapes(variables), along, strict=True)):
                return False
        self.equations.append((equation, needed, out))
        self.axes.update(zip(equation.outvars, out, strict=True))
        return True


def walk_regions(
    jaxpr: Any,
    values: Mapping[Any, Any],
    walk_one: Callable[[JaxprEqn], None],
    walk_rows: Callable[[Region, Sequence[Any]], None],
) -> None:
    """Walk the equations of a jaxpr.

    Args:
        jaxpr: a jaxpr.
        values: those of its variables that are known.
        walk_one: walks an equation.
        walk_rows: walks a region, by a map, for the values of some of its variables.
    """
    equations = list(jaxpr.eqns)
    while equations:
        regions: dict[int, Region] = {}
        made: dict[Any, Region | None] = {}  # None: by an equation that waits
        waiting = []
        for equation in equations:
            sources = {made[x] for x in _variables(equation.invars) if x in made}
            if None in sources or len(sources) > 1 or not _join(equation, sources, regions, made, values):
                if sources:
                    waiting.append(equation)
                    made.update(dict.fromkeys(equation.outvars))
                else:
                    walk_one(equation)
        needed = {x for atoms in (*(e.invars for e in waiting), jaxpr.outvars) for x in _variables(atoms)}
        for region in regions.values():
            if sum(size_of(equation) for equation, *_ in region.equations) > _LITTLE:
                walk_rows(region, [x for x in region.axes if x in needed])
            else:
                for equation, *_ in region.equations:
                    walk_one(equation)
        equations = waiting


def _join(
    equation: JaxprEqn,
    sources: set[Region | None],
    regions: dict[int, Region],
    made: dict[Any, Region | None],
    values: Mapping[Any, Any],
) -> bool:
    """Whether an equation is parallel with its source, or, if it has none, with all rows of a long axis."""
    region = next(iter(sources), None)
    if region is not None:
        _, others = _first_axes(equation, values, region.length)
        pairs = zip(equation.invars, others, strict=True)
        axes = [d if isinstance(x, Literal) else region.axes.get(x, d) for x, d in pairs]
    else:
        length, axes = _first_axes(equation, values)
        if equation.primitive.name in MOVES or not length:
            return False
        region = regions.get(length) or Region(length)
    if not region.join(equation, axes):
        return False
    regions[region.length] = region
    made.update(dict.fromkeys(equation.outvars, region))
    return True


def _first_axes(equation: JaxprEqn, values: Mapping[Any, Any], length: int = 0) -> tuple[int, Axes]:
    """The long axis of each operand, all of one length, which may be given; and this length, 0 if there is none."""
    axes = []
    for x in equation.invars:
        shape = x.aval.shape if isinstance(x.aval, ShapedArray) else ()
        given = not isinstance(x, Literal) and not isinstance(values.get(x), Table)
        d = long_axis(shape, length) if given else None
        length = length if d is None else shape[d]
        axes.append(d)
    return length, axes


def _variables(atoms: Sequence[Any]) -> list[Any]:
    return [x for x in atoms if not isinstance(x, Literal)]
