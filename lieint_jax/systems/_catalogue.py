"""The properties that a system declares, which tests compare with the system, and the catalogue of all systems."""

from __future__ import annotations

import importlib
from typing import NamedTuple

from lieint_jax._discover import modules_with
from lieint_jax.core import Catalogue

__all__ = ["SystemProperties", "catalogue"]


class SystemProperties(NamedTuple):
    """The declared properties of a system.

    Attributes:
        name: the function in `systems` that returns it.
        models: what it models.
        phase_space: the phase space, with the coordinates (q, p) of a state.
        conserves: what the exact motion conserves, some of "energy", "energy less work", "momentum", "Casimirs" and
            "volume", with a condition in parentheses.
        momentum: the momentum map that `system.momentum` returns.
        sizes: the possible numbers of its components; empty if there may be any number.
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


def catalogue() -> Catalogue[SystemProperties]:
    """The systems as a table: what each models and conserves, its phase space, names in the literature and source.

    Returns:
        A tuple of `SystemProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    modules = modules_with("examples", importlib.import_module("lieint_jax.systems"))
    return Catalogue(module.PROPERTIES for module in modules.values())
