"""The command line of a benchmark, and its pinning to one core. It must not import jax, which starts threads."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
QUICK = RESULTS / "quick"  # not kept in the repository


def parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser of --quick and --out, described by the first line of a script's docstring."""
    made = argparse.ArgumentParser(description=str(doc).splitlines()[0])
    made.add_argument("--quick", action="store_true", help="small sizes, few points; results in results/quick")
    made.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    return made


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The options; those of quick runs do not replace the results that are kept."""
    options = parser.parse_args()
    options.out = options.out or (QUICK if options.quick else RESULTS)
    return options


def pin() -> None:
    """Pin this process to the last core that it may use (as Linux can). Call it before jax is imported."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])


def under_load(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result of `work`, with the load of the machine before and after it under the key "load"."""
    before = os.getloadavg()[0]
    result = work()
    return result | {"load": [before, os.getloadavg()[0]]}


def on_one_core(doc: str | None) -> argparse.Namespace:
    """Parse the options of a benchmark that takes --quick and --out only, and pin the process."""
    options = parsed(parser(doc))
    pin()
    return options
