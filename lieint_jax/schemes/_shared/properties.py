"""The properties that a scheme declares: `schemes.catalogue` lists them, and tests compare them with measurements."""

from __future__ import annotations

from typing import NamedTuple


class SchemeProperties(NamedTuple):
    """The declared properties of a scheme.

    Attributes:
        name: the function in `schemes` that returns the step.
        systems: the systems that it integrates.
        conserves: what is conserved to round-off, some of "energy", "energy less work", "momentum", "form" and
            "volume", with a condition in parentheses.
        order: the order of accuracy of the default, infinite for the exact flow.
        symmetric: whether by default a step of −Δt is the inverse of one of Δt.
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

    columns = ("scheme", "for", "conserves", "order")

    def cells(self) -> tuple[str, ...]:
        return self.name, self.systems, ", ".join(self.conserves) or "nothing", f"{self.order:g}"
