"""How many body-steps a second, how accurate, how conserving, against C++ of the same scheme and what one would use?

Free rigid bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, dt = 0.05. Everything
runs in one process pinned to one core (as Linux can); "all cores" is a second process without the pin, with the batch
split over one XLA host device per core. Contestants are called in turn; a rate is that of the best call, the median
beside it. "Wide vectors" are `ensemble.compiler_options()`: g++ uses the full vector width by default, XLA does not.

    python benchmarks/free_rigid_body.py [--quick] [--out DIR]

From a printout (the whole is results/free_rigid_body.md), millions of body-steps a second:

|                                   |   dtype |  best | median | ÷ C++ newton | ÷ C++ scalar | ours ÷ it | compile s |
| --------------------------------- | ------: | ----: | -----: | -----------: | -----------: | --------: | --------: |
| C++ symplectic, newton form       | float64 |   158 |    157 |            1 |        0.895 |     0.555 |       0.0 |
| C++ symplectic, scalar form       | float64 |   177 |    175 |         1.12 |            1 |     0.497 |       0.0 |
| ours, symplectic κ                | float64 |  87.9 |   86.3 |        0.555 |        0.497 |         1 |       0.5 |
| ours, symplectic κ, wide vectors  | float64 |   129 |    128 |        0.812 |        0.727 |     0.684 |       0.4 |
| diffrax Tsit5, vmapped            | float64 |  5.71 |   5.63 |       0.0361 |       0.0323 |      15.4 |       1.2 |
| MuJoCo RK4, rollout               | float64 | 0.249 |  0.248 |      0.00157 |      0.00141 |       353 |       0.0 |
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
    """The rates of our scheme with one XLA host device per core."""
    os.sched_setaffinity(0, cores)
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={len(cores)}"
    from lib import measure

    return measure.our_rates(measure.QUICK if quick else measure.Sizes())


def _second_process(cores: list[int], quick: bool) -> list[dict[str, object]]:
    arguments = [sys.executable, __file__, "--all-cores", ",".join(map(str, cores))] + ["--quick"] * quick
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


if __name__ == "__main__":
    main()
