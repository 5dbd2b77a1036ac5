"""The command line of a benchmark, and its one core. Imports no jax: that makes its threads when it is imported."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"


def parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser of --quick and --out, described by the first line of a script's docstring."""
    made = argparse.ArgumentParser(description=str(doc).splitlines()[0])
    made.add_argument("--quick", action="store_true", help="small sizes, few points")
    made.add_argument("--out", type=Path, default=RESULTS, metavar="DIR", help="where the results go")
    return made


def pin() -> None:
    """Keep this process to the last core it may use (as Linux can). To be called before jax is imported."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])


def under_load(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `work` returns, and the load of the machine before and after it."""
    before = os.getloadavg()[0]
    result = work()
    return result | {"load": [before, os.getloadavg()[0]]}


def on_one_core(doc: str | None) -> argparse.Namespace:
    """The options of a benchmark that takes no more than --quick and --out, its process pinned."""
    options = parser(doc).parse_args()
    pin()
    return options
