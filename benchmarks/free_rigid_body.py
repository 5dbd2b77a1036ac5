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
| C++ symplectic, newton form       | float64 |   162 |    162 |            1 |        0.843 |     0.564 |       0.0 |
| C++ symplectic, scalar form       | float64 |   193 |    192 |         1.19 |            1 |     0.475 |       0.0 |
| ours, symplectic κ                | float64 |  91.5 |   91.4 |        0.564 |        0.475 |         1 |       0.3 |
| ours, symplectic κ, wide vectors  | float64 |   134 |    133 |        0.824 |        0.695 |     0.684 |       0.3 |
| ours, cayley κ                    | float64 |  37.4 |   37.4 |         0.23 |        0.194 |      2.45 |       0.8 |
| ours, cayley κ, wide vectors      | float64 |  57.7 |   57.4 |        0.355 |        0.299 |      1.59 |       0.7 |
| ours, exponential κ               | float64 |  19.4 |   19.4 |         0.12 |        0.101 |      4.71 |       1.0 |
| ours, exponential κ, wide vectors | float64 |  34.4 |   34.3 |        0.212 |        0.179 |      2.66 |       1.0 |
| diffrax Tsit5, vmapped            | float64 |  6.04 |   6.02 |       0.0372 |       0.0314 |      15.2 |       1.1 |
| diffrax Dopri8, vmapped           | float64 |  1.74 |   1.73 |       0.0107 |      0.00904 |      52.6 |       0.9 |
| C++ symplectic, newton form       | float32 |   332 |    332 |            1 |        0.733 |     0.526 |       0.0 |
| C++ symplectic, scalar form       | float32 |   453 |    450 |         1.36 |            1 |     0.386 |       0.0 |
| ours, symplectic κ                | float32 |   175 |    173 |        0.526 |        0.386 |         1 |       0.3 |
| ours, symplectic κ, wide vectors  | float32 |   254 |    251 |        0.764 |        0.561 |     0.688 |       0.5 |
| ours, cayley κ                    | float32 |  71.3 |   71.1 |        0.215 |        0.157 |      2.45 |       0.7 |
| ours, cayley κ, wide vectors      | float32 |   105 |    104 |        0.317 |        0.233 |      1.66 |       0.9 |
| ours, exponential κ               | float32 |  38.4 |   38.1 |        0.116 |       0.0847 |      4.55 |       0.9 |
| ours, exponential κ, wide vectors | float32 |  66.7 |   66.4 |        0.201 |        0.147 |      2.62 |       1.1 |
| diffrax Tsit5, vmapped            | float32 |    11 |   10.9 |       0.0331 |       0.0243 |      15.9 |       0.9 |
| diffrax Dopri8, vmapped           | float32 |  3.35 |   3.32 |       0.0101 |      0.00739 |      52.2 |       0.9 |
| MuJoCo RK4, rollout               | float64 | 0.283 |  0.282 |      0.00174 |      0.00147 |       323 |       0.0 |
| scipy DOP853, rtol 1e-10          | float64 |  0.25 |  0.249 |      0.00154 |       0.0013 |       366 |       0.0 |

| ours: symplectic κ, float64, one core                | measured |     bar |      |
| ---------------------------------------------------- | -------: | ------: | ---: |
| rate ÷ C++ newton form, default flags                |    0.564 |   ≥ 0.3 | held |
| rate ÷ C++ newton form, wide vectors                 |    0.824 |  ≥ 0.45 | held |
| rate ÷ C++ scalar form, default flags                |    0.475 |   ≥ 0.3 | held |
| rate ÷ C++ scalar form, wide vectors                 |    0.695 |  ≥ 0.45 | held |
| rate ÷ diffrax Tsit5 vmapped, default flags          |     15.2 |    ≥ 15 | held |
| rate ÷ diffrax Tsit5 vmapped, ours with wide vectors |     22.2 |    ≥ 15 | held |
| energy drift over 100000 steps                       |  2.1e-14 | ≤ 5e-13 | held |
| momentum drift over 100000 steps                     |        0 |     ≤ 0 | held |
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
