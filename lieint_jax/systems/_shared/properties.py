"""What a system declares of itself: `systems.catalogue` lists it, and the tests compare it with the system."""

from __future__ import annotations

from typing import NamedTuple


class SystemProperties(NamedTuple):
    """The declared properties of a system.

    Attributes:
        name: of the function in `systems` that makes it.
        models: what it models.
        phase_space: the phase space, with the coordinates (q, p) of a state.
        conserves: what the exact motion conserves, some of "energy", "energy less work", "momentum", "Casimirs" and
            "volume"; a condition stands in parentheses.
        momentum: the momentum map that `system.momentum` returns.
        sizes: the numbers of components that it may have; empty if any, as of a group of any dimension.
        aliases: its names in the literature.
        source: a paper or a book, or equations of Lewis & Simo 1994.
    """

    name: str
    models: str
    phase_space: str
    conserves: tuple[str, ...]
    momentum: str
    sizes: tuple[int, ...]
    aliases: tuple[str, ...]
    source: str

    columns = ("system", "models", "phase space", "conserves", "momentum")

    def cells(self) -> tuple[str, ...]:
        return self.name, self.models, self.phase_space, ", ".join(self.conserves), self.momentum
