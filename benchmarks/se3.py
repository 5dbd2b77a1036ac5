"""Bodies in a fluid, on SE(3): is the midpoint scheme twice as fast as Runge–Kutta, steps for steps, and what is kept?

Kirchhoff's ellipsoid of semi-axes 3, 2, 1 with its centre of mass off its centre, so that rotation and translation are
coupled. Random motions q, body velocities random in the unit ball of ℝ⁶, dt = 0.05. Ours (`schemes.group_midpoint` with
two maps) against diffrax's Tsit5 on the same right-hand side, q' = qΩ̂ with Ω = m⁻¹Ad*_q π, called in turn in one
process pinned to one core (as Linux can). The reference is `diagnostics.flow`, Gauss collocation of order 16.
"Wide vectors" are `ensemble.compiler_options()`.

    python benchmarks/se3.py [--quick] [--out DIR]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

HERE = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, few points")
    parser.add_argument("--out", type=Path, default=HERE / "results", metavar="DIR", help="where the results go")
    options = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])  # before jax makes its threads
    import fluid
    import fluid_report
    import measure

    before = os.getloadavg()[0]
    result = fluid.everything(measure.QUICK if options.quick else measure.Sizes())
    result["load"] = [before, os.getloadavg()[0]]
    fluid_report.write(result, options.out)


if __name__ == "__main__":
    main()
