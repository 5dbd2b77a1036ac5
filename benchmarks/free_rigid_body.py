"""How many body-steps a second, how accurate, how conserving, against C++ of the same scheme and what one would use instead?

Free rigid bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, dt = 0.05. Everything
runs in one process pinned to one core; "all cores" is a second process without the pin, the batch split over one XLA
host device a core. Contestants are called in turn; a rate is that of the best call, the median beside it.

    python benchmarks/free_rigid_body.py [--quick] [--out DIR]

A typical printout:
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, under a minute")
    parser.add_argument("--out", type=Path, default=HERE / "results", metavar="DIR", help="where the results go")
    parser.add_argument("--all-cores", metavar="CORES", help=argparse.SUPPRESS)  # how the second process is called
    options = parser.parse_args()
    if options.all_cores:
        print(json.dumps(on_all_cores([int(core) for core in options.all_cores.split(",")], options.quick)))
    else:
        on_one_core(options.quick, options.out)


def on_one_core(quick: bool, out: Path) -> None:
    """Measure everything, print it, write the tables as .md and .json and the plot as .png."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[-1:])  # before jax makes its threads
    import measure
    import report

    result = measure.everything(measure.QUICK if quick else measure.Sizes())
    result["all_cores"] = _second_process(cores, quick)
    report.write(result, out)


def on_all_cores(cores: list[int], quick: bool) -> list[dict[str, object]]:
    """Our rates with one XLA host device a core."""
    os.sched_setaffinity(0, cores)
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={len(cores)}"
    import measure

    return measure.our_rates(measure.QUICK if quick else measure.Sizes())


def _second_process(cores: list[int], quick: bool) -> list[dict[str, object]]:
    arguments = [sys.executable, __file__, "--all-cores", ",".join(map(str, cores))] + ["--quick"] * quick
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


if __name__ == "__main__":
    main()
