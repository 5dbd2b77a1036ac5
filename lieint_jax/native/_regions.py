"""Maps over long axes: equations that act on each row of an axis by itself become one loop over its rows.

A jaxpr of many bodies is a sequence of operations on arrays with an axis of bodies, or of the elements between them. A
region is a set of its equations that `rows_along` finds parallel along axes of one length. All equations join one that
can; those that need the results of a region in another way wait. Then the equations of a region are walked for one row,
as the body of a map, and those that waited come next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jax.extend.core import JaxprEqn, Literal

from lieint_jax.native._primitives.abstract_walk import Table, shapes_of
from lieint_jax.native._primitives.control_flow import size_of
from lieint_jax.native._primitives.elementwise import MOVES
from lieint_jax.native._primitives.parallel import Axes, NotParallelError, rows_along

LONG = 8  # the shortest axis of a map
_LITTLE = 64  # operations on all rows that are not worth a map


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
            if any(
                d is not None and x.shape[d] != self.length for x, d in zip(shapes_of(variables), along, strict=True)
            ):
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
        shape = getattr(x.aval, "shape", ())
        given = not isinstance(x, Literal) and not isinstance(values.get(x), Table)
        d = long_axis(shape, length) if given else None
        length = length if d is None else shape[d]
        axes.append(d)
    return length, axes


def long_axis(shape: Sequence[int], length: int = 0) -> int | None:
    """The first or second axis if it is long, and of this length."""
    return next((k for k, n in enumerate(shape[:2]) if n >= LONG and length in (0, n)), None)


def _variables(atoms: Sequence[Any]) -> list[Any]:
    return [x for x in atoms if not isinstance(x, Literal)]
