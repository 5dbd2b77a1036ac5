"""The command `list`: scenarios and studies with their measured time and memory, or a catalogue of the library."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from lieint_jax import schemes, systems
from lieint_jax.app import scenarios
from lieint_jax.app.command import study
from lieint_jax.app.printer import show

CATALOGUES = {"schemes": schemes.catalogue, "systems": systems.catalogue}
_LONG = 10.0  # seconds: commands that need longer print their expected time before they start


class Cost(NamedTuple):
    """The cost of a command at its default size, as measured by `benchmarks/commands.py` on two cores."""

    first: float  # seconds of the first run, most of them for compilation
    again: float  # seconds of later runs, whose programs are cached
    memory: float  # gigabytes of memory
    disk: float  # megabytes of results and pictures


@cache
def costs() -> dict[str, Cost]:
    """The measured cost of each command, such as "run toutatis"."""
    text = resources.files(__package__ or "").joinpath("costs.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines()[1:]]
    return {name: Cost(*map(float, numbers)) for name, *numbers in rows}


def announce(name: str) -> None:
    """Print the expected time of a command of default size, if it is long and has been measured."""
    cost = costs().get(name)
    if cost and cost.first > _LONG:
        first, again = _duration(cost.first), _duration(cost.again)
        show(f"expected time on two cores: {first}, and {again} from the second run on")


def text(name: str | None = None) -> str:
    """The scenarios and studies, a catalogue of `CATALOGUES`, or the file of a shipped scenario, as text."""
    if name in CATALOGUES:
        return repr(CATALOGUES[name]())
    if name is not None:
        return scenarios.shipped_file(name).rstrip()
    lines = ["scenarios: lieint run NAME, or your own file; lieint list NAME prints its file, to copy and change"]
    for name in scenarios.scenario_names():
        about, size = describe(scenarios.load(name))
        lines += _entry(name, about, f"{size}; {describe_cost(f'run {name}')}")
    lines.append("\nstudies: lieint study NAME")
    for name, module in study.studies_by_name().items():
        lines += _entry(name, (module.__doc__ or "").splitlines()[0], describe_cost(f"study {name}"))
    return "\n".join([*lines, "\nscenarios: members × steps; time on two cores of the first and later runs; memory"])


def describe(scenario: Any) -> tuple[str, str]:
    """The subject of a scenario, and its size, as text."""
    return f"{scenario.title}: {scenario.about}", f"{scenario.members} × {scenario.steps}"


def describe_cost(name: str) -> str:
    """The time and the memory that a command of default size needs, as text."""
    cost = costs().get(name)
    return f"{_duration(cost.first)}, {_duration(cost.again)}; {cost.memory:.1f} GB" if cost else "not measured"


def _entry(name: str, about: str, size: str) -> list[str]:
    return [f"  {name:<20}{about}", f"  {'':<20}{size}"]


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"
