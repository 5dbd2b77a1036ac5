"""How many body-steps a second, how accurate, how conserving, against C++ of the same scheme and what one would use?

Free rigid bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, dt = 0.05. Ours are
whole calls of `li.run`, in one row a custom `jax.vmap`. Everything runs in one process pinned to one core (as
Linux can); "all cores" is a second process without the pin. Contestants are called in turn; a rate is that of the best
call, with the median next to it.

    python benchmarks/free_rigid_body.py [--quick] [--out DIR]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from lib import command


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--all-cores", metavar="CORES", help=argparse.SUPPRESS)  # set in the second process
    options = command.parsed(parser)
    if options.all_cores:
        print(json.dumps(on_all_cores([int(core) for core in options.all_cores.split(",")], options.quick)))
    else:
        on_one_core(options.quick, options.out)


def on_one_core(quick: bool, out: Path) -> None:
    """Run all measurements, print the tables, and write them as .md and .json."""
    cores = sorted(os.sched_getaffinity(0))
    command.pin()  # before jax makes its threads
    from lib import measure, report

    result = measure.everything(measure.QUICK if quick else measure.Sizes())
    result["all_cores"] = _second_process(cores, quick)
    report.write(result, out)


def on_all_cores(cores: list[int], quick: bool) -> list[dict[str, object]]:
    """The rates of our scheme on all cores."""
    os.sched_setaffinity(0, cores)
    from lib import measure

    return measure.our_rates(measure.QUICK if quick else measure.Sizes())


def _second_process(cores: list[int], quick: bool) -> list[dict[str, object]]:
    arguments = [sys.executable, __file__, "--all-cores", ",".join(map(str, cores))] + ["--quick"] * quick
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


if __name__ == "__main__":
    main()
