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
| C++ symplectic, newton form       | float64 |   168 |    168 |            1 |        0.894 |     0.541 |       0.0 |
| C++ symplectic, scalar form       | float64 |   188 |    188 |         1.12 |            1 |     0.484 |       0.0 |
| ours, symplectic κ                | float64 |  91.2 |     91 |        0.541 |        0.484 |         1 |       0.3 |
| ours, symplectic κ, wide vectors  | float64 |   134 |    133 |        0.794 |         0.71 |     0.682 |       0.3 |
| ours, cayley κ                    | float64 |  37.3 |   36.5 |        0.221 |        0.198 |      2.44 |       0.9 |
| ours, cayley κ, wide vectors      | float64 |  57.5 |     57 |        0.341 |        0.305 |      1.59 |       0.8 |
| ours, exponential κ               | float64 |  19.4 |   18.5 |        0.115 |        0.103 |      4.71 |       1.0 |
| ours, exponential κ, wide vectors | float64 |  34.4 |     33 |        0.204 |        0.183 |      2.65 |       1.1 |
| diffrax Tsit5, vmapped            | float64 |  6.68 |   6.28 |       0.0396 |       0.0354 |      13.7 |       1.0 |
| diffrax Dopri8, vmapped           | float64 |   1.9 |    1.8 |       0.0113 |       0.0101 |      47.9 |       1.1 |
| C++ symplectic, newton form       | float32 |   342 |    340 |            1 |        0.744 |     0.511 |       0.0 |
| C++ symplectic, scalar form       | float32 |   459 |    458 |         1.34 |            1 |     0.381 |       0.0 |
| ours, symplectic κ                | float32 |   175 |    173 |        0.511 |        0.381 |         1 |       0.4 |
| ours, symplectic κ, wide vectors  | float32 |   253 |    251 |         0.74 |        0.551 |     0.691 |       0.3 |
| ours, cayley κ                    | float32 |  71.3 |   70.8 |        0.209 |        0.155 |      2.45 |       1.0 |
| ours, cayley κ, wide vectors      | float32 |   105 |    104 |        0.306 |        0.228 |      1.67 |       0.8 |
| ours, exponential κ               | float32 |  38.4 |   38.2 |        0.112 |       0.0836 |      4.55 |       1.1 |
| ours, exponential κ, wide vectors | float32 |  66.5 |   63.8 |        0.195 |        0.145 |      2.63 |       1.0 |
| diffrax Tsit5, vmapped            | float32 |  12.2 |   10.4 |       0.0358 |       0.0266 |      14.3 |       1.2 |
| diffrax Dopri8, vmapped           | float32 |   3.6 |   3.54 |       0.0105 |      0.00784 |      48.6 |       0.9 |
| MuJoCo RK4, rollout               | float64 | 0.282 |  0.279 |      0.00167 |       0.0015 |       323 |       0.0 |
| scipy DOP853, rtol 1e-10          | float64 | 0.217 |  0.167 |      0.00129 |      0.00115 |       420 |       0.0 |

| ours: symplectic κ, float64, one core                | measured |     bar |        |
| ---------------------------------------------------- | -------: | ------: | -----: |
| rate ÷ C++ newton form, default flags                |    0.541 |   ≥ 0.3 |   held |
| rate ÷ C++ newton form, wide vectors                 |    0.794 |  ≥ 0.45 |   held |
| rate ÷ C++ scalar form, default flags                |    0.484 |   ≥ 0.3 |   held |
| rate ÷ C++ scalar form, wide vectors                 |     0.71 |  ≥ 0.45 |   held |
| rate ÷ diffrax Tsit5 vmapped, default flags          |     13.7 |    ≥ 15 | MISSED |
| rate ÷ diffrax Tsit5 vmapped, ours with wide vectors |       20 |    ≥ 15 |   held |
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
