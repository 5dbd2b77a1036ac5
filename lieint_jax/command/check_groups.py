"""Measured conservation by the midpoint scheme on each matrix group: `lieint check GROUP`, `lieint check groups`.

`lieint check groups` prints `diagnostics.group_conservation` of every group: the largest relative energy error over the
maps, and the largest symplectic defect of each map. The page "What is conserved, measured" has the table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from lieint_jax import _discover, groups, maps
from lieint_jax.diagnostics import certify, group_conservation, random_geodesic
from lieint_jax.groups import MatrixGroup
from lieint_jax.schemes import group_midpoint

_MAPS = ("exponential", "cayley", "arcsine")


def catalogue() -> dict[str, MatrixGroup]:
    """The groups of the catalogue and the examples of `groups.matrix`, by name."""
    return groups.catalogue.examples() | _discover.modules_with("examples", groups)["matrix"].examples()


def find_group(name: str) -> MatrixGroup | None:
    """The catalogue's group of this name in any spelling ("SE(3)", "se3", "Heis 5"); None if there is none."""
    found = {_normalize_name(key): group for key, group in catalogue().items()}
    return found.get(_normalize_name(name))


def _normalize_name(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def table(metrics: int = 4) -> Iterator[str]:
    """The lines of the table of all groups."""
    yield "| group | energy | form, exponential | cayley | arcsine |"
    yield "|---|---|---|---|---|"
    for name, group in catalogue().items():
        found = {key: group_conservation(group, tau, metrics) for key, tau in maps.defined_on(group).items()}
        flag = "" if all(result.converged for result in found.values()) else " NOT ALL CONVERGED"
        worst = max(result.energy for result in found.values())
        forms = [f"{found[key].form:.1e}" if key in found else "—" for key in _MAPS]
        yield f"| {name} | {worst:.1e}{flag} | {' | '.join(forms)} |"


def certificates(group: MatrixGroup, scheme: str = "", num_steps: int | None = None) -> str:
    """The certificates of a random metric on a group, one for each map, as text.

    Raises:
        ValueError: no map matches `scheme`; the message lists the maps of this group.
    """
    system, state = random_geodesic(group)
    steps = num_steps or (1000 if group.has_bounded_adjoint else 100)
    defined = maps.defined_on(group)
    wanted = [tau for name, tau in defined.items() if scheme in f"group_midpoint[{name}]"]
    if not wanted:
        names = ", ".join(defined)
        raise ValueError(f"no scheme {scheme!r} on {group.name}, where group_midpoint has the maps {names}")
    lines = [_describe(group, system)]
    lines += [str(certify(group_midpoint(system, tau), state, 0.05, steps)) for tau in wanted]
    return "\n\n".join(lines)


def _describe(group: MatrixGroup, system: Any) -> str:
    degrees = [str(monomials.shape[1]) for monomials, rows in group._casimirs for _ in rows]
    known = f"{len(degrees)} of {group.corank}" + f" (of degree {', '.join(degrees)})" * bool(degrees)
    symplectic = "arcsine" in maps.defined_on(group) and maps.is_symplectic(maps.arcsine, group, system.metric)
    form, growth = "yes" if symplectic else "no", "Ad_q stays bounded"
    if not group.has_bounded_adjoint:
        growth = "Ad_q may grow, and digits of Π are lost like ε‖Ad_q‖²"
    return f"{group}: {growth}; Casimirs known: {known}; a symplectic map known: {form}\nA random metric, |Ω| = 1"
