"""Which results of a jaxpr depend on which of its arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from lieint_jax.native._primitives.control_flow import CALLS, jaxprs_of, split_scan


def varying_results(jaxpr: ClosedJaxpr | Jaxpr, varying: Sequence[bool]) -> list[bool]:
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
    """`varying_results` of a step that is repeated: its first results become its arguments from position `first` on."""
    given = list(varying)
    while True:
        after = varying_results(step, given)
        carries = [a or b for a, b in zip(given[first : first + carried], after, strict=False)]
        if carries == given[first : first + carried]:
            return [*carries, *after[carried:]]
        given[first : first + carried] = carries


def _of_equation(equation: Any, given: list[bool]) -> list[bool]:
    name, inner, out = equation.primitive.name, jaxprs_of(equation.params), equation.outvars
    if name == "scan":
        consts, carry, _ = split_scan(given, equation)
        return varying_in_loop(inner[0], given, len(consts), len(carry))
    if name == "cond":
        sides = [varying_results(x, given[1:]) for x in inner]
        return [given[0] or any(side) for side in zip(*sides, strict=True)]
    if name in CALLS and len(inner) == 1:
        return varying_results(inner[0], given)
    return [True] * len(out)
