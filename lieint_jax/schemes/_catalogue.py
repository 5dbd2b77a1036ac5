"""The properties that a scheme declares, which tests compare with measurements, and the catalogue of all schemes."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from lieint_jax._checks import concrete
from lieint_jax._discover import modules_with
from lieint_jax.core import Catalogue, Step, System
from lieint_jax.systems._equations import Equations

__all__ = ["Catalogue", "SchemeProperties", "catalogue"]

_FEW = 3  # schemes that a message names
_System = TypeVar("_System")


class SchemeProperties(NamedTuple):
    """The declared properties of a scheme.

    Attributes:
        name: what makes the step, a class or a function in `schemes`.
        systems: the systems that it integrates.
        conserves: what is conserved to round-off, some of "energy", "energy less work", "momentum", "form" and
            "volume", with a condition in parentheses.
        limit: the largest step.
        aliases: its names in the literature.
        source: a paper, or equations of Lewis & Simo 1994.
        accepts: the equations of motion that it integrates; a system inherits some of them.
        order: the order of accuracy of the default, infinite for the exact flow.
        symmetric: whether by default a step of −Δt is the inverse of one of Δt.
        instead: the end of the message for a system that no scheme accepts.
    """

    name: str
    systems: str
    conserves: tuple[str, ...]
    limit: str
    aliases: tuple[str, ...]
    source: str
    accepts: tuple[type[Equations], ...] = ()
    order: float = 2
    symmetric: bool = True
    instead: str = ""

    columns = ("scheme", "for", "conserves", "order")

    def cells(self) -> tuple[str, ...]:
        return self.name, self.systems, ", ".join(self.conserves) or "nothing", f"{self.order:g}"

    def by_name(self, steps: Callable[[Any], Sequence[Step]]) -> Callable[[System], dict[str, Step]]:
        """`examples` of a scheme: the steps that a function lists for accepted systems, {} for others (a decorator)."""

        @functools.wraps(steps)
        def examples(system: System) -> dict[str, Step]:
            return {step.name: step for step in steps(system)} if isinstance(system, self.accepts) else {}

        return examples

    def check(self, system: _System) -> _System:
        """`system`; ValueError unless it inherits some of the accepted equations of motion, and overrides none."""
        own = next((equations for equations in self.accepts if isinstance(system, equations)), None)
        if own is None:
            nouns = ", ".join(equations.noun for equations in self.accepts)
            raise ValueError(
                f"{self.name} integrates {nouns}, got {type(system).__name__}{hint(system) or self.instead}"
            )
        if changed := own.overridden(system):  # pyright: ignore[reportArgumentType]
            raise ValueError(
                f"{self.name} integrates {own.noun}, and {type(system).__name__}.{changed} overrides their equations "
                "of motion: remove it, or use extrapolate, which integrates every vector_field"
            )
        return system

    def check_drift(self, free: System, drift: Step) -> None:
        """Raise ValueError if a drift is not a symmetric step of the system `free`."""
        if not isinstance(drift, Step) or not drift.symmetric or drift.own_time:
            given = drift.name if isinstance(drift, Step) else drift
            raise ValueError(f"drift must be a symmetric step of system.free, got {given!r}")
        if not _equal(free, drift.system):
            raise ValueError(
                f"{self.name} with {drift.name}: the drift must be a step of system.free, a {type(free).__name__}, "
                f"and is one of another {type(drift.system).__name__}"
            )


def hint(system: object) -> str:
    """The end of a message that a scheme does not accept a system: the schemes that do, if they are few."""
    fitting = [scheme.name for scheme in catalogue() if isinstance(system, scheme.accepts)]
    return f"; use {' or '.join(fitting)}" if 0 < len(fitting) <= _FEW else ""


def _equal(a: System, b: System) -> bool:
    """Whether two systems are the same, up to rounding; tracers are not compared."""
    if jax.tree.structure(a) != jax.tree.structure(b):
        return False
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(not concrete(x, y) or (np.shape(x) == np.shape(y) and np.allclose(x, y, 1e-6, 0)) for x, y in pairs)


def catalogue() -> Catalogue[SchemeProperties]:
    """The schemes as a table: what each integrates and conserves, its order, limit, names in the literature and source.

    Returns:
        A tuple of `SchemeProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    modules = modules_with("examples", importlib.import_module("lieint_jax.schemes"))
    return Catalogue(module.PROPERTIES for module in modules.values())
