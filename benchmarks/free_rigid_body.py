"""How many body-steps a second, how accurate, how conserving, against C++ of the same scheme and what one would use?

Free rigid bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, dt = 0.05. Everything
runs in one process pinned to one core (as Linux can); "all cores" is a second process without the pin, the batch split
over one XLA host device a core. Contestants are called in turn; a rate is that of the best call, the median beside it.
"Wide vectors" are `ensemble.compiler_options()`: g++ uses the full vector width by itself, XLA only when told.

    python benchmarks/free_rigid_body.py [--quick] [--out DIR]

A typical printout, shortened:

Rates, 1000 bodies, one core: millions of body-steps a second (for scipy a step is a time dt)

|                                   |   dtype |  best | median | ÷ C++ newton | ÷ C++ scalar | ours ÷ it | compile s |
| --------------------------------- | ------: | ----: | -----: | -----------: | -----------: | --------: | --------: |
| C++ symplectic, newton form       | float64 |   165 |    165 |            1 |        0.854 |      0.55 |       0.0 |
| C++ symplectic, scalar form       | float64 |   194 |    193 |         1.17 |            1 |     0.469 |       0.0 |
| ours, symplectic κ                | float64 |  90.9 |   90.9 |         0.55 |        0.469 |         1 |       0.3 |
| ours, symplectic κ, wide vectors  | float64 |   133 |    133 |        0.806 |        0.688 |     0.682 |       0.3 |
| ours, cayley κ                    | float64 |  36.2 |   36.1 |        0.219 |        0.187 |      2.51 |       0.9 |
| ours, cayley κ, wide vectors      | float64 |  56.6 |   56.4 |        0.342 |        0.292 |      1.61 |       0.9 |
| ours, exponential κ               | float64 |  16.5 |   16.4 |       0.0997 |       0.0852 |      5.51 |       1.2 |
| ours, exponential κ, wide vectors | float64 |  29.8 |   29.6 |         0.18 |        0.154 |      3.05 |       1.1 |
| diffrax Tsit5, vmapped            | float64 |  6.11 |   6.09 |        0.037 |       0.0316 |      14.9 |       1.1 |
| diffrax Dopri8, vmapped           | float64 |  1.75 |   1.74 |       0.0106 |      0.00901 |      52.1 |       0.9 |
| C++ symplectic, newton form       | float32 |   329 |    328 |            1 |        0.746 |     0.528 |       0.0 |
| C++ symplectic, scalar form       | float32 |   441 |    440 |         1.34 |            1 |     0.394 |       0.0 |
| ours, symplectic κ                | float32 |   174 |    173 |        0.528 |        0.394 |         1 |       0.5 |
| ours, symplectic κ, wide vectors  | float32 |   251 |    249 |        0.763 |         0.57 |     0.692 |       0.4 |
| ours, cayley κ                    | float32 |    69 |   68.6 |         0.21 |        0.157 |      2.52 |       0.8 |
| ours, cayley κ, wide vectors      | float32 |   103 |    103 |        0.314 |        0.234 |      1.68 |       1.0 |
| ours, exponential κ               | float32 |  32.5 |   32.3 |       0.0989 |       0.0738 |      5.34 |       1.1 |
| ours, exponential κ, wide vectors | float32 |  56.4 |     56 |        0.172 |        0.128 |      3.08 |       1.3 |
| diffrax Tsit5, vmapped            | float32 |    11 |   10.9 |       0.0333 |       0.0249 |      15.9 |       1.0 |
| diffrax Dopri8, vmapped           | float32 |  3.34 |   3.32 |       0.0101 |      0.00757 |      52.1 |       1.2 |
| MuJoCo RK4, rollout               | float64 | 0.281 |  0.279 |       0.0017 |      0.00145 |       323 |       0.0 |
| scipy DOP853, rtol 1e-10          | float64 |  0.25 |  0.249 |      0.00151 |      0.00129 |       364 |       0.0 |

| ours: symplectic κ, float64, one core                | measured |     bar |        |
| ---------------------------------------------------- | -------: | ------: | -----: |
| rate ÷ C++ newton form, default flags                |     0.55 |   ≥ 0.3 |   held |
| rate ÷ C++ newton form, wide vectors                 |    0.806 |  ≥ 0.45 |   held |
| rate ÷ C++ scalar form, default flags                |    0.469 |   ≥ 0.3 |   held |
| rate ÷ C++ scalar form, wide vectors                 |    0.688 |  ≥ 0.45 |   held |
| rate ÷ diffrax Tsit5 vmapped, default flags          |     14.9 |    ≥ 15 | MISSED |
| rate ÷ diffrax Tsit5 vmapped, ours with wide vectors |     21.8 |    ≥ 15 |   held |
| energy drift over 100000 steps                       |  2.1e-14 | ≤ 5e-13 |   held |
| momentum drift over 100000 steps                     |        0 |     ≤ 0 |   held |
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import command


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--all-cores", metavar="CORES", help=argparse.SUPPRESS)  # how the second process is called
    options = parser.parse_args()
    if options.all_cores:
        print(json.dumps(on_all_cores([int(core) for core in options.all_cores.split(",")], options.quick)))
    else:
        on_one_core(options.quick, options.out)


def on_one_core(quick: bool, out: Path) -> None:
    """Measure everything, print it, write the tables as .md and .json."""
    cores = sorted(os.sched_getaffinity(0))
    command.pin()  # before jax makes its threads
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
