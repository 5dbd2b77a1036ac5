"""The command `list`: the shipped scenarios and studies, each in a line, and how long every command takes."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from lieint_jax.app import scenarios
from lieint_jax.app.command import study

_LONG = 10.0  # seconds from which a command says beforehand how long it will take


class Cost(NamedTuple):
    """What a command took at its default size, as `benchmarks/commands.py` measured it on two cores.

    Attributes:
        first: seconds the first time, most of them compiling.
        again: seconds with the programs of the first time kept.
        memory: gigabytes.
        disk: megabytes of its results and pictures.
    """

    first: float
    again: float
    memory: float
    disk: float


@cache
def costs() -> dict[str, Cost]:
    """The measured cost of each command, such as "run toutatis"."""
    text = resources.files(__package__ or "").joinpath("costs.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines()[1:]]
    return {name: Cost(*map(float, numbers)) for name, *numbers in rows}


def announce(name: str) -> None:
    """Say how long a command of default size will take, if that is long and known."""
    cost = costs().get(name)
    if cost and cost.first > _LONG:
        first, again = _time(cost.first), _time(cost.again)
        print(f"this takes about {first} on two cores, {again} from the second time on", flush=True)


def text() -> str:
    """The list, to print."""
    lines = ["scenarios: lieint run NAME, or your own file"]
    for name in scenarios.scenario_names():
        what, size = described(scenarios.load(name))
        lines += _entry(name, what, f"{size}; {takes(f'run {name}')}")
    lines.append("\nstudies: lieint study NAME")
    for name, module in study.studies_by_name().items():
        lines += _entry(name, (module.__doc__ or "").splitlines()[0], takes(f"study {name}"))
    return "\n".join([*lines, "\nscenarios: members × steps; time on two cores, the first time and again; memory"])


def described(scenario: Any) -> tuple[str, str]:
    """What a scenario is about, and its size."""
    return f"{scenario.title}: {scenario.about}", f"{scenario.members} × {scenario.steps}"


def takes(name: str) -> str:
    """The time and the memory of a command of default size."""
    cost = costs().get(name)
    return f"{_time(cost.first)}, {_time(cost.again)}; {cost.memory:.1f} GB" if cost else "not measured"


def _entry(name: str, what: str, size: str) -> list[str]:
    return [f"  {name:<20}{what}", f"  {'':<20}{size}"]


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"
