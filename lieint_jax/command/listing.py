"""The command `list`: the examples with their measured time and memory, a script, or a catalogue of the library."""

from __future__ import annotations

import inspect
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import tyro

from lieint_jax import schemes, systems
from lieint_jax.command import scripts
from lieint_jax.command.printer import show

CATALOGUES = {"schemes": schemes.catalogue, "systems": systems.catalogue}
_LONG = 10.0  # seconds: commands that need longer print their expected time before they start


class Cost(NamedTuple):
    """The cost of a command at its default size, as measured by `benchmarks/commands.py` on two cores."""

    first: float  # seconds of the first run, most of them for compilation
    again: float  # seconds of later runs, whose programs are cached
    memory: float  # gigabytes of memory
    disk: float  # megabytes of results and pictures


def print_list(name: tyro.conf.Positional[str] = "") -> None:
    """Print the examples with their sizes and times, or the script of one; or the schemes or systems.

    Args:
        name: of an example, whose script is printed, to copy and change; or "schemes" or "systems".
    """
    show(text(name))


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


def text(name: str = "") -> str:
    """The examples, a catalogue of `CATALOGUES`, or the script of an example, as text."""
    if name in CATALOGUES:
        return repr(CATALOGUES[name]())
    if name:
        return Path(scripts.example(name).__file__).read_text(encoding="utf-8").rstrip()
    lines = ["examples: lieint run NAME, or your own script; lieint list NAME prints its script, to copy and change"]
    for each in scripts.names():
        about, size = describe(each)
        lines += [f"  {each:<20}{about}", f"  {'':<20}{size}{describe_cost(f'run {each}')}"]
    return "\n".join([*lines, "\nmembers × steps; time on two cores of the first and of later runs; memory"])


def describe(name: str) -> tuple[str, str]:
    """The title of an example, and its size, as text that ends with a semicolon, or nothing."""
    script = scripts.example(name)
    arguments = inspect.signature(script.main).parameters
    sizes = [str(arguments[key].default) for key in ("members", "steps") if key in arguments]
    return (script.__doc__ or "").splitlines()[0], f"{' × '.join(sizes)}; " if len(sizes) == 2 else ""


def describe_cost(name: str) -> str:
    """The time and the memory that a command of default size needs, as text."""
    cost = costs().get(name)
    return f"{_duration(cost.first)}, {_duration(cost.again)}; {cost.memory:.1f} GB" if cost else "not measured"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"
