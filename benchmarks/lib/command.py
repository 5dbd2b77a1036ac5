"""The command line of a benchmark, and its pinning to one core. It must not import jax, which starts threads."""

from __future__ import annotations

import argparse
import os
import time
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


def least_cpu_times(contestants: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """The CPU seconds of each, in turn; each after a call that XLA uses to end what others left."""
    import jax

    seconds = dict.fromkeys(contestants, float("inf"))
    for _ in range(rounds):
        for name, call in contestants.items():
            jax.block_until_ready(call())
            start = time.process_time()
            jax.block_until_ready(call())
            seconds[name] = min(seconds[name], time.process_time() - start)
    return seconds
