"""What a scheme declares of itself: `schemes.catalogue` lists it, and the tests compare it with measurements."""

from __future__ import annotations

from typing import NamedTuple


class SchemeProperties(NamedTuple):
    """The declared properties of a scheme.

    Attributes:
        name: of the function in `schemes` that makes the step.
        systems: what it integrates.
        conserves: what is conserved to round-off, some of "energy", "energy less work", "momentum", "form" and
            "volume"; a condition stands in parentheses.
        order: the order of accuracy of the default, infinite for the exact flow.
        symmetric: whether a step of −Δt undoes one of Δt, by default.
        limit: the largest step.
        aliases: its names in the literature.
        source: a paper, or equations of Lewis & Simo 1994.
    """

    name: str
    systems: str
    conserves: tuple[str, ...]
    order: float
    symmetric: bool
    limit: str
    aliases: tuple[str, ...]
    source: str


class Catalogue(tuple[SchemeProperties, ...]):
    """The declared properties of all schemes, which print as a table."""

    __slots__ = ()

    def __repr__(self) -> str:
        rows = [("scheme", "for", "conserves", "order"), *map(_row, self)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ("  ".join(x.ljust(n) for x, n in zip(row, widths, strict=True)).rstrip() for row in rows)
        return "\n".join(lines)


def _row(entry: SchemeProperties) -> tuple[str, str, str, str]:
    return entry.name, entry.systems, ", ".join(entry.conserves) or "nothing", f"{entry.order:g}"
